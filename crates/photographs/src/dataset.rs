//! Datasets: photographs on disk become views with undistorted cameras, a split and points.
//!
//! The format is detected: NeRF-style `transforms*.json` first (including the layouts of LOM and `RealX3D`), then a
//! COLMAP model. The model is trained on the dark photograph (`View::image`); a normal-light photograph of the same
//! name is a test view's reference image (`View::reference`), used only for scores and loaded only for test views.

mod allowance;
pub mod block;
mod borders;
mod colmap;
mod dark_references;
mod depth;
pub mod exclude;
mod extent;
mod fingerprint;
mod layout;
mod listed;
mod listing;
mod loaded;
mod locate;
mod masks;
mod members;
mod names;
mod normals;
mod options;
mod original;
mod outside;
mod packed;
mod pictures;
mod pixels;
mod ply;
mod points;
mod prepare;
mod shading;
mod similarity;
mod source;
mod split;
mod stamp;
mod tracked;
mod transforms;
mod turns;
mod undistort;
mod unused;
mod view;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use glam::DVec3;
use nightsplat_core::camera::Lens;
use nightsplat_core::{Error, Result};

use crate::image::files::PhotographFiles;
use crate::image::{Levels, MaskFile};
use crate::white_balance::{WhiteBalance, WhiteBalanceMatrix};
pub use borders::Borders;
pub use fingerprint::Fingerprint;
use layout::DatasetLayout;
use listed::{Listing, ViewEntry};
use listing::{select, warn};
pub use masks::beside as mask_beside;
pub use masks::is_beside as is_mask;
use members::with_held_out;
pub use normals::{NormalAxes, NormalMap};
pub use options::{DOWNSCALE, DepthOptions, LoadOptions, MeasuredSize, NormalOptions};
pub use original::Original;
pub use pictures::ViewPictures;
pub use pixels::PhotographObserver;
use points::points;
pub use shading::RowBands;
use source::ViewFiles;
use split::{TEST_EVERY, log_split};
pub use turns::PixelOrientation;
pub use view::{Split, View};

/// Photographs with cameras, and points of the scene they show.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// The folder that it was loaded from.
    pub root: PathBuf,
    /// Sorted by name; at least one training view has an image.
    pub views: Vec<View>,
    /// In the cameras' world; empty if the dataset has none.
    pub points: Vec<Point>,
    /// Photographs that were left out, each with the reason on one line.
    pub skipped: Vec<String>,
}

/// The files of one view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Photograph {
    /// The file name without extension; unique.
    pub name: String,
    /// Whether it is trained on or scored.
    pub split: Split,
    /// The dark photograph.
    pub input: PathBuf,
    /// The normal-light photograph to score against; only for test views.
    pub reference: Option<PathBuf>,
    /// The mask.
    pub mask: Option<MaskFile>,
}

/// A triangulated point of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// World space.
    pub position: DVec3,
    /// Ascending indices into [`Dataset::views`] of the views that see it; may be empty.
    pub views: Vec<u32>,
}

/// Folders of the dark photographs in datasets that also have normal-light ones.
const DARK_FOLDERS: [&str; 2] = ["low", "images_low"];
/// Folders that may contain the normal-light photographs.
const NORMAL_FOLDERS: [&str; 4] = ["high", "val", "test", "images"];
/// Folders that may contain depth maps.
const DEPTH_FOLDERS: [&str; 2] = ["depth", "depth_maps"];
/// Folders that may contain normal maps.
const NORMAL_MAP_FOLDERS: [&str; 2] = ["normals", "normal_maps"];

/// The folder of the photographs in normal light, of a dataset that also has dark ones of the same names.
pub fn bright_folder(root: &Path) -> Option<PathBuf> {
    let folder = |name: &str| Some(root.join(name)).filter(|folder| folder.is_dir());
    DARK_FOLDERS.into_iter().find_map(folder)?;
    ["high", "images"].into_iter().find_map(folder)
}

impl Dataset {
    /// Loads the dataset below `root`.
    ///
    /// Frames whose file is missing or cannot be decoded are named in [`Dataset::skipped`]; test views stay as poses.
    ///
    /// # Errors
    /// [`Error::Usage`] for an invalid downscale; [`Error::Input`] with the folder or file if there is no dataset, no
    /// usable training photograph, a truncated file, a duplicate name, an unsupported camera model, or a photograph
    /// whose size contradicts its camera.
    pub fn load(root: impl AsRef<Path>, options: &LoadOptions) -> Result<Self> {
        Self::load_observed(root.as_ref(), options, None)
    }

    /// As [`Dataset::load`]; `observer` is called with every training photograph as stored while it is in memory.
    #[doc(hidden)]
    pub fn load_observed(
        root: &Path,
        options: &LoadOptions,
        observer: Option<PhotographObserver<'_>>,
    ) -> Result<Self> {
        let _phase = tracing::info_span!("decoding").entered();
        options.check()?;
        let files = PhotographFiles::default();
        let layout = DatasetLayout::detect(root)?;
        let Listing { frames, mut skipped, mut remarks, clouds, has_split } =
            select(&layout, options, &files)?;
        log_split(&layout.root, has_split, options);
        let mut sources = sources(&layout.root, &frames, options, &files, &mut skipped);
        remarks.extend(check_files(&layout, &mut sources, options));
        let headers = pixels::headers(&mut sources, options);
        let mut levels = levels(&layout, &sources, options, &files)?;
        let balance = white_balance_matrix(&layout.root, &sources, options, levels)?;
        let files = (sources, headers);
        let views =
            pixels::load(files, &layout, options, observer, &mut levels, balance, &mut skipped)?;
        if !views.iter().any(|view| view.split == Split::Train) {
            let first = skipped.first().map(|line| format!(" ({line})")).unwrap_or_default();
            let problem = format!(
                "no photograph is left to train on{first}; check the image folders and the split"
            );
            return Err(Error::input(root, problem));
        }
        // After everything that may fail: an error is reported alone.
        warn(&remarks);
        levels.say();
        let views = with_held_out(views, options.hold_out);
        let points = points(&layout, &views, &clouds)?;
        let points = match &layout.block {
            Some(block) => block.points_of(points)?,
            None => points,
        };
        for line in &skipped {
            tracing::warn!("skipped {line}");
        }
        tracing::info!(
            "{}: {} views, {} points, {} skipped",
            root.display(),
            views.len(),
            points.len(),
            skipped.len()
        );
        let mut dataset = Self { root: root.to_owned(), views, points, skipped };
        dataset.leave_out_far_points();
        dataset.warn_of_other_worlds();
        Ok(dataset)
    }

    /// The rule that selects the held-out views, of which there are `count`, in words.
    #[doc(hidden)]
    pub fn split_rule(root: &Path, options: &LoadOptions, count: usize) -> String {
        let layout = DatasetLayout::detect(root).ok();
        let listings = layout.as_ref().map(DatasetLayout::listings).unwrap_or_default();
        let has_test = listings.iter().any(|(_, split)| *split == Some(Split::Test));
        let root = layout.as_ref().map_or(root, |layout| &layout.root);
        match options.test_every {
            Some(0) => "none, as requested".to_owned(),
            Some(every) => format!("every {every}th by name, as requested"),
            None if has_test => "as the transforms files say".to_owned(),
            None if split::test_list(root).is_some() => "as test.txt says".to_owned(),
            None if count == 0 => {
                format!(
                    "none of fewer than {TEST_EVERY} photographs; --test-every N holds some out"
                )
            }
            None => format!("every {TEST_EVERY}th by name"),
        }
    }

    /// Whether `root` is a folder in which [`Dataset::load`] finds cameras.
    #[doc(hidden)]
    pub fn is_at(root: &Path) -> bool {
        DatasetLayout::detect(root).is_ok_and(|layout| layout.has_listing())
    }

    /// Of the models that COLMAP wrote into the subfolders of `folder`, the one with the most registered photographs of
    /// which `counts` is true, with the names of all its photographs.
    #[doc(hidden)]
    pub fn largest_model(
        folder: &Path,
        counts: impl Fn(&str) -> bool,
    ) -> Result<Option<(PathBuf, Vec<String>)>> {
        let models = colmap::models_in(folder, &["cameras", "images", "points3D"]);
        let Some((model, _)) = colmap::largest(&models, counts)? else { return Ok(None) };
        let names = colmap::read_images(model)?.into_iter().map(|image| image.name);
        Ok(Some((model.to_owned(), names.collect())))
    }

    /// A binary file of the images of a COLMAP model, with those that `renamed` gives a name, under that name. Points
    /// that only others see stay.
    #[doc(hidden)]
    pub fn images_renamed(
        images: &Path,
        renamed: impl Fn(&str) -> Option<String>,
    ) -> Result<Vec<u8>> {
        colmap::images_renamed(images, renamed)
    }

    /// The lenses of a COLMAP model, each with how many photographs it took.
    #[doc(hidden)]
    pub fn lenses(model: &Path) -> Result<Vec<(Lens, usize)>> {
        let images = colmap::read_images(model)?;
        let taken = |id| images.iter().filter(|image| image.camera == id).count();
        let lenses = colmap::read_cameras(model)?;
        Ok(lenses.into_iter().map(|(id, lens)| (lens, taken(id))).collect())
    }

    /// The photographs of a COLMAP model, each with how many points it sees.
    #[doc(hidden)]
    pub fn points_seen(model: &Path) -> Result<Vec<(String, usize)>> {
        let mut seen = BTreeMap::<u32, usize>::new();
        let points = colmap::read_points(model)?;
        points
            .iter()
            .flat_map(|point| &point.images)
            .for_each(|&id| *seen.entry(id).or_default() += 1);
        let of = |id| seen.get(&id).copied().unwrap_or_default();
        let images = colmap::read_images(model)?;
        Ok(images.into_iter().map(|image| (image.name, of(image.id))).collect())
    }

    /// The folder with the contents of an archive: its only folder, if there is nothing else.
    #[doc(hidden)]
    pub fn folder_of(archive: &Path) -> Result<PathBuf> {
        Ok(DatasetLayout::detect(archive)?.root)
    }

    /// The files of the views below `root`, sorted by name, without decoding any.
    #[doc(hidden)]
    pub fn photographs(root: &Path, options: &LoadOptions) -> Result<Vec<Photograph>> {
        let (photographs, skipped, remarks) = Self::listed(root, options)?;
        warn(&remarks);
        for line in &skipped {
            tracing::warn!("skipped {line}");
        }
        Ok(photographs)
    }

    /// As [`Dataset::photographs`], with the photographs left out and remarks on the folder.
    #[doc(hidden)]
    pub fn listed(
        root: &Path,
        options: &LoadOptions,
    ) -> Result<(Vec<Photograph>, Vec<String>, Vec<String>)> {
        options.check()?;
        let files = PhotographFiles::default();
        let layout = DatasetLayout::detect(root)?;
        let Listing { frames, mut skipped, mut remarks, .. } = select(&layout, options, &files)?;
        let mut sources = sources(&layout.root, &frames, options, &files, &mut skipped);
        remarks.extend(check_files(&layout, &mut sources, options));
        let photograph = |source: ViewFiles| {
            let ViewFiles { name, split, input, reference, mask, .. } = source;
            Some(Photograph { name, split, input: input?, reference, mask })
        };
        Ok((sources.into_iter().filter_map(photograph).collect(), skipped, remarks))
    }
}

/// The levels of the training photographs; of a block, those of the whole dataset.
fn levels(
    layout: &DatasetLayout,
    sources_of_views: &[ViewFiles],
    options: &LoadOptions,
    files: &PhotographFiles,
) -> Result<Levels> {
    let of = |sources: &[ViewFiles]| {
        let training = sources.iter().filter(|source| source.split == Split::Train);
        Levels::of_set(options.light, training.filter_map(ViewFiles::photograph))
    };
    if layout.block.is_none() {
        return Ok(of(sources_of_views));
    }
    let whole = layout.whole();
    let frames = select(&whole, options, files)?.frames;
    Ok(of(&sources(&whole.root, &frames, options, files, &mut vec![])))
}

/// The white balance of the photographs, if there is one.
fn white_balance_matrix(
    root: &Path,
    sources: &[ViewFiles],
    options: &LoadOptions,
    levels: Levels,
) -> Result<Option<WhiteBalanceMatrix>> {
    let photographs = || {
        sources.iter().filter_map(|source| Some((source.name.as_str(), source.input.as_deref()?)))
    };
    let balance = |balance: &WhiteBalance| balance.matrix(root, photographs(), levels);
    options.white_balance.as_ref().map(balance).transpose()
}

/// Marks masks of labels; returns remarks on masks, and on photographs outside of the dataset.
fn check_files(
    layout: &DatasetLayout,
    sources: &mut [ViewFiles],
    options: &LoadOptions,
) -> impl Iterator<Item = String> {
    let masks = sources.iter_mut().filter_map(|source| source.mask.as_mut());
    let labels = MaskFile::find_labels(masks);
    labels.into_iter().chain(outside::remark(layout, sources, options))
}

/// The files of each view. A training view without its photograph is left out, a test view is kept as a pose.
fn sources(
    root: &Path,
    frames: &[ViewEntry],
    options: &LoadOptions,
    files: &PhotographFiles,
    skipped: &mut Vec<String>,
) -> Vec<ViewFiles> {
    let training = frames.iter().filter(|frame| frame.split == Some(Split::Train));
    let training_folders: BTreeSet<&str> = training.map(ViewEntry::folder).collect();
    // A file that is listed for one view is not the reference image of another.
    let listed: HashSet<&PathBuf> = frames.iter().filter_map(|frame| frame.file.as_ref()).collect();
    let mut sources = Vec::new();
    for frame in frames {
        let split = frame.split.unwrap_or(Split::Train);
        // A test listing names the normal-light photographs (LOM, RealX3D), unless training frames are in the same
        // folder.
        let lists_input = split == Split::Train || training_folders.contains(frame.folder());
        let input = match &options.images {
            // If the user gives their folder, nothing is guessed.
            Some(_) => frame.file.clone(),
            None => frame.input(root, lists_input, files),
        };
        let reference = match &options.reference {
            _ if split == Split::Train => None,
            Some(folder) => frame.find(folder, files),
            None => frame
                .reference(root, input.as_ref(), files)
                .filter(|file| frame.file.as_ref() == Some(file) || !listed.contains(file)),
        };
        if input.is_none() && reference.is_none() {
            let kept = if split == Split::Test { "; its pose is kept" } else { "" };
            skipped.push(format!("{}: the file is absent{kept}", frame.listed));
        }
        if input.is_some() || split == Split::Test {
            let input = input.filter(|_| split == Split::Train || options.load_low_test);
            let depth = (options.depth.load && split == Split::Train)
                .then(|| frame.depth_file(root, options.depth.folder.as_deref(), files))
                .flatten();
            let normals = (options.normals.load && split == Split::Train)
                .then(|| frame.normal_file(root, options.normals.folder.as_deref(), files))
                .flatten();
            sources.push(ViewFiles {
                name: frame.name.clone(),
                split,
                lens: frame.lens,
                view_from_world: frame.view_from_world,
                input,
                reference,
                target: options.targets.as_ref().and_then(|folder| frame.find(folder, files)),
                mask: masks::find(root, frame, files),
                depth,
                normals,
                read: [None, None],
                decoded_sizes: [None; 2],
                size: (frame.lens.width, frame.lens.height),
                turns: Default::default(),
            });
        }
    }
    if let Some(folder) = &options.reference
        && sources.iter().all(|source| source.reference.is_none())
    {
        tracing::warn!(
            "{}: holds no photograph named like a test view; nothing will be scored",
            folder.display()
        );
    }
    sources
}

impl ViewEntry {
    /// The folder of the listed path.
    fn folder(&self) -> &str {
        self.listed.rsplit_once('/').map_or("", |(folder, _)| folder)
    }

    /// The photograph of the same name in another folder: at the same relative path, or directly in it.
    fn find(&self, folder: &Path, files: &PhotographFiles) -> Option<PathBuf> {
        files
            .find(folder, names::below_first(&self.listed))
            .or_else(|| files.find(folder, &self.name))
    }

    /// The dark photograph; the listed file, unless there is a darker one next to it.
    fn input(&self, root: &Path, lists_input: bool, files: &PhotographFiles) -> Option<PathBuf> {
        if self.folder().split('/').any(|part| DARK_FOLDERS.contains(&part)) {
            return self.file.clone();
        }
        let beside = DARK_FOLDERS.iter().find_map(|folder| self.find(&root.join(folder), files));
        beside.or_else(|| self.file.clone().filter(|_| lists_input))
    }

    /// The depth map: the listed one, or one with the photograph's name or that name with the prefix `depth_`.
    fn depth_file(
        &self,
        root: &Path,
        folder: Option<&Path>,
        files: &PhotographFiles,
    ) -> Option<PathBuf> {
        if folder.is_none() && self.depth.is_some() {
            return self.depth.clone();
        }
        self.map_file(root, folder, DEPTH_FOLDERS, "depth", files)
    }

    /// The normal map, with the photograph's name or that name with the prefix `normal_`.
    fn normal_file(
        &self,
        root: &Path,
        folder: Option<&Path>,
        files: &PhotographFiles,
    ) -> Option<PathBuf> {
        self.map_file(root, folder, NORMAL_MAP_FOLDERS, "normal", files)
    }

    /// The map with the photograph's name or that name with a prefix, in `folder` or in one of the dataset's.
    fn map_file(
        &self,
        root: &Path,
        folder: Option<&Path>,
        own: [&str; 2],
        prefix: &str,
        files: &PhotographFiles,
    ) -> Option<PathBuf> {
        let folders = match folder {
            Some(folder) => vec![folder.to_owned()],
            None => own.map(|name| root.join(name)).to_vec(),
        };
        folders.iter().find_map(|folder| {
            let prefixed = format!("{prefix}_{}", self.name);
            self.find(folder, files).or_else(|| files.find(folder, &prefixed))
        })
    }

    /// The normal-light photograph: the listed file if it is not the input, else one of the same name next to it.
    fn reference(
        &self,
        root: &Path,
        input: Option<&PathBuf>,
        files: &PhotographFiles,
    ) -> Option<PathBuf> {
        let beside =
            NORMAL_FOLDERS.iter().filter_map(|folder| self.find(&root.join(folder), files));
        self.file.clone().into_iter().chain(beside).find(|file| Some(file) != input)
    }
}
