//! From files to views: decode, check against the camera, undistort, shrink. Parallel over views.

use std::path::{Path, PathBuf};

use glam::DAffine3;
use rayon::prelude::*;

use super::undistort::{Undistortion, WIDEST};
use super::{LoadOptions, Split, View, masks};
use crate::camera::{Camera, CameraModel, Lens};
use crate::photographs::image::{Image, Mask, Orientation};
use crate::{Error, Result};

/// The shortest side that leaves something to train on, pixels.
const MIN_SIDE: u32 = 16;

/// Of a decoded photograph.
const BYTES_PER_PIXEL: u64 = 12;

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
    let options = &resolved(&groups, options);
    let largest = groups.iter().map(|(lens, _)| pixels(lens.width, lens.height)).max();
    let at_once = Image::decoded_at_once(largest.unwrap_or_default());
    let mut loaded: Vec<Loaded> = vec![];
    for groups in groups.chunks(at_once) {
        let groups =
            groups.par_iter().map(|(lens, group)| load_group(lens, group, options, at_once));
        loaded.extend(groups.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    loaded.sort_by(|a, b| a.name.cmp(&b.name));
    let mut views = Vec::with_capacity(loaded.len());
    for Loaded { view, problems, .. } in loaded {
        views.extend(view);
        skipped.extend(problems);
    }
    Ok(views)
}

fn pixels(width: u32, height: u32) -> u64 {
    u64::from(width) * u64::from(height)
}

/// The options with `keep` decided: none where every photograph is kept. Says where `max_resolution` acts.
fn resolved(groups: &[(Lens, Vec<Source>)], options: &LoadOptions) -> LoadOptions {
    let mut bytes = 0;
    let mut shrunk: Vec<&Lens> = vec![];
    for (lens, group) in groups {
        let (width, height) = options.loaded_size(lens.width, lens.height);
        let pictures = group.iter().flat_map(|source| [&source.input, &source.reference]).flatten();
        bytes += pictures.count() as u64 * pixels(width, height) * BYTES_PER_PIXEL;
        let free = LoadOptions { max_resolution: 0, ..options.clone() };
        if free.loaded_size(lens.width, lens.height) != (width, height) {
            shrunk.push(lens);
        }
    }
    if let Some(lens) = shrunk.first() {
        let (width, height) = options.loaded_size(lens.width, lens.height);
        let (w, h, limit) = (lens.width, lens.height, options.max_resolution);
        let more = if shrunk.len() > 1 { ", and others alike" } else { "" };
        tracing::warn!(
            "photographs of {w}x{h} are trained on at {width}x{height}{more}: max_resolution is {limit}, 0 \
             takes them as they are"
        );
    }
    let keep = options.keep.filter(|&most| bytes > most);
    if let Some(most) = keep {
        let [bytes, most] = [bytes, most].map(|bytes| bytes as f64 / f64::from(1 << 30));
        tracing::info!(
            "the photographs take {bytes:.1} GiB decoded, the cache has {most:.1}: they are read anew when they are looked at"
        );
    }
    LoadOptions { keep, ..options.clone() }
}

/// A photograph that was shrunk on loading, or is not kept.
#[derive(Clone, Debug)]
pub struct Original {
    path: PathBuf,
    /// Fitted to the photograph's size.
    lens: Lens,
    /// As [`LoadOptions::undistort`].
    undistort: bool,
}

impl Original {
    /// Reads it anew, undistorted, at its own size.
    pub(super) fn load(&self) -> Result<Image> {
        self.load_at((self.lens.width, self.lens.height))
    }

    /// The same, shrunk.
    pub(super) fn load_at(&self, size: (u32, u32)) -> Result<Image> {
        let Self { path, lens, undistort } = self;
        let undistortion = undistortion(lens, *undistort, &path.to_string_lossy())?;
        prepared(loaded(path, lens)?, path, lens, undistortion.as_ref(), size)
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

/// Refuses a file by the size that it declares, before that costs memory: a picture of another shape than its camera's, or
/// of far more pixels.
fn check_size(path: &Path, lens: &Lens) -> Result<()> {
    // What has no readable header is named when it is decoded.
    let Ok(size) = Image::size_of(path) else { return Ok(()) };
    let (width, height) = turn(path, size, lens).size(size);
    if lens.fitted(width, height).is_none() {
        return Err(disagreement(path, size, lens));
    }
    check_excess(path, (width, height), lens)
}

fn check_excess(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Result<()> {
    const MOST_TIMES: u64 = 64;
    let pixels = |width: u32, height: u32| u64::from(width) * u64::from(height);
    if pixels(width, height) > MOST_TIMES * pixels(lens.width, lens.height) {
        let (w, h) = (lens.width, lens.height);
        let problem = format!(
            "is {width}x{height}, over {MOST_TIMES} times the pixels of its view's {w}x{h}; shrink it"
        );
        return Err(Error::input(path, problem));
    }
    Ok(())
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
fn load_group(
    lens: &Lens,
    group: &[Source],
    options: &LoadOptions,
    at_once: usize,
) -> Result<Vec<Loaded>> {
    let size = options.loaded_size(lens.width, lens.height);
    let name = group.first().map_or("", |source| source.name.as_str());
    if lens.width.min(lens.height) < MIN_SIDE {
        let (width, height) = (lens.width, lens.height);
        let problem = format!(
            "is of {width}x{height} pixels, at least {MIN_SIDE} each way are needed; leave it out of the listing"
        );
        return Err(Error::input(format!("view {name}"), problem));
    }
    if size.0.min(size.1) < MIN_SIDE {
        return Err(Error::Usage(format!(
            "downscale {} leaves {}x{} pixels of view {name}, at least {MIN_SIDE} are needed; lower it",
            options.downscale, size.0, size.1
        )));
    }
    let undistortion = undistortion(lens, options.undistort, name)?;
    if undistortion.as_ref().is_some_and(|undistortion| undistortion.is_cropped) {
        tracing::warn!(
            "view {name} and {} more are of a fisheye that sees farther off its axis than the {WIDEST} degrees at the corners of what is trained on; the rest is cropped, without `--undistort` it is not",
            group.len() - 1
        );
    }
    let mut loaded = vec![];
    for sources in group.chunks(at_once) {
        let views = sources.par_iter().cloned();
        let views =
            views.map(|source| load_view(source, lens, undistortion.as_ref(), size, options));
        loaded.extend(views.collect::<Result<Vec<_>>>()?);
    }
    Ok(loaded)
}

/// What makes a pinhole of the lens; none where it is rendered as it is.
///
/// # Errors
/// The distortion describes no lens: no pinhole sees inside the photograph only, or a fisheye shows too little of it.
fn undistortion(lens: &Lens, undistort: bool, name: &str) -> Result<Option<Undistortion>> {
    let native = lens.model().filter(|&model| model == CameraModel::Pinhole || !undistort);
    let undistortion = match native {
        Some(_) => shows_enough(lens).then_some(None),
        None => Undistortion::new(lens).map(Some),
    };
    undistortion.ok_or_else(|| {
        let problem = "its distortion coefficients describe no lens; calibrate again or undistort with COLMAP";
        Error::input(name, problem)
    })
}

/// Whether a lens that is rendered as it is shows something at a quarter of its pixels at least: the circle of a fisheye in a
/// wide picture covers more.
fn shows_enough(lens: &Lens) -> bool {
    const LEAST: f64 = 0.25;
    let unseen = native_camera(lens).unseen().len() as f64;
    unseen <= (1.0 - LEAST) * pixels(lens.width, lens.height) as f64
}

/// A lens at the world's origin, as it is rendered where it is not undistorted.
fn native_camera(lens: &Lens) -> Camera {
    Camera {
        width: lens.width,
        height: lens.height,
        focal: lens.focal,
        principal_point: lens.principal_point,
        model: lens.model().unwrap_or_default(),
        view_from_world: DAffine3::IDENTITY,
    }
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
        check_size(&path, lens)?;
        match loaded(&path, lens) {
            Ok(image) => prepared(image, &path, lens, undistortion, size).map(Some),
            Err(error) => {
                problems.push(error.to_string());
                Ok(None)
            }
        }
    };
    let is_shrunk = size != (lens.width, lens.height);
    let is_kept = options.keep.is_none();
    let original = input.clone().filter(|_| is_shrunk || !is_kept);
    let undistort = options.undistort;
    let file = |path| Original { path, lens: *lens, undistort };
    let original = original.map(file);
    let reference_file = reference.clone().filter(|_| !is_kept).map(file);
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
    let camera = Camera { view_from_world, ..native_camera(lens) };
    let camera = match undistortion {
        Some(&Undistortion { focal, .. }) => {
            Camera { focal, model: CameraModel::Pinhole, ..camera }
        }
        None => camera,
    };
    let camera = camera.resized(size.0, size.1);
    let mask = Mask::hiding_too(hidden.transpose()?.flatten(), size, &camera.unseen());
    if mask.as_ref().is_some_and(Mask::hides_all) {
        problems.push(format!("{name}: no pixel is a number that its mask shows"));
        (image, reference) = (None, None);
    }
    let depth = depth.and_then(|path| {
        depth_map(&path, lens, undistortion, size, options.depth.is_disparity)
            .map_err(|problem| tracing::warn!("the depth of view {name} is not used: {problem}"))
            .ok()
    });
    let original = original.filter(|_| image.is_some());
    let reference_file = reference_file.filter(|_| reference.is_some());
    let (image, reference) = (image.filter(|_| is_kept), reference.filter(|_| is_kept));
    let view = View::new(&name, split, camera, image);
    let view = View { original, reference, reference_file, mask, depth, ..view };
    let view = (split == Split::Test || view.has_photograph()).then_some(view);
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
    check_excess(path, Image::size_of(path)?, lens)?;
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
    if let Some(value) = depth.iter().find(|value| !value.is_finite()) {
        return Err(Error::input(path, format!("holds a depth of {value}")));
    }
    if depth.iter().all(|&value| value == depth[0]) {
        return Err(Error::input(path, "is the same everywhere"));
    }
    // Only ratios count; the squares of what lies beyond would not be floats.
    let largest = depth.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
    if !(1e-12..1e12).contains(&largest) {
        depth.iter_mut().for_each(|value| *value /= largest);
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
    let image = match undistortion {
        Some(undistortion) => undistortion.apply(&image),
        None => image,
    };
    Ok(if (image.width, image.height) == size { image } else { image.resized(size.0, size.1) })
}
