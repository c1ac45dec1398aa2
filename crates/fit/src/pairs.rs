//! Pairs of photographs, one dark and one in normal light, as histograms.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::{ColourCounts, Image, ImageFile, files};
use nightsplat_photographs::tone::{Statistics, luminance, measurable};
use rayon::prelude::*;

use super::Histogram;

/// Folders of the dark photographs of a scene.
const DARK_FOLDERS: [&str; 2] = ["low", "images_low"];
/// Folders of the normal-light photographs, with the same names.
const NORMAL_FOLDERS: [&str; 3] = ["high", "normal", "images"];

/// Pairs of one scene.
#[derive(Clone, Debug)]
pub struct PairScene<P> {
    /// The folder's name.
    pub name: String,
    /// By name; none of them black.
    pub pairs: Vec<P>,
}

/// Pairs as histograms.
pub type FitScene = PairScene<Pair>;

/// A dark photograph and its reference, reduced to the data that a fit requires.
#[derive(Clone, Debug)]
pub struct Pair {
    /// The dark photograph.
    pub path: PathBuf,
    /// The dark photograph's statistics.
    pub statistics: Statistics,
    /// Dark and reference values of each channel.
    pub channels: [Histogram; 3],
    /// Dark and reference luminance.
    pub luminance: Histogram,
}

impl Pair {
    /// The pair of two images; `path` is its name.
    pub fn new(path: impl Into<PathBuf>, dark: &Image, reference: &Image) -> Result<Self> {
        let path = path.into();
        check_sizes(&path, dark, reference)?;
        let pixels = dark.pixel_count();
        fn plane(image: &Image, channel: usize) -> &[f32] {
            &image.data[channel * image.pixel_count()..][..image.pixel_count()]
        }
        let luminances = |image: &Image| -> Vec<f32> {
            let rgb = |i: usize| [0, 1, 2].map(|channel| measurable(plane(image, channel)[i]));
            (0..pixels).map(|i| luminance(rgb(i))).collect()
        };
        Ok(Self {
            path,
            statistics: Statistics::new(&dark.data),
            channels: [0, 1, 2]
                .map(|channel| Histogram::new(plane(dark, channel), plane(reference, channel))),
            luminance: Histogram::new(&luminances(dark), &luminances(reference)),
        })
    }

    /// Whether the 90th percentile is 0, and t = x / p90 undefined.
    pub fn is_black(&self) -> bool {
        self.statistics.p90 <= 1e-6
    }
}

/// Refuses a pair of different sizes, or without pixels.
pub(super) fn check_sizes(path: &Path, dark: &Image, reference: &Image) -> Result<()> {
    if (dark.width, dark.height) != (reference.width, reference.height) {
        let problem = format!(
            "is {}x{} but its reference {}x{}; a pair must show the same pixels",
            dark.width, dark.height, reference.width, reference.height
        );
        return Err(Error::input(path, problem));
    }
    if dark.pixel_count() == 0 {
        return Err(Error::input(path, "has no pixels"));
    }
    Ok(())
}

impl FitScene {
    /// Pairs by file name without extension: the photographs of `normal` with those of `folder`, or, without it, those
    /// of `folder`'s subfolders `low` and `high`, `normal` or `images`.
    ///
    /// Photographs without a partner, and black ones, are left out with a warning.
    pub fn load(folder: &Path, normal: Option<&Path>) -> Result<Self> {
        let (files, dark) = files_of(folder, normal)?;
        let colours = ColourCounts::default();
        let load = |(dark, reference): &Files| {
            let [image, bright] = [dark, reference].map(|path| Image::load_counted(path, &colours));
            Pair::new(dark, &image?, &bright?)
        };
        let mut pairs = files.par_iter().map(load).collect::<Result<Vec<Pair>>>()?;
        colours.log();
        pairs.retain(|pair| {
            if pair.is_black() {
                tracing::warn!("left out: {} is black", pair.path.display());
            }
            !pair.is_black()
        });
        if pairs.is_empty() {
            let problem = "every photograph is black (p90 is 0): there is no t = x / p90 to fit on";
            return Err(Error::input(dark, problem));
        }
        Ok(Self { name: name_of(folder), pairs })
    }
}

/// A dark photograph and its reference.
type Files = (PathBuf, PathBuf);

/// The folder's name.
pub(super) fn name_of(folder: &Path) -> String {
    let name = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    name.file_name().unwrap_or(name.as_os_str()).to_string_lossy().into_owned()
}

/// The pairs of a scene by name, at least one, and the folder of the dark photographs.
pub(super) fn files_of(folder: &Path, normal: Option<&Path>) -> Result<(Vec<Files>, PathBuf)> {
    let (dark, normal) = match normal {
        Some(normal) => (folder.to_owned(), normal.to_owned()),
        None => subfolders(folder)?,
    };
    let (mut darks, mut references) = (photographs(&dark)?, photographs(&normal)?);
    let unpaired = darks.keys().find(|name| !references.contains_key(*name)).cloned();
    let count = darks.len();
    darks.retain(|name, _| references.contains_key(name));
    references.retain(|name, _| darks.contains_key(name));
    if darks.is_empty() {
        let problem =
            format!("no photograph has a partner of the same name in {}", normal.display());
        return Err(Error::input(dark, problem));
    }
    if let Some(name) = unpaired {
        let (left, normal) = (count - darks.len(), normal.display());
        tracing::warn!(
            "{}: {left} of {count} have no partner in {normal} ({name} is the first)",
            dark.display()
        );
    }
    Ok((darks.into_values().zip(references.into_values()).collect(), dark))
}

/// The dark and the normal folder of a scene.
fn subfolders(folder: &Path) -> Result<(PathBuf, PathBuf)> {
    let first =
        |names: &[&str]| names.iter().map(|name| folder.join(name)).find(|path| path.is_dir());
    first(&DARK_FOLDERS).zip(first(&NORMAL_FOLDERS)).ok_or_else(|| {
        let problem = if folder.is_dir() {
            "contains no pairs: it requires folders `low` and `high` (or `normal`, or `images`), or a \
             folder of normal-light photographs named with --normal"
        } else {
            "is not a folder; name the folder of the pairs"
        };
        Error::input(folder, problem)
    })
}

/// The photographs of a folder by name without extension.
fn photographs(folder: &Path) -> Result<BTreeMap<String, PathBuf>> {
    let mut found = BTreeMap::new();
    for path in files::photographs_in(folder)? {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = found.insert(name, path.clone()) {
            let problem = format!("has the same name as {}; rename one", other.display());
            return Err(Error::input(path, problem));
        }
    }
    Ok(found)
}
