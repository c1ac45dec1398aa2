//! From files to views: decode, check against the camera, undistort, downscale. Parallel over views.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use nightsplat_core::camera::{Camera, Lens};
use nightsplat_core::hash::Hasher;
use nightsplat_core::watch::Stage;
use nightsplat_core::{Error, Result};
use rayon::prelude::*;

use super::allowance::Allowance;
use super::borders::Borders;
use super::dark_references;
use super::depth::depth_map;
use super::layout::DatasetLayout;
use super::loaded::LoadedView;
use super::original::Original;
use super::packed::Packed;
use super::points;
use super::prepare::{Preparation, check_size, disagreement, pixel_count};
use super::shading::Shading;
use super::source::{MAX_READ, ViewFiles};
use super::tracked;
use super::turns::{CameraPixels, ImageHeader, Turns};
use super::undistort::WIDEST;
use super::{LoadOptions, MeasuredSize, Split, View};
use crate::image::decoded_at_once;
use crate::image::{ColourCounts, Image, Levels, Mask, MaskFile, Orientation, PictureFile};
use crate::tone::MeasuredPhotograph;
use crate::white_balance::WhiteBalanceMatrix;

/// The minimum side of a view, pixels.
const MIN_SIDE: u32 = 16;

/// Size of a decoded pixel.
const BYTES_PER_PIXEL: u64 = 12;

/// Sees a training photograph as it is stored, with its mask, while it is decoded; from any thread.
pub type PhotographObserver<'a> = &'a (dyn Fn(&str, &Image, Option<&Mask>) + Sync);

/// The headers of photograph and reference image of each view.
type Headers = Vec<[Option<ImageHeader>; 2]>;

/// Reads the files while memory allows.
pub(super) fn headers(sources: &mut [ViewFiles], options: &LoadOptions) -> Headers {
    let memory = Allowance::new(MAX_READ);
    sources.par_iter_mut().map(|source| source.headers(&memory, options)).collect()
}

/// The views in order of name. Files that cannot be decoded are named in `skipped`. Levels that a photograph exceeds
/// become those of its format, and all are decoded again.
pub(super) fn load(
    (sources, headers): (Vec<ViewFiles>, Headers),
    layout: &DatasetLayout,
    options: &LoadOptions,
    observer: Option<PhotographObserver<'_>>,
    levels: &mut Levels,
    balance: Option<WhiteBalanceMatrix>,
    skipped: &mut Vec<String>,
) -> Result<Vec<View>> {
    let others = skipped.len();
    if levels.are_limits() {
        let views = load_with(
            (sources.clone(), headers.clone()),
            layout,
            options,
            observer,
            *levels,
            balance,
            skipped,
        )?;
        if let Some(views) = views {
            return Ok(views);
        }
        skipped.truncate(others);
        *levels = Levels::as_stored(options.light);
    }
    let views =
        load_with((sources, headers), layout, options, observer, *levels, balance, skipped)?;
    Ok(views.unwrap_or_default())
}

/// The views at these levels; `None` if a photograph exceeds them.
fn load_with(
    (sources, headers): (Vec<ViewFiles>, Headers),
    layout: &DatasetLayout,
    options: &LoadOptions,
    observer: Option<PhotographObserver<'_>>,
    levels: Levels,
    balance: Option<WhiteBalanceMatrix>,
    skipped: &mut Vec<String>,
) -> Result<Option<Vec<View>>> {
    let of_photographs: Vec<Option<ImageHeader>> =
        headers.iter().map(|[photograph, _]| *photograph).collect();
    let points = || points::of_sources(layout, &sources);
    let pixels = tracked::pixels(&sources, &of_photographs, options.orientation, points)?;
    let fitted = sources.into_par_iter().zip(headers).map(|(mut source, headers)| {
        let listed = source.lens;
        source.fit(headers, pixels)?;
        Ok((listed, source))
    });
    let fitted = fitted.collect::<Result<Vec<_>>>()?;
    say_of_patches(&fitted);
    let mut groups: Vec<LensGroup> = Vec::new();
    let mut indices = HashMap::new();
    for (_, source) in fitted {
        // The Debug output distinguishes all lenses.
        let key = format!("{:?} {:?}", source.lens, source.size);
        let index = *indices.entry(key).or_insert(groups.len());
        match groups.get_mut(index) {
            Some(group) => group.files.push(source),
            None => groups.push(LensGroup::new(source)),
        }
    }
    let options = &resolved(&groups, options);
    let borders = Borders::of_sources(groups.iter().flat_map(|group| &group.files), options);
    let largest = groups.iter().map(|group| pixel_count((group.lens.width, group.lens.height)));
    let at_once = decoded_at_once(largest.max().unwrap_or_default());
    let originals = Allowance::new(bytes_for_originals(&groups, options));
    let colours = [ColourCounts::of_levels(levels), ColourCounts::new("reference image")];
    let count = groups.iter().map(|group| group.files.len()).sum();
    let loading = Loading {
        stage: Stage::begin("decoding photographs", count),
        options,
        at_once,
        observer,
        balance,
        originals: &originals,
        borders: &borders,
        colours: &colours,
    };
    let mut loaded: Vec<LoadedView> = vec![];
    while !groups.is_empty() {
        // Files that were read are dropped with their group.
        let now: Vec<_> = groups.drain(..groups.len().min(at_once)).collect();
        let now = now.into_par_iter().map(|group| load_group(group, &loading));
        loaded.extend(now.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    if colours[0].is_beyond() {
        return Ok(None);
    }
    colours.iter().for_each(ColourCounts::log);
    loaded.sort_by(|a, b| a.name.cmp(&b.name));
    dark_references::drop_from(&mut loaded, options);
    let mut views = Vec::with_capacity(loaded.len());
    for LoadedView { view, problems, .. } in loaded {
        views.extend(view);
        skipped.extend(problems);
    }
    Ok(Some(views))
}

/// Says where cameras are of a network's input, from their listed lenses.
fn say_of_patches(fitted: &[(Lens, ViewFiles)]) {
    let is_of_patches = |(listed, source): &&(Lens, ViewFiles)| {
        listed.fitted(source.size.0, source.size.1).is_none()
    };
    let count = fitted.iter().filter(is_of_patches).count();
    if let Some((listed, ViewFiles { name, size: (width, height), .. })) =
        fitted.iter().find(is_of_patches)
    {
        tracing::warn!(
            "{count} cameras are of a network's input, rounded to 14 pixels each way ({name}: {}x{}, the photograph \
             {width}x{height}): scaled for each axis",
            listed.width,
            listed.height
        );
    }
}

/// Files of one lens.
struct LensGroup {
    /// At the size that the photographs are decoded at.
    lens: Lens,
    /// The size of the photographs.
    size: (u32, u32),
    files: Vec<ViewFiles>,
}

impl LensGroup {
    fn new(source: ViewFiles) -> Self {
        Self { lens: source.lens, size: source.size, files: vec![source] }
    }

    fn loaded_size(&self, options: &LoadOptions) -> (u32, u32) {
        options.loaded_size(self.size.0, self.size.1)
    }
}

/// What loading the views has in common.
struct Loading<'a> {
    stage: Stage,
    options: &'a LoadOptions,
    /// Number of photographs that are decoded concurrently.
    at_once: usize,
    observer: Option<PhotographObserver<'a>>,
    /// White balance of the photographs.
    balance: Option<WhiteBalanceMatrix>,
    /// For photographs at their own size.
    originals: &'a Allowance,
    /// Black borders of photographs by their size as stored.
    borders: &'a Borders,
    /// What was made of the colours of photographs and of reference images.
    colours: &'a [ColourCounts; 2],
}

/// Bytes that `keep` leaves for photographs at their original size, if a curve is applied at that size: it requires the
/// statistics of all of them first.
fn bytes_for_originals(groups: &[LensGroup], options: &LoadOptions) -> u64 {
    let most = options.keep.filter(|_| options.measured == MeasuredSize::Own);
    most.unwrap_or_default().saturating_sub(kept_bytes(groups, options))
}

/// Bytes of the photographs and reference images as loaded.
fn kept_bytes(groups: &[LensGroup], options: &LoadOptions) -> u64 {
    let bytes = |group: &LensGroup| {
        let size = group.loaded_size(options);
        let pictures =
            group.files.iter().flat_map(|source| [&source.input, &source.reference]).flatten();
        pictures.count() as u64 * pixel_count(size) * BYTES_PER_PIXEL
    };
    groups.iter().map(bytes).sum()
}

/// The options, of which `keep` is 0 where the photographs exceed it: none is kept. Says where `max_resolution` acts.
fn resolved(groups: &[LensGroup], options: &LoadOptions) -> LoadOptions {
    let bytes = kept_bytes(groups, options);
    let free = LoadOptions { max_resolution: 0, ..options.clone() };
    let is_shrunk = |group: &&LensGroup| group.loaded_size(&free) != group.loaded_size(options);
    let shrunk: Vec<&LensGroup> = groups.iter().filter(is_shrunk).collect();
    if let Some(group) = shrunk.first() {
        let (width, height) = group.loaded_size(options);
        let ((w, h), limit) = (group.size, options.max_resolution);
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
            "the photographs take {bytes:.1} GiB decoded, the cache has {most:.1}: they are read anew when they are \
             looked at"
        );
    }
    let keep = if excess.is_some() { Some(0) } else { options.keep };
    LoadOptions { keep, ..options.clone() }
}

impl ViewFiles {
    /// Finds the rotation of its images, and fits the listed lens to the photograph, or to the reference image if there
    /// is none.
    fn fit(&mut self, headers: [Option<ImageHeader>; 2], pixels: CameraPixels) -> Result<()> {
        let lens = self.lens;
        // What has no readable header is named when it is decoded.
        let turns = |header: ImageHeader| Turns::new(header, &lens, pixels);
        self.turns = headers.map(|header| header.map(turns).unwrap_or_default());
        let sizes = headers.into_iter().zip(self.turns).map(|(header, turns)| {
            let header = header?;
            Some([header.size, header.decoded_size].map(|size| turns.loading.size(size)))
        });
        let mut sized = [&self.input, &self.reference].into_iter().zip(sizes);
        let sized = sized.find_map(|(path, size)| Some((path.as_deref()?, size?)));
        let Some((path, [(width, height), decoded])) = sized else { return Ok(()) };
        self.size = (width, height);
        let fitted = lens.fitted(width, height).or_else(|| lens.fitted_from_patches(width, height));
        self.lens = fitted
            .and_then(|fitted| fitted.fitted(decoded.0, decoded.1))
            .ok_or_else(|| disagreement(path, (width, height), &lens))?;
        if (width, height) != (lens.width, lens.height) {
            tracing::info!(
                "{}: is {width}x{height}, its camera {}x{}; intrinsics rescaled",
                path.display(),
                lens.width,
                lens.height
            );
        }
        Ok(())
    }
}

/// Loads the views of one lens.
fn load_group(group: LensGroup, loading: &Loading<'_>) -> Result<Vec<LoadedView>> {
    let options = loading.options;
    let size = group.loaded_size(options);
    let LensGroup { lens, files: mut group, .. } = group;
    let lens = &lens;
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
    let preparation = Preparation::new(lens, options.undistort, size, name)?;
    preparation.check_coverage(name)?;
    if preparation.undistortion.as_ref().is_some_and(|undistortion| undistortion.is_cropped) {
        tracing::warn!(
            "view {name} and {} more are of a fisheye that sees more than {WIDEST} degrees off its axis; \
             undistorting crops the rest, without `--undistort` it stays",
            group.len() - 1
        );
    }
    let camera = preparation.camera();
    let views = ViewLoader { preparation, unseen: camera.unseen(), camera, loading };
    let mut loaded = vec![];
    while !group.is_empty() {
        let now: Vec<_> = group.drain(..group.len().min(loading.at_once)).collect();
        let now = now.into_par_iter().map(|source| {
            loading.stage.next()?;
            views.load(source)
        });
        loaded.extend(now.collect::<Result<Vec<_>>>()?);
    }
    Ok(loaded)
}

/// The mean of a subset of an image's values.
fn mean(image: &Image) -> f32 {
    let some = image.data.iter().step_by(97);
    let count = some.len().max(1) as f32;
    some.sum::<f32>() / count
}

/// Loads the views of one lens.
struct ViewLoader<'a> {
    preparation: Preparation<'a>,
    /// At the world's origin.
    camera: Camera,
    /// The pixels of `camera` that a fisheye does not see.
    unseen: Vec<usize>,
    loading: &'a Loading<'a>,
}

/// A picture of a view.
struct DecodedPicture {
    path: PathBuf,
    /// As it is stored.
    image: Image,
    alpha: Option<Image>,
    turns: Turns,
    /// Whether the file holds linear light.
    is_light: bool,
    /// Its size as it is decoded, if that is known from its header.
    decoded_size: Option<(u32, u32)>,
}

impl DecodedPicture {
    /// Its file, to be read again.
    fn original(&self, lens: &Lens, undistort: bool) -> Original {
        let mut original = Original::new(self.path.clone(), *lens, undistort, self.turns);
        original.decoded_size = self.decoded_size;
        original
    }
}

/// The pixels of a photograph or reference image as loaded, and its file if these are not all of it.
type InMemory = (Option<Image>, Option<Original>);

impl ViewLoader<'_> {
    fn load(&self, source: ViewFiles) -> Result<LoadedView> {
        let Self { preparation, camera, unseen, loading } = self;
        let ViewFiles {
            name,
            split,
            view_from_world,
            input,
            reference,
            target,
            mask: mask_file,
            depth,
            read,
            turns,
            size,
            ..
        } = source;
        let (options, [read, read_reference]) = (loading.options, read);
        let mut problems = Vec::new();
        let [colours, reference_colours] = loading.colours;
        let mut photograph = self.decode(input, read, turns[0], colours, &mut problems)?;
        if let (Some(balance), Some(photograph)) = (loading.balance, &mut photograph) {
            balance.apply(&mut photograph.image);
        }
        let reference =
            self.decode(reference, read_reference, turns[1], reference_colours, &mut problems)?;
        let picture = photograph.as_ref().or(reference.as_ref());
        let orientation = picture.map(|picture| picture.turns.viewing).unwrap_or_default();
        let mut file_that_hides = None;
        let stored_mask = match picture {
            Some(DecodedPicture { path, image, alpha, turns, .. }) => {
                let decoded = (image, alpha.as_ref());
                let stored = Mask::over(path, decoded, mask_file.as_ref(), options.invert_masks)?;
                let hides = |mask: &&MaskFile| {
                    let is_all = alpha.is_none() && stored.as_ref().is_some_and(Mask::hides_all);
                    is_all && mask.is_inverted == options.invert_masks
                };
                file_that_hides = mask_file.as_ref().filter(hides);
                let stored = loading.borders.hide_borders(stored, (image.width, image.height));
                stored.map(|stored| (stored, path.clone(), turns.loading))
            }
            None => None,
        };
        if let (Some(observer), Some(photograph), Split::Train) =
            (loading.observer, &photograph, split)
        {
            observer(&name, &photograph.image, stored_mask.as_ref().map(|(stored, ..)| stored));
        }
        let mask = stored_mask
            .map(|(stored, path, orientation)| preparation.mask(&stored, &path, orientation));
        let mask = Mask::masked_at(mask.transpose()?.flatten(), preparation.size, unseen);
        let brightness = [&photograph, &reference]
            .map(|decoded| decoded.as_ref().map(|decoded| mean(&decoded.image)));
        let reference_original =
            reference.as_ref().map(|decoded| decoded.original(preparation.lens, options.undistort));
        let is_hidden = mask.as_ref().is_some_and(Mask::hides_all);
        if is_hidden {
            problems.push(match file_that_hides {
                Some(MaskFile { path, .. }) => {
                    let path = path.display();
                    format!("{name}: {path}: the mask is black everywhere; white pixels count")
                }
                None => format!("{name}: no pixel is a number that its mask shows"),
            });
        }
        let shading = Shading::new(options.falloff, options.bands.as_ref(), &name);
        let photograph = photograph
            .filter(|_| !is_hidden)
            .map(|decoded| self.photograph(decoded, mask.as_ref(), shading, split == Split::Train));
        let (image, original) = photograph.transpose()?.unwrap_or_default();
        let reference =
            reference.filter(|_| !is_hidden).map(|decoded| self.reference_image(decoded));
        let (reference, reference_file) = reference.transpose()?.unwrap_or_default();
        let target_file = target.map(|path| self.target(path, turns[0], size)).transpose()?;
        let unused = |problem| tracing::warn!("the depth of view {name} is not used: {problem}");
        let depth = depth.and_then(|path| {
            depth_map(&path, preparation, options.depth.is_disparity).map_err(unused).ok()
        });
        let view = View::new(&name, split, Camera { view_from_world, ..*camera }, image);
        let unit = colours.levels().unit();
        let view =
            View { orientation, original, unit, reference, reference_file, mask, depth, ..view };
        let view = View { target_file, ..view };
        let view = (split == Split::Test || view.has_photograph()).then_some(view);
        Ok(LoadedView { name, view, problems, brightness, reference: reference_original })
    }

    /// Decodes a file; `None`, and a problem, where that is no picture.
    fn decode(
        &self,
        path: Option<PathBuf>,
        read: Option<Arc<PictureFile>>,
        turns: Turns,
        colours: &ColourCounts,
        problems: &mut Vec<String>,
    ) -> Result<Option<DecodedPicture>> {
        let lens = self.preparation.lens;
        let Some(path) = path else { return Ok(None) };
        let options = self.loading.options;
        let file = match read {
            Some(read) => Ok(Arc::unwrap_or_clone(read)),
            None => {
                let file = PictureFile::open(&path);
                file.map(|file| file.reduced(|size| options.decoded_size(size)))
            }
        };
        let decoded_size = file.as_ref().ok().and_then(|file| file.decoded_size().ok());
        if let Ok(file) = &file {
            check_size(&path, file, turns, lens)?;
        }
        let is_light = file.as_ref().is_ok_and(|file| file.is_light(&colours.levels()));
        match file.and_then(|file| file.decode_counted(colours)) {
            Ok((image, alpha)) => {
                Ok(Some(DecodedPicture { path, image, alpha, turns, is_light, decoded_size }))
            }
            Err(error) => {
                problems.push(error.to_string());
                Ok(None)
            }
        }
    }

    /// The photograph of a view; one for training is measured as the options say.
    fn photograph(
        &self,
        decoded: DecodedPicture,
        mask: Option<&Mask>,
        shading: Shading,
        is_training: bool,
    ) -> Result<InMemory> {
        let Self { preparation, loading, .. } = self;
        let options = loading.options;
        let mut original = decoded.original(preparation.lens, options.undistort);
        let DecodedPicture { path, image, turns, is_light, .. } = decoded;
        let whole = preparation.photograph(turns.loading.upright(image), &path, shading)?;
        let whole = if is_light { preparation.shrunk_in_light(whole) } else { whole };
        let is_shrunk = preparation.size != (whole.width, whole.height);
        let is_kept = options.keep != Some(0);
        if is_kept && !is_shrunk {
            return Ok((Some(whole), None));
        }
        (original.balance, original.shading) = (loading.balance, shading);
        original.levels = loading.colours[0].levels();
        original.light_size = is_light.then_some(preparation.size);
        let measured = |image: &Image| match mask {
            Some(mask) => MeasuredPhotograph::measure(&mask.counted(image)),
            None => MeasuredPhotograph::measure(&image.data),
        };
        let at = if is_training { options.measured } else { MeasuredSize::None };
        if at == MeasuredSize::Own {
            original.measured = Some((at, measured(&whole)));
            if is_shrunk {
                let packed = Packed::new(&whole);
                if loading.originals.take(packed.bytes()) {
                    original.store(packed);
                }
            }
        }
        let image = preparation.shrunk(whole);
        if is_kept {
            return Ok((Some(image), Some(original)));
        }
        if at == MeasuredSize::Loaded {
            original.measured = Some((at, measured(&image)));
        }
        let mut hasher = Hasher::default();
        hasher.write(bytemuck::cast_slice(&image.data));
        original.checksum = Some(hasher);
        Ok((None, Some(original)))
    }

    /// The file of a target, which has the size of its photograph, as it is stored or turned as the camera took it.
    fn target(&self, path: PathBuf, turns: Turns, taken: (u32, u32)) -> Result<Original> {
        let size = PictureFile::open(&path)?.size()?;
        let Preparation { lens, size: loaded, .. } = self.preparation;
        let sizes = [taken, (lens.width, lens.height), loaded];
        let loading = match [turns.loading, Orientation::UPRIGHT, turns.viewing.inverse()]
            .into_iter()
            .find(|turn| sizes.contains(&turn.size(size)))
        {
            Some(loading) => loading,
            None => {
                let ([width, height], [w, h]) = (<[u32; 2]>::from(size), <[u32; 2]>::from(taken));
                let problem = format!(
                    "is {width}x{height}, its photograph {w}x{h}; targets have the size of their photographs"
                );
                return Err(Error::input(path, problem));
            }
        };
        let undistort = self.loading.options.undistort;
        Ok(Original::new(path, *lens, undistort, Turns { loading, ..turns }))
    }

    fn reference_image(&self, decoded: DecodedPicture) -> Result<InMemory> {
        let Self { preparation, loading, .. } = self;
        if loading.options.keep == Some(0) {
            let original = decoded.original(preparation.lens, loading.options.undistort);
            return Ok((None, Some(original)));
        }
        let DecodedPicture { path, image, turns, .. } = decoded;
        Ok((Some(preparation.loaded(turns.loading.upright(image), &path)?), None))
    }
}
