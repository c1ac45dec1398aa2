//! From files to views: decode, check against the camera, undistort, shrink. Parallel over views.

use std::path::{Path, PathBuf};

use glam::DAffine3;
use rayon::prelude::*;

use super::undistort::{Undistortion, WIDEST};
use super::{LoadOptions, Split, View, masks};
use crate::camera::{Camera, Lens};
use crate::image::{Image, Mask, Orientation};
use crate::{Error, Result};

/// The shortest side that leaves something to train on, pixels.
const MIN_SIDE: u32 = 16;

/// What a view is made of.
#[derive(Clone, Debug)]
pub(super) struct Source {
    pub(super) name: String,
    pub(super) split: Split,
    /// As listed; fitted to the photograph's size here.
    pub(super) lens: Lens,
    pub(super) view_from_world: DAffine3,
    pub(super) input: Option<PathBuf>,
    pub(super) reference: Option<PathBuf>,
    pub(super) mask: Option<PathBuf>,
    pub(super) depth: Option<PathBuf>,
}

impl Source {
    /// Of the files of the photograph, its reference image, its mask and its depth.
    pub(super) fn new(
        (name, split): (String, Split),
        (lens, view_from_world): (Lens, DAffine3),
        [input, reference, mask, depth]: [Option<PathBuf>; 4],
    ) -> Self {
        Self { name, split, lens, view_from_world, input, reference, mask, depth }
    }
}

/// The views in order of name. Files that do not decode are named in `skipped`.
pub(super) fn load(
    sources: Vec<Source>,
    options: &LoadOptions,
    skipped: &mut Vec<String>,
) -> Result<Vec<View>> {
    let mut groups: Vec<(Lens, Vec<Source>)> = Vec::new();
    for source in sources {
        let source = Source { lens: fitted_lens(&source)?, ..source };
        match groups.iter_mut().find(|(lens, _)| *lens == source.lens) {
            Some((_, group)) => group.push(source),
            None => groups.push((source.lens, vec![source])),
        }
    }
    let loaded = groups.into_par_iter().map(|(lens, group)| load_group(&lens, group, options));
    let loaded = loaded.collect::<Result<Vec<_>>>()?;
    let mut loaded: Vec<Loaded> = loaded.into_iter().flatten().collect();
    loaded.sort_by(|a, b| a.name.cmp(&b.name));
    let mut views = Vec::with_capacity(loaded.len());
    for Loaded { view, problems, .. } in loaded {
        views.extend(view);
        skipped.extend(problems);
    }
    Ok(views)
}

/// A photograph that was shrunk on loading.
#[derive(Clone, Debug)]
pub struct Original {
    path: PathBuf,
    /// Fitted to the photograph's size.
    lens: Lens,
}

impl Original {
    /// Reads it anew, undistorted, at its own size.
    pub(super) fn load(&self) -> Result<Image> {
        let Self { path, lens } = self;
        let undistortion = undistortion(lens, &path.to_string_lossy())?;
        let image = loaded(path, lens)?;
        prepared(image, path, lens, undistortion.as_ref(), (lens.width, lens.height))
    }
}

struct Loaded {
    name: String,
    /// `None`: a training view whose photograph does not decode.
    view: Option<View>,
    problems: Vec<String>,
}

/// The listed lens over the photograph as it is: the input's size, without one the reference image's.
fn fitted_lens(source: &Source) -> Result<Lens> {
    let lens = source.lens;
    // What has no readable header is named when it is decoded.
    let sized = [&source.input, &source.reference].into_iter().flatten();
    let sized = sized.filter_map(|path| {
        let size = Image::size_of(path).ok()?;
        Some((path, turn(path, size, &lens).size(size)))
    });
    let Some((path, (width, height))) = sized.clone().next() else {
        return Ok(lens);
    };
    let fitted =
        lens.fitted(width, height).ok_or_else(|| disagreement(path, (width, height), &lens))?;
    if (width, height) != (lens.width, lens.height) {
        tracing::info!(
            "{}: is {width}x{height}, its camera {}x{}; intrinsics rescaled",
            path.display(),
            lens.width,
            lens.height
        );
    }
    Ok(fitted)
}

/// How a photograph is turned to be what its camera took. Poses are of what is stored, as COLMAP reads it; where the
/// camera's size is that of what is seen, and not of what is stored, they are of that.
pub(super) fn turn(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Orientation {
    if lens.fitted(width, height).is_some() {
        return Orientation::UPRIGHT;
    }
    let said = Orientation::of(path);
    let (width, height) = said.size((width, height));
    if lens.fitted(width, height).is_some() { said } else { Orientation::UPRIGHT }
}

/// A photograph as its camera took it.
fn loaded(path: &Path, lens: &Lens) -> Result<Image> {
    let image = Image::load(path)?;
    let orientation = turn(path, (image.width, image.height), lens);
    Ok(image.turned(orientation))
}

fn disagreement(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Error {
    let (w, h) = (lens.width, lens.height);
    let (seen_width, seen_height) = Orientation::of(path).size((width, height));
    let seen = if seen_width == width {
        String::new()
    } else {
        format!(" (upright {seen_width}x{seen_height})")
    };
    let problem = format!(
        "is {width}x{height}{seen} but its camera is {w}x{h}; use the photographs that the cameras were made with"
    );
    Error::input(path, problem)
}

/// Views of one lens share its undistortion map.
fn load_group(lens: &Lens, group: Vec<Source>, options: &LoadOptions) -> Result<Vec<Loaded>> {
    let downscale = options.downscale;
    let side = |pixels: u32| (f64::from(pixels) / downscale).round() as u32;
    let size = (side(lens.width), side(lens.height));
    let name = group.first().map_or("", |source| source.name.as_str());
    if size.0.min(size.1) < MIN_SIDE {
        return Err(Error::Usage(format!(
            "downscale {downscale} leaves {}x{} pixels of view {name}, at least {MIN_SIDE} are needed; lower it",
            size.0, size.1
        )));
    }
    let undistortion = undistortion(lens, name)?;
    if undistortion.as_ref().is_some_and(|undistortion| undistortion.is_cropped) {
        tracing::warn!(
            "view {name} and {} more are of a fisheye that sees farther off its axis than the {WIDEST} degrees at the corners of what is trained on; the rest is cropped",
            group.len() - 1
        );
    }
    group
        .into_par_iter()
        .map(|source| load_view(source, lens, undistortion.as_ref(), size, options))
        .collect()
}

/// What makes a pinhole of the lens; none where it is one.
fn undistortion(lens: &Lens, name: &str) -> Result<Option<Undistortion>> {
    let undistortion = (!lens.is_pinhole()).then(|| {
        Undistortion::new(lens).ok_or_else(|| {
            let problem = "its distortion coefficients describe no lens; calibrate again or undistort with COLMAP";
            Error::input(name, problem)
        })
    });
    undistortion.transpose()
}

fn load_view(
    source: Source,
    lens: &Lens,
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
    options: &LoadOptions,
) -> Result<Loaded> {
    let Source { name, split, view_from_world, input, reference, mask, depth, .. } = source;
    let mut problems = Vec::new();
    let mut image = |path: Option<PathBuf>| -> Result<Option<Image>> {
        let Some(path) = path else { return Ok(None) };
        match loaded(&path, lens) {
            Ok(image) => prepared(image, &path, lens, undistortion, size).map(Some),
            Err(error) => {
                problems.push(error.to_string());
                Ok(None)
            }
        }
    };
    let is_shrunk = size != (lens.width, lens.height);
    let original = input.clone().filter(|_| is_shrunk).map(|path| Original { path, lens: *lens });
    let paths = [input.clone(), reference.clone()];
    let (mut image, mut reference) = (image(input)?, image(reference)?);
    // Of what was read: a file that does not decode is named once.
    let [of_input, of_reference] = paths;
    let hidden = of_input
        .filter(|_| image.is_some())
        .or(of_reference.filter(|_| reference.is_some()))
        .map(|path| {
            let files = (path.as_path(), mask.as_deref());
            masks::load(files, lens, undistortion, size, options.invert_masks)
        });
    let mask = hidden.transpose()?.flatten();
    if mask.as_ref().is_some_and(Mask::hides_all) {
        problems.push(format!("{name}: its mask hides every pixel"));
        (image, reference) = (None, None);
    }
    let depth = depth.and_then(|path| {
        depth_map(&path, lens, undistortion, size, options.depth.is_disparity)
            .map_err(|problem| tracing::warn!("the depth of view {name} is not used: {problem}"))
            .ok()
    });
    let camera = Camera {
        width: lens.width,
        height: lens.height,
        focal: undistortion.map_or(lens.focal, |undistortion| undistortion.focal),
        principal_point: lens.principal_point,
        view_from_world,
    };
    let camera = camera.resized(size.0, size.1);
    let original = original.filter(|_| image.is_some());
    let view = View { name: name.clone(), split, camera, image, original, reference, mask, depth };
    let view = (split == Split::Test || view.image.is_some()).then_some(view);
    Ok(Loaded { name, view, problems })
}

/// The depth map as the view's camera sees it, larger is farther.
fn depth_map(
    path: &Path,
    lens: &Lens,
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
    is_disparity: bool,
) -> Result<Vec<f32>> {
    let mut map = Image::load_as_stored(path)?;
    if (map.width, map.height) != (lens.width, lens.height) {
        let (w, h) = (lens.width, lens.height);
        let (width, height) = (map.width, map.height);
        tracing::info!("{}: is {width}x{height}; resized to {w}x{h}", path.display());
        map = map.resized(w, h);
    }
    let map = undistortion.map_or_else(|| map.clone(), |undistortion| undistortion.apply(&map));
    let mut depth = map.resized(size.0, size.1).data;
    depth.truncate(size.0 as usize * size.1 as usize);
    if depth.iter().all(|&value| value == depth[0]) {
        return Err(Error::input(path, "is the same everywhere"));
    }
    if is_disparity {
        depth.iter_mut().for_each(|value| *value = -*value);
    }
    Ok(depth)
}

pub(super) fn prepared(
    image: Image,
    path: &Path,
    lens: &Lens,
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
) -> Result<Image> {
    let (width, height) = (image.width, image.height);
    if lens.fitted(width, height).is_none() {
        return Err(disagreement(path, (width, height), lens));
    }
    // A reference image may be of another resolution than the input.
    let image = if (width, height) == (lens.width, lens.height) {
        image
    } else {
        image.resized(lens.width, lens.height)
    };
    let image =
        undistortion.map_or_else(|| image.clone(), |undistortion| undistortion.apply(&image));
    Ok(image.resized(size.0, size.1))
}
