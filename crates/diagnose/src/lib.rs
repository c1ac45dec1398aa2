//! The diagnosis of a capture, from which its model is planned, without Vulkan. Part of `nightsplat`.
//!
//! ```text
//! photographs as stored -> brightness, code values, noise, blur ┐
//!                                                               ├-> Diagnosis
//! cameras, points -> overlap, exposures ------------------------┘
//! ```
//!
//! Only training photographs are measured, never references. It runs on the host, in seconds.

mod geometry;
mod lamp;
mod noise;
mod photograph;
mod remarks;
mod scene;
mod sharpness;
mod target_noise;
mod views;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use nightsplat_core::camera::Camera;
use nightsplat_core::natural;
use nightsplat_core::watch::Stage;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::dataset::{self, Borders, Dataset, LoadOptions, Split, View};
use nightsplat_photographs::findings::{brought_near_white, findings};
use nightsplat_photographs::image::{
    ColourCounts, Image, ImageFile, Levels, Mask, PictureFile, decoded_at_once, files,
};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{MeasuredPhotograph, ToneSettings, is_black};
use nightsplat_photographs::white_balance::WhiteBalanceMatrix;
use rayon::prelude::*;
use serde::Serialize;

use geometry::{SceneGeometry, deviation};
pub use geometry::{exposures_at_points, median};
pub use lamp::{LampDiagnosis, bands::BandsDiagnosis, falloff::FalloffDiagnosis};
use lamp::{LampObservations, shading};
pub use noise::ChannelNoise;
use photograph::{PhotographStatistics, darkening};
pub use remarks::remarks_at_points;
pub use scene::SceneDiagnosis;
pub use target_noise::TargetNoise;
pub use views::DiagnosedViews;

/// Whether edges of this width are blurred, given the median width of the photographs.
pub fn is_blurred(blur: f64, median: f64) -> bool {
    blur > 1.6 * median && blur > median + 0.7
}

/// From this many stops on, and this many standard deviations of all views, an exposure is odd.
const ODD_EXPOSURE: [f64; 2] = [1.0, 2.5];

/// The diagnosis of a training photograph. Luminance is of encoded values, light is linear.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewDiagnosis {
    /// The view's name.
    pub name: String,
    /// Width and height of the photograph as it is stored, pixels.
    pub size: [u32; 2],
    /// The 10th percentile of the luminance.
    pub p10: f64,
    /// The 90th percentile of the luminance.
    pub p90: f64,
    /// p10 / p90; 1 if all is black.
    pub r: f64,
    /// The mean luminance.
    pub mean_luminance: f64,
    /// The cubic mean of the luminance, clamped at its 99.9 % quantile.
    pub cubic_mean: f64,
    /// The mean luminance in linear light.
    pub light: f64,
    /// The factor of light to a metered exposure: 0.18 / light.
    pub darkening: f64,
    /// Its exposure relative to the others at shared points, in stops, with mean 0; `None` if it shares too few.
    pub exposure: Option<f64>,
    /// The fraction of the values that are near white, 0.94 or more.
    pub near_white_fraction: f64,
    /// The fraction of the values that are 0.
    pub zero_fraction: f64,
    /// The number of different values.
    pub code_values: usize,
    /// `None` if no part is flat and unclipped.
    pub noise: Option<ChannelNoise>,
    /// In the target, including quantisation and JPEG artefacts; `None` for a black or tiny photograph.
    pub noise_in_target: Option<TargetNoise>,
    /// The blur of the edges, as a standard deviation in pixels; `None` without edges.
    pub blur: Option<f64>,
    /// The standard deviation of log2 light over large regions, caused by lamps and windows.
    pub unevenness: f64,
    /// The number of the dataset's points that the view sees.
    pub points: usize,
    /// The mean fraction of the other training views that see this view's points.
    pub overlap: f64,
    /// Whether it is black, and left out of training.
    pub is_black: bool,
}

/// The diagnosis of a capture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// The dataset's folder.
    pub dataset: PathBuf,
    /// The number of test views.
    pub test_views: usize,
    /// The number of pixels of all training views, as loaded.
    pub pixels: u64,
    /// Remarks, a sentence each.
    pub remarks: Vec<String>,
    /// What is odd about photographs, in a word or two, by name.
    pub odd: BTreeMap<String, String>,
    /// The names of photographs without a pose.
    pub without_pose: Vec<String>,
    /// All training views together.
    pub scene: SceneDiagnosis,
    /// The training views by name.
    pub views: Vec<ViewDiagnosis>,
    /// The number of training views with a depth map.
    pub depth_maps: usize,
    /// What tells its dataset from others.
    #[serde(skip)]
    pub fingerprint: DiagnosedViews,
}

impl Diagnosis {
    /// Loads a dataset and diagnoses its training photographs, as stored, while they are decoded. Where the corners of
    /// a lens are dark or rows differ, and `options` do not say by how much, the photographs are loaded again without
    /// it.
    pub fn load(root: &Path, options: &LoadOptions) -> Result<(Dataset, Self)> {
        let (dataset, diagnosis) = Self::load_with(root, options)?;
        let SceneDiagnosis { falloff, bands, .. } = &diagnosis.scene;
        let falloff = falloff.filter(|found| options.falloff.is_none() && found.is_found());
        let bands = bands.clone().filter(|found| options.bands.is_none() && found.is_found());
        if falloff.is_none() && bands.is_none() {
            return Ok((dataset, diagnosis));
        }
        drop(dataset);
        let mut options = options.clone();
        options.falloff = options.falloff.or(falloff.map(|found| found.falloff));
        options.bands = options.bands.or(bands.as_ref().map(|found| found.rows.clone()));
        let (dataset, mut diagnosis) = Self::load_with(root, &options)?;
        if let Some(found) = falloff {
            diagnosis.scene.falloff = Some(FalloffDiagnosis { is_corrected: true, ..found });
        }
        if let Some(found) = bands {
            diagnosis.scene.bands = Some(BandsDiagnosis { is_corrected: true, ..found });
        }
        Ok((dataset, diagnosis))
    }

    fn load_with(root: &Path, options: &LoadOptions) -> Result<(Dataset, Self)> {
        let looked_at = Mutex::new(HashMap::new());
        let observe = |name: &str, image: &Image, mask: Option<&Mask>| {
            let photograph = PhotographStatistics::new(image, mask);
            let mut looked_at = looked_at.lock().unwrap_or_else(PoisonError::into_inner);
            looked_at.insert(name.to_owned(), photograph);
        };
        let dataset = Dataset::load_observed(root, options, Some(&observe))?;
        let looked_at = looked_at.into_inner().unwrap_or_else(PoisonError::into_inner);
        let diagnosis = Self::with_photographs(&dataset, options, looked_at)?;
        Ok((dataset, diagnosis))
    }

    /// Diagnoses a loaded dataset, whose photographs are read again; `options` are those that it was loaded with.
    pub fn new(dataset: &Dataset, options: &LoadOptions) -> Result<Self> {
        Self::with_photographs(dataset, options, HashMap::new())
    }

    /// From photographs by name; those that are missing are read.
    fn with_photographs(
        dataset: &Dataset,
        options: &LoadOptions,
        mut known: HashMap<String, PhotographStatistics>,
    ) -> Result<Self> {
        let views: Vec<(usize, &View)> =
            dataset.views.iter().enumerate().filter(|(_, view)| view.is_for_training()).collect();
        let (files, ..) = Dataset::listed(&dataset.root, options)?;
        let by_name: HashMap<&str, &dataset::Photograph> =
            files.iter().map(|file| (file.name.as_str(), file)).collect();
        let path = |view: &View| {
            by_name.get(view.name.as_str()).copied().ok_or_else(|| {
                Error::input(&dataset.root, format!("no longer has photograph {}", view.name))
            })
        };
        let paths = views.iter().map(|(_, view)| path(view)).collect::<Result<Vec<_>>>()?;
        let shared = SceneGeometry::measure(dataset, &views)?;
        let unknown = paths.iter().copied().filter(|file| !known.contains_key(&file.name));
        known.extend(read(&dataset.root, &files, unknown.collect(), options)?);
        let photographs = views.iter().filter_map(|(_, view)| known.remove(&view.name));
        let photographs: Vec<PhotographStatistics> = photographs.collect();
        let measured = photographs.iter().zip(&views);
        let measured: Vec<MeasuredPhotograph> =
            measured.map(|(one, (_, view))| one.encoded.clone().seen_by(&view.camera)).collect();
        let scene = SceneTone::from_photographs(&ToneSettings::default(), &measured);
        let Some(exposure) = scene.and_then(|scene| scene.exposure) else {
            let problem = "every training photograph is almost black (99 % of its pixels are below 2 of 255); \
                           expose longer, or say `--light linear` if 16-bit files hold linear light";
            return Err(Error::input(&dataset.root, problem));
        };
        let of_view = |(index, photograph): (usize, &PhotographStatistics)| {
            photograph.diagnosis(&views[index].1.name, &shared, index)
        };
        let diagnosed: Vec<ViewDiagnosis> = photographs.iter().enumerate().map(of_view).collect();
        let without_pose = without_pose(&paths, &files, dataset)?;
        let (mut remarks, odd) = remarks(&diagnosed, &photographs, &views, &without_pose);
        let names: Vec<&str> = views.iter().map(|(_, view)| view.name.as_str()).collect();
        let tracks = LampObservations::new(&shared.observations, views.len());
        let shading = tracks.map(|tracks| shading(tracks, &names, shared.corner));
        remarks.extend(findings(&measured, Some(&exposure), 0.0));
        let mut scene = SceneDiagnosis::new(
            &diagnosed,
            photographs,
            &shared,
            shading,
            &exposure,
            dataset.points.len(),
        );
        scene.brought_near_white = brought_near_white(&measured, &exposure);
        // A pixel of a resized target averages this many pixels in each direction.
        let shrink = diagnosed.iter().zip(&views).map(|(view, (_, of))| {
            let [width, height] = view.size;
            let shrink = options.shrink(width, height);
            let by_area = (f64::from(width) * f64::from(height) / pixels(&of.camera) as f64).sqrt();
            // A large photograph was reduced before it was measured.
            if by_area < 0.75 * shrink { by_area } else { shrink }
        });
        scene.target_noise /= shrink.fold(1.0, f64::max);
        Ok(Self {
            dataset: dataset.root.clone(),
            test_views: dataset.test_views().count(),
            pixels: views.iter().map(|(_, view)| pixels(&view.camera)).sum(),
            remarks,
            odd,
            without_pose,
            scene,
            views: diagnosed,
            depth_maps: views.iter().filter(|(_, view)| view.depth.is_some()).count(),
            fingerprint: DiagnosedViews::new(dataset),
        })
    }

    /// The names of the black training views.
    pub fn black_views(&self) -> Vec<String> {
        self.views.iter().filter(|view| view.is_black).map(|view| view.name.clone()).collect()
    }
}

fn pixels(camera: &Camera) -> u64 {
    u64::from(camera.width) * u64::from(camera.height)
}

/// Reads and measures photographs; each with its name.
fn read(
    root: &Path,
    all: &[dataset::Photograph],
    files: Vec<&dataset::Photograph>,
    options: &LoadOptions,
) -> Result<Vec<(String, PhotographStatistics)>> {
    let area = |file: &&dataset::Photograph| {
        Image::size_of(&file.input).map(|(w, h)| u64::from(w) * u64::from(h))
    };
    let largest = files.iter().filter_map(|file| area(file).ok()).max().unwrap_or_default();
    let training = all.iter().filter(|file| file.split == Split::Train && !files.is_empty());
    let training: Vec<&Path> = training.map(|file| file.input.as_path()).collect();
    let levels = Levels::of_all(options.light, &training);
    let colours = ColourCounts::of_levels(levels);
    let named = || all.iter().map(|file| (file.name.as_str(), file.input.as_path()));
    let balance = options.white_balance.as_ref().filter(|_| !files.is_empty());
    let balance = balance.map(|balance| balance.matrix(root, named(), levels)).transpose()?;
    let borders = match files.is_empty() {
        false => Borders::of_photographs(all, options),
        true => Borders::default(),
    };
    let stage = Stage::begin("diagnosing photographs", files.len());
    let mut photographs = vec![];
    for files in files.chunks(decoded_at_once(largest)) {
        let read = files.par_iter().map(|file| {
            stage.next()?;
            let name = file.name.clone();
            let load = || PhotographStatistics::load(file, options, &borders, balance, &colours);
            Ok((name, load()?))
        });
        photographs.extend(read.collect::<Result<Vec<_>>>()?);
    }
    colours.log();
    Ok(photographs)
}

impl PhotographStatistics {
    fn load(
        file: &dataset::Photograph,
        options: &LoadOptions,
        borders: &Borders,
        balance: Option<WhiteBalanceMatrix>,
        colours: &ColourCounts,
    ) -> Result<Self> {
        let picture = PictureFile::open(&file.input)?;
        let picture = picture.reduced(|size| options.decoded_size(size));
        let (mut image, alpha) = picture.decode_counted(colours)?;
        if let Some(balance) = balance {
            balance.apply(&mut image);
        }
        let decoded = (&image, alpha.as_ref());
        let mask = Mask::over(&file.input, decoded, file.mask.as_ref(), options.invert_masks)?;
        let mask = borders.hide_borders(mask, (image.width, image.height));
        Ok(Self::new(&image, mask.as_ref()))
    }

    fn diagnosis(&self, name: &str, shared: &SceneGeometry, index: usize) -> ViewDiagnosis {
        let MeasuredPhotograph { statistics, luminance, .. } = &self.encoded;
        let [p10, p90] = statistics.percentiles();
        ViewDiagnosis {
            name: name.to_owned(),
            size: self.size,
            p10,
            p90,
            r: statistics.printed_ratio(),
            mean_luminance: statistics.mean_luminance.into(),
            cubic_mean: luminance.cubic_mean(),
            light: self.light,
            darkening: darkening(self.light),
            exposure: shared.exposures[index],
            near_white_fraction: self.near_white_fraction,
            zero_fraction: self.zero_fraction,
            code_values: self.code_values,
            noise: self.noise,
            noise_in_target: self.noise_in_target,
            blur: self.blur,
            unevenness: self.unevenness,
            points: shared.points[index],
            overlap: shared.overlaps[index],
            is_black: is_black(luminance),
        }
    }
}

/// The names of photographs in the folder that belong to no view.
fn without_pose(
    paths: &[&dataset::Photograph],
    files: &[dataset::Photograph],
    dataset: &Dataset,
) -> Result<Vec<String>> {
    let folders: BTreeSet<&Path> = paths.iter().filter_map(|file| file.input.parent()).collect();
    let of_views: HashSet<&Path> = files.iter().map(|file| file.input.as_path()).collect();
    let posed: HashSet<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    let mut names = vec![];
    for folder in folders {
        let photographs = files::photographs_in(folder)?;
        let is_other =
            |path: &&PathBuf| !of_views.contains(path.as_path()) && !dataset::is_mask(path);
        let others = photographs.iter().filter(is_other);
        let stems = others.filter_map(|path| path.file_stem()?.to_str());
        names.extend(stems.filter(|name| !posed.contains(name)).map(str::to_owned));
    }
    Ok(names)
}

/// Remarks that a user should read before training, and what is odd about photographs, by name.
fn remarks(
    views: &[ViewDiagnosis],
    photographs: &[PhotographStatistics],
    cameras: &[(usize, &View)],
    without_pose: &[String],
) -> (Vec<String>, BTreeMap<String, String>) {
    let (mut remarks, mut odd) = (vec![], BTreeMap::new());
    let mut add_remark = |mut names: Vec<&str>, word: &str, what: &str| {
        names.sort_by(|a, b| natural::compare(a, b));
        for name in &names {
            let words: &mut String = odd.entry((*name).to_owned()).or_default();
            *words += &format!("{}{word}", if words.is_empty() { "" } else { ", " });
        }
        let named = match names.len() {
            0 => return,
            1..=4 => names.join(", "),
            more => format!("{}, and {} more", names[..3].join(", "), more - 3),
        };
        remarks.push(format!("{} {what}: {named}", names.len()));
    };
    let names = |is: &dyn Fn(usize) -> bool| -> Vec<&str> {
        let views = views.iter().enumerate().filter(|(index, _)| is(*index));
        views.map(|(_, view)| view.name.as_str()).collect()
    };
    add_remark(names(&|index| views[index].is_black), "black", "black, left out of training");
    let mut checksums = HashSet::new();
    let is_new: Vec<bool> = photographs.iter().map(|one| checksums.insert(one.checksum)).collect();
    let is_repeated = |index: usize| !is_new[index] && !views[index].is_black;
    add_remark(names(&is_repeated), "repeated", "identical to another photograph");
    let blur = median(views.iter().filter_map(|view| view.blur).collect());
    let blurred = |index: usize| {
        views[index].blur.zip(blur).is_some_and(|(blur, median)| is_blurred(blur, median))
    };
    add_remark(names(&blurred), "blurred", "more blurred than the others");
    let [stops, deviations] = ODD_EXPOSURE;
    let spread = deviation(views.iter().filter_map(|view| view.exposure)).unwrap_or_default();
    let of_odd_exposure = |index: usize| {
        views[index].exposure.is_some_and(|ev| ev.abs() > stops.max(deviations * spread))
    };
    let far = names(&of_odd_exposure);
    add_remark(far, "odd exposure", "much brighter or darker than others of the same points");
    let without_pose = without_pose.iter().map(String::as_str).collect();
    add_remark(without_pose, "without a pose", "without a pose, not used");
    let centers: Vec<_> = cameras.iter().map(|(_, view)| view.camera.center()).collect();
    if cameras.len() == 1 {
        remarks.push("one photograph gives no depth: other views will look wrong".to_owned());
    } else if centers.windows(2).all(|two| two[0].distance(two[1]) < 1e-9) {
        remarks.push("all cameras are at one position, which gives no depth".to_owned());
    }
    (remarks, odd)
}
