//! From files to views: decode, check against the camera, undistort, shrink. Parallel over views.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DAffine3, UVec2};
use rayon::prelude::*;

use super::packed::Packed;
use super::prepare::{disagreement, prepared};
use super::source::{MAX_READ, Source};
use super::undistort::{Undistortion, WIDEST};
use super::{LoadOptions, MeasuredSize, Split, View};
use crate::base::hash::Hasher;
use crate::camera::{Camera, CameraModel, Lens};
use crate::photographs::image::{Image, Mask, Orientation, PictureFile};
use crate::photographs::tone::MeasuredPhotograph;
use crate::{Error, Result};

/// The shortest side that leaves something to train on, pixels.
const MIN_SIDE: u32 = 16;

/// Of a decoded photograph.
const BYTES_PER_PIXEL: u64 = 12;

/// Sees a training photograph as it is stored, with its mask, while it is decoded; from any thread.
pub(crate) type Look<'a> = &'a (dyn Fn(&str, &Image, Option<&Mask>) + Sync);

/// The views in order of name. Files that do not decode are named in `skipped`.
pub(super) fn load(
    sources: Vec<Source>,
    options: &LoadOptions,
    look: Option<Look<'_>>,
    skipped: &mut Vec<String>,
) -> Result<Vec<View>> {
    let room = AtomicI64::new(MAX_READ);
    let sized = sources.into_par_iter().map(|mut source| {
        let sizes = source.sized(&room);
        Ok(Source { lens: fitted_lens(&source, sizes)?, ..source })
    });
    let mut groups: Vec<(Lens, Vec<Source>)> = Vec::new();
    let mut places = HashMap::new();
    for source in sized.collect::<Result<Vec<_>>>()? {
        // Debug tells every two lenses apart.
        let place = *places.entry(format!("{:?}", source.lens)).or_insert(groups.len());
        match groups.get_mut(place) {
            Some((_, group)) => group.push(source),
            None => groups.push((source.lens, vec![source])),
        }
    }
    let options = &resolved(&groups, options);
    let largest = groups.iter().map(|(lens, _)| pixels(lens.width, lens.height)).max();
    let at_once = Image::decoded_at_once(largest.unwrap_or_default());
    let stored = AtomicI64::new(original_budget(&groups, options));
    let loading = Loading { options, at_once, look, stored: &stored };
    let mut loaded: Vec<Loaded> = vec![];
    while !groups.is_empty() {
        // What was read goes with its group.
        let now: Vec<_> = groups.drain(..groups.len().min(at_once)).collect();
        let now = now.into_par_iter().map(|(lens, group)| load_group(&lens, group, &loading));
        loaded.extend(now.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    loaded.sort_by(|a, b| a.name.cmp(&b.name));
    let mut views = Vec::with_capacity(loaded.len());
    for Loaded { view, problems, .. } in loaded {
        views.extend(view);
        skipped.extend(problems);
    }
    Ok(views)
}

/// What loading the views has in common.
struct Loading<'a> {
    options: &'a LoadOptions,
    /// How many photographs are decoded side by side.
    at_once: usize,
    look: Option<Look<'a>>,
    /// Bytes that are left for photographs at their own size.
    stored: &'a AtomicI64,
}

/// What `keep` leaves, bytes, for the photographs at their own size that are shrunk: a curve that is applied to them there
/// needs the measurements of all first.
fn original_budget(groups: &[(Lens, Vec<Source>)], options: &LoadOptions) -> i64 {
    let Some(most) = options.keep.filter(|_| options.measured == MeasuredSize::Own) else {
        return 0;
    };
    let taken = kept_bytes(groups, options);
    most.saturating_sub(taken).try_into().unwrap_or(i64::MAX)
}

/// What photographs and reference images take as they are loaded.
fn kept_bytes(groups: &[(Lens, Vec<Source>)], options: &LoadOptions) -> u64 {
    let bytes = |(lens, group): &(Lens, Vec<Source>)| {
        let (width, height) = options.loaded_size(lens.width, lens.height);
        let pictures = group.iter().flat_map(|source| [&source.input, &source.reference]).flatten();
        pictures.count() as u64 * pixels(width, height) * BYTES_PER_PIXEL
    };
    groups.iter().map(bytes).sum()
}

fn pixels(width: u32, height: u32) -> u64 {
    u64::from(width) * u64::from(height)
}

/// The options, of which `keep` is 0 where the photographs exceed it: none is kept. Says where `max_resolution` acts.
fn resolved(groups: &[(Lens, Vec<Source>)], options: &LoadOptions) -> LoadOptions {
    let bytes = kept_bytes(groups, options);
    let mut shrunk: Vec<&Lens> = vec![];
    for (lens, _) in groups {
        let (width, height) = options.loaded_size(lens.width, lens.height);
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
    let excess = options.keep.filter(|&most| bytes > most);
    if let Some(most) = excess {
        let [bytes, most] = [bytes, most].map(|bytes| bytes as f64 / f64::from(1 << 30));
        tracing::info!(
            "the photographs take {bytes:.1} GiB decoded, the cache has {most:.1}: they are read anew when they are looked at"
        );
    }
    let keep = if excess.is_some() { Some(0) } else { options.keep };
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
    /// At which size, and what.
    measured: Option<(MeasuredSize, MeasuredPhotograph)>,
    /// Of the pixels as they are loaded, where they are not kept.
    checksum: Option<Hasher>,
    /// The photograph at its own size, while there is room and until it is released.
    stored: Arc<Mutex<Option<Packed>>>,
}

impl Original {
    fn of(path: PathBuf, lens: Lens, undistort: bool) -> Self {
        Self { path, lens, undistort, measured: None, checksum: None, stored: Arc::default() }
    }

    /// Width and height, undistorted.
    pub(super) fn size(&self) -> UVec2 {
        UVec2::new(self.lens.width, self.lens.height)
    }

    /// Undistorted, at its own size: as it was kept, or read anew.
    pub(super) fn load(&self) -> Result<Image> {
        let stored = self.stored.lock().unwrap_or_else(PoisonError::into_inner);
        match &*stored {
            Some(packed) => Ok(packed.image()),
            None => self.load_at((self.lens.width, self.lens.height)),
        }
    }

    /// Read anew, undistorted and shrunk.
    pub(super) fn load_at(&self, size: (u32, u32)) -> Result<Image> {
        let Self { path, lens, undistort, .. } = self;
        let undistortion = undistortion(lens, *undistort, &path.to_string_lossy())?;
        let (image, _) = PictureFile::open(path)?.decode()?;
        let orientation = turn(path, (image.width, image.height), lens);
        prepared(image.turned(orientation), path, lens, undistortion.as_ref(), size)
    }

    /// What was measured of it at a size while it was decoded.
    pub(crate) fn measured(&self, size: MeasuredSize) -> Option<&MeasuredPhotograph> {
        self.measured.as_ref().filter(|(own, _)| *own == size).map(|(_, measured)| measured)
    }

    /// Of the pixels as they are loaded, where they are not kept.
    pub(super) fn checksum(&self) -> Option<Hasher> {
        self.checksum
    }

    /// Keeps it no longer in memory.
    pub(crate) fn release(&self) {
        *self.stored.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

struct Loaded {
    name: String,
    /// `None`: a training view whose photograph does not decode.
    view: Option<View>,
    problems: Vec<String>,
}

/// The listed lens over the photograph as it is: the input's size, without one the reference image's.
fn fitted_lens(source: &Source, sizes: [Option<(u32, u32)>; 2]) -> Result<Lens> {
    let lens = source.lens;
    // What has no readable header is named when it is decoded.
    let sized = [&source.input, &source.reference].into_iter().zip(sizes);
    let mut sized = sized.filter_map(|(path, size)| {
        let (path, size) = (path.as_deref()?, size?);
        Some((path, turn(path, size, &lens).size(size)))
    });
    let Some((path, (width, height))) = sized.next() else {
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
    let printed = Orientation::of(path);
    let (width, height) = printed.size((width, height));
    if lens.fitted(width, height).is_some() { printed } else { Orientation::UPRIGHT }
}

/// Refuses a file by the size that it declares, before that costs memory: a picture of another shape than its camera's, or
/// of far more pixels.
fn check_size(path: &Path, file: &PictureFile, lens: &Lens) -> Result<()> {
    // What has no readable header is named when it is decoded.
    let Ok(size) = file.size() else { return Ok(()) };
    let (width, height) = turn(path, size, lens).size(size);
    if lens.fitted(width, height).is_none() {
        return Err(disagreement(path, size, lens));
    }
    check_excess(path, (width, height), lens)
}

fn check_excess(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Result<()> {
    const MAX_TIMES: u64 = 64;
    let pixels = |width: u32, height: u32| u64::from(width) * u64::from(height);
    if pixels(width, height) > MAX_TIMES * pixels(lens.width, lens.height) {
        let (w, h) = (lens.width, lens.height);
        let problem = format!(
            "is {width}x{height}, over {MAX_TIMES} times the pixels of its view's {w}x{h}; shrink it"
        );
        return Err(Error::input(path, problem));
    }
    Ok(())
}

/// Views of one lens share its undistortion map.
fn load_group(lens: &Lens, mut group: Vec<Source>, loading: &Loading<'_>) -> Result<Vec<Loaded>> {
    let options = loading.options;
    let size = options.loaded_size(lens.width, lens.height);
    let first = group.first().map(|source| source.name.clone()).unwrap_or_default();
    let name = first.as_str();
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
    let lens = &Prepared { lens, undistortion: undistortion.as_ref(), size };
    let mut loaded = vec![];
    while !group.is_empty() {
        let now: Vec<_> = group.drain(..group.len().min(loading.at_once)).collect();
        let views = now.into_par_iter().map(|source| load_view(source, lens, loading));
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

/// How the photographs of a lens become those of a pinhole.
struct Prepared<'a> {
    lens: &'a Lens,
    undistortion: Option<&'a Undistortion>,
    /// As they are loaded.
    size: (u32, u32),
}

/// A picture of a view.
struct Decoded {
    path: PathBuf,
    /// As it is stored.
    image: Image,
    alpha: Option<Image>,
    orientation: Orientation,
}

impl Prepared<'_> {
    /// Decodes a file; none, and a problem, where that is no picture.
    ///
    /// # Errors
    /// The picture does not fit its camera.
    fn decode(
        &self,
        (path, read): (Option<PathBuf>, Option<Arc<PictureFile>>),
        problems: &mut Vec<String>,
    ) -> Result<Option<Decoded>> {
        let Some(path) = path else { return Ok(None) };
        let file =
            read.map_or_else(|| PictureFile::open(&path), |read| Ok(Arc::unwrap_or_clone(read)));
        if let Ok(file) = &file {
            check_size(&path, file, self.lens)?;
        }
        match file.and_then(PictureFile::decode) {
            Ok((image, alpha)) => {
                let orientation = turn(&path, (image.width, image.height), self.lens);
                Ok(Some(Decoded { path, image, alpha, orientation }))
            }
            Err(error) => {
                problems.push(error.to_string());
                Ok(None)
            }
        }
    }

    /// As the camera sees it, of its own size.
    fn whole(&self, Decoded { path, image, orientation, .. }: Decoded) -> Result<Image> {
        let size = (self.lens.width, self.lens.height);
        prepared(image.turned(orientation), &path, self.lens, self.undistortion, size)
    }

    fn shrunk(&self, image: Image) -> Image {
        let (width, height) = self.size;
        if (image.width, image.height) == self.size { image } else { image.resized(width, height) }
    }

    /// What stays of a photograph of its own size: itself as it is loaded, and where it is read from if that is not all of it.
    /// One that is for training, for which there is `room`, is measured.
    fn kept(
        &self,
        path: PathBuf,
        whole: Image,
        mask: Option<&Mask>,
        room: Option<&AtomicI64>,
        options: &LoadOptions,
    ) -> (Option<Image>, Option<Original>) {
        let (is_shrunk, is_kept) =
            (self.size != (whole.width, whole.height), options.keep != Some(0));
        if is_kept && !is_shrunk {
            return (Some(whole), None);
        }
        let mut original = Original::of(path, *self.lens, options.undistort);
        let measured = |image: &Image| match mask {
            Some(mask) => MeasuredPhotograph::of(&mask.counted(image)),
            None => MeasuredPhotograph::of(&image.data),
        };
        let at = if room.is_some() { options.measured } else { MeasuredSize::None };
        if at == MeasuredSize::Own {
            original.measured = Some((at, measured(&whole)));
        }
        let bytes = Packed::bytes(&whole);
        let has_room = |room: &AtomicI64| {
            let is_left = room.fetch_sub(bytes, Ordering::Relaxed) >= bytes;
            room.fetch_add(if is_left { 0 } else { bytes }, Ordering::Relaxed);
            is_left
        };
        if is_shrunk && at == MeasuredSize::Own && room.is_some_and(has_room) {
            original.stored = Arc::new(Mutex::new(Some(Packed::of(&whole))));
        }
        let image = self.shrunk(whole);
        if is_kept {
            return (Some(image), Some(original));
        }
        if at == MeasuredSize::Loaded {
            original.measured = Some((at, measured(&image)));
        }
        let mut hasher = Hasher::default();
        hasher.write(bytemuck::cast_slice(&image.data));
        original.checksum = Some(hasher);
        (None, Some(original))
    }
}

fn load_view(source: Source, lens: &Prepared<'_>, loading: &Loading<'_>) -> Result<Loaded> {
    let Source { name, split, view_from_world, input, reference, mask, depth, read, .. } = source;
    let (options, [read, read_reference]) = (loading.options, read);
    let mut problems = Vec::new();
    let photograph = lens.decode((input, read), &mut problems)?;
    let reference = lens.decode((reference, read_reference), &mut problems)?;
    let stored_mask = match photograph.as_ref().or(reference.as_ref()) {
        Some(Decoded { path, image, alpha, orientation }) => {
            let decoded = (image, alpha.as_ref());
            Mask::over(path, decoded, mask.as_deref(), options.invert_masks)?
                .map(|stored| (stored, path.clone(), *orientation))
        }
        None => None,
    };
    if let (Some(look), Some(photograph), Split::Train) = (loading.look, &photograph, split) {
        look(&name, &photograph.image, stored_mask.as_ref().map(|(stored, ..)| stored));
    }
    let Prepared { lens: own, undistortion, size } = *lens;
    let mask = stored_mask.map(|(stored, path, orientation)| {
        seen_mask(&stored, &path, (own, orientation), undistortion, size)
    });
    let camera = Camera { view_from_world, ..native_camera(own) };
    let camera = match undistortion {
        Some(&Undistortion { focal, .. }) => {
            Camera { focal, model: CameraModel::Pinhole, ..camera }
        }
        None => camera,
    };
    let camera = camera.resized(size.0, size.1);
    let mask = Mask::hiding_too(mask.transpose()?.flatten(), size, &camera.unseen());
    let is_hidden = mask.as_ref().is_some_and(Mask::hides_all);
    if is_hidden {
        problems.push(format!("{name}: no pixel is a number that its mask shows"));
    }
    let is_kept = options.keep != Some(0);
    let of_reference = |reference: Decoded| {
        let file =
            (!is_kept).then(|| Original::of(reference.path.clone(), *own, options.undistort));
        let image = is_kept.then(|| lens.whole(reference).map(|image| lens.shrunk(image)));
        Ok((image.transpose()?, file))
    };
    let photograph = photograph.filter(|_| !is_hidden).map(|decoded| {
        let is_training = split == Split::Train;
        let (path, whole) = (decoded.path.clone(), lens.whole(decoded)?);
        Ok(lens.kept(path, whole, mask.as_ref(), is_training.then_some(loading.stored), options))
    });
    let (image, original) = photograph.transpose()?.unwrap_or_default();
    let reference = reference.filter(|_| !is_hidden).map(of_reference);
    let (reference, reference_file) = reference.transpose()?.unwrap_or_default();
    let depth = depth.and_then(|path| {
        depth_map(&path, own, undistortion, size, options.depth.is_disparity)
            .map_err(|problem| tracing::warn!("the depth of view {name} is not used: {problem}"))
            .ok()
    });

    let view = View::new(&name, split, camera, image);
    let view = View { original, reference, reference_file, mask, depth, ..view };
    let view = (split == Split::Test || view.has_photograph()).then_some(view);
    Ok(Loaded { name, view, problems })
}

/// Which pixels of a view count, as its camera sees them, of its mask as its photograph is stored; none where all do.
fn seen_mask(
    stored: &Mask,
    photograph: &Path,
    (lens, orientation): (&Lens, Orientation),
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
) -> Result<Option<Mask>> {
    let plane = stored.to_image().turned(orientation);
    Ok(Mask::of_plane(&prepared(plane, photograph, lens, undistortion, size)?))
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
