//! From files to views: decode, check against the camera, undistort, downscale. Parallel over views.

mod view_loader;

use std::collections::HashMap;

use nightsplat_core::camera::Lens;
use nightsplat_core::watch::Stage;
use nightsplat_core::{Error, Result};
use rayon::prelude::*;

use super::allowance::Allowance;
use super::borders::Borders;
use super::dark_references;
use super::layout::DatasetLayout;
use super::loaded::LoadedView;
use super::points;
use super::prepare::{Preparation, disagreement, pixel_count};
use super::source::{MAX_READ, ViewFiles};
use super::tracked;
use super::turns::{CameraPixels, ImageHeader, Turns};
use super::undistort::WIDEST;
use super::{LoadOptions, MeasuredSize, View};
use crate::image::decoded_at_once;
use crate::image::{ColourCounts, Image, Levels, Mask};
use crate::white_balance::WhiteBalanceMatrix;
use view_loader::ViewLoader;

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
        // Each takes long, so threads take them one by one: none of them is idle before the end.
        let now = now.into_par_iter().with_max_len(1).map(|source| {
            loading.stage.next()?;
            views.load(source)
        });
        loaded.extend(now.collect::<Result<Vec<_>>>()?);
    }
    Ok(loaded)
}
