//! `nightsplat view`: a live page of a run, a model or a dataset.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use anyhow::Result;
use glam::{DAffine3, DVec2, DVec3, Vec3};
use nightsplat_core::camera::Camera;
use nightsplat_models::export::Provenance;
use nightsplat_models::export::page::{Bookmark, ModelPage, Sharing};
use nightsplat_models::gaussians::{Gaussians, ModelFacts, Shape};
use nightsplat_photographs::dataset::Dataset;

use super::tell_on_stderr;
use crate::driver;
use crate::gpu::{DeviceChoice, Gpu};
use crate::live::{DEFAULT_ADDRESS, Feed, Listen, Pictures, Server, Site};
use crate::results::finished_run::{config_of_file, is_model};
use crate::results::run::{self, Requests};
use crate::results::run_export::SHARED_GLSL;
use crate::splats::render::RenderSettings;
use crate::train::TrainConfig;
use crate::{Error, Initialization};

/// Show a run while it trains, a model or a dataset, in a browser.
///
/// Serves a page until Ctrl-C: the model, updated with every checkpoint of a run, its progress, and the photographs and
/// targets of all views to compare with. `train --view` serves the same page with the model of every moment, and can
/// pause, save and stop. The address has a random token, without which nothing is answered.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ViewArgs {
    /// Run directory, also of a training under way; a model: PLY, SPZ or SOG; or a dataset, whose points are shown
    pub path: PathBuf,
    /// Port, or address and port, to listen on; port 0 is any free one
    #[arg(long, value_name = "ADDRESS", default_value = DEFAULT_ADDRESS)]
    pub listen: Listen,
    /// Photographs of a model, or of a run whose dataset moved
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Vulkan device that makes the targets: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat view run                           watch a training that runs in another terminal
  nightsplat view model.ply --dataset photos    a model, with its photographs to compare
  ssh -L 7007:127.0.0.1:7007 server             then open the printed address here: a run on a server";

/// Serves the page until the process is ended.
pub fn run(args: &ViewArgs) -> Result<()> {
    let site = opened(args)?;
    let _server = started(args.listen, site)?;
    loop {
        std::thread::park();
    }
}

/// The page of a training in this process.
pub(super) fn of_training(
    listen: Listen,
    run: &Path,
    config: &TrainConfig,
    dataset: &Arc<Dataset>,
    gpu: &Gpu,
    requests: &Requests,
) -> Result<(Arc<Site>, Server)> {
    let pictures = Pictures::of_training(config.clone(), gpu.clone(), dataset)?;
    let facts = config.facts(&config.frame.unwrap_or_else(|| pictures.dataset().frame()));
    let feed = Feed::of_run(run, Some(requests.clone()));
    let site = of_dataset(run, feed, pictures, &facts)?;
    Ok((Arc::clone(&site), started(listen, site)?))
}

/// Starts the server and prints the address of the page.
fn started(listen: Listen, site: Arc<Site>) -> Result<Server> {
    let server = Server::start(listen, site)?;
    tell_on_stderr(format_args!("open {} in a browser", server.url()));
    Ok(server)
}

/// The page of what the path names.
fn opened(args: &ViewArgs) -> Result<Arc<Site>> {
    let path = &args.path;
    let gpu = args.device.as_ref().map(driver::open).transpose()?;
    if is_model(path) {
        let (feed, gaussians, facts) = Feed::of_file(path)?;
        if args.dataset.is_none() {
            return of_model(path, feed, &gaussians, &facts);
        }
        let config = config_of_file(path, &gaussians, &facts, args.dataset.as_deref())?;
        return of_dataset(path, feed, Pictures::load(config, gpu)?, &facts);
    }
    if path.join("config.toml").is_file() {
        let mut config = run::load_config(path)?;
        if let Some(dataset) = &args.dataset {
            config.move_dataset(dataset);
        }
        let feed = Feed::of_run(path, None);
        let pictures = Pictures::load(config.clone(), gpu)?;
        let facts = config.facts(&config.frame.unwrap_or_else(|| pictures.dataset().frame()));
        return of_dataset(path, feed, pictures, &facts);
    }
    if !path.exists() {
        let problem =
            "does not exist; name a run directory, a model (PLY, SPZ or SOG), or a dataset";
        return Err(Error::input(path, problem).into());
    }
    let config = TrainConfig { dataset: path.clone(), ..TrainConfig::default() };
    let pictures = Pictures::load(config, gpu)?;
    let feed = Feed::of_gaussians(&points(pictures.dataset())?);
    of_dataset(path, feed, pictures, &ModelFacts::default())
}

/// The page of a model with its dataset.
fn of_dataset(
    path: &Path,
    feed: Feed,
    pictures: Pictures,
    facts: &ModelFacts,
) -> Result<Arc<Site>> {
    let dataset = pictures.dataset().root.file_name().unwrap_or_default();
    let provenance = Provenance {
        dataset: dataset.to_string_lossy().into_owned(),
        facts: facts.clone(),
        ..Default::default()
    };
    let page = ModelPage {
        bookmarks: pictures.bookmarks(),
        shows_cameras: feed.is_fixed(),
        origin: pictures.origin(),
        up: pictures.dataset().up(),
        ..page(path, provenance)
    };
    site(page, feed, Some(pictures))
}

/// The page of a model alone, which is seen from outside, with -y up.
fn of_model(
    path: &Path,
    feed: Feed,
    gaussians: &Gaussians,
    facts: &ModelFacts,
) -> Result<Arc<Site>> {
    let bookmark =
        Bookmark { name: "overview".to_owned(), camera: overview(gaussians), pictures: vec![] };
    let provenance = Provenance { facts: facts.clone(), ..Provenance::default() };
    let page =
        ModelPage { bookmarks: vec![bookmark], origin: gaussians.origin, ..page(path, provenance) };
    site(page, feed, None)
}

/// A page without views.
fn page(path: &Path, provenance: Provenance) -> ModelPage<'static> {
    let near = provenance.facts.near.unwrap_or_else(|| RenderSettings::default().near).into();
    ModelPage {
        sharing: Sharing { title: path.display().to_string(), ..Sharing::default() },
        gaussians: None,
        provenance,
        bookmarks: vec![],
        cameras: vec![],
        shows_cameras: false,
        origin: DVec3::ZERO,
        fingerprint: None,
        near,
        up: DVec3::NEG_Y,
        lamp: None,
    }
}

fn site(mut page: ModelPage<'_>, feed: Feed, pictures: Option<Pictures>) -> Result<Arc<Site>> {
    page.cameras = page.bookmarks.iter().map(|bookmark| bookmark.camera).collect();
    let html = page.html(&SHARED_GLSL)?;
    Ok(Arc::new(Site { html: html.into(), feed, pictures: pictures.map(Mutex::new) }))
}

/// A camera that sees nine tenths of the Gaussians along each axis, looking along +z, relative to their origin.
fn overview(gaussians: &Gaussians) -> Camera {
    const FOV: f64 = 0.9;
    const SIZE: [u32; 2] = [1280, 720];
    let range = |axis: usize| {
        let mut values: Vec<f32> = gaussians.means().iter().map(|mean| mean[axis]).collect();
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied();
        [at(0.05), at(0.5), at(0.95)].map(|value| f64::from(value.unwrap_or_default()))
    };
    let [[left, x, right], [top, y, bottom], [front, _, back]] = [0, 1, 2].map(range);
    let half = 0.5 * (right - left).max(bottom - top).max(1e-3);
    let eye = DVec3::new(x, y, front - half / (0.5 * FOV).tan() - 0.5 * (back - front));
    Camera::perspective(DAffine3::from_translation(-eye), FOV, SIZE)
}

/// The points of a dataset, in the colours of photographs, as bright as is seen well.
fn points(dataset: &Dataset) -> crate::Result<Gaussians> {
    /// Standard deviation of a point, relative to the distance of the cameras.
    const SIZE: f64 = 0.003;
    let origin = dataset.frame().file_origin();
    let positions: Vec<DVec3> =
        dataset.points.iter().map(|point| point.position - origin).collect();
    let (colors, start) = (point_colors(dataset), Initialization::default());
    let start = Initialization { opacity: 0.9, ..start };
    let mut gaussians = Gaussians::from_points(&positions, &colors, Shape::default(), &start, 0)?;
    let eye = dataset.views.first().map_or(origin, |view| view.camera.center()) - origin;
    let mut distances: Vec<f64> = positions.iter().map(|point| eye.distance(*point)).collect();
    distances.sort_by(f64::total_cmp);
    let distance = distances.get(distances.len() / 2).copied().unwrap_or(1.0).max(1e-6);
    gaussians.log_scales_mut().fill(Vec3::splat((SIZE * distance).ln() as f32));
    gaussians.origin = origin;
    Ok(gaussians)
}

/// The colour of every point in the first photograph that shows it, all brightened alike; grey without one.
fn point_colors(dataset: &Dataset) -> Vec<Vec3> {
    const GREY: Vec3 = Vec3::splat(0.6);
    /// The most photographs that are decoded.
    const PHOTOGRAPHS: usize = 24;
    /// What the brightest twentieth becomes.
    const BRIGHT: f32 = 0.85;
    let mut colors: Vec<Option<Vec3>> = vec![None; dataset.points.len()];
    let every = dataset.views.len().div_ceil(PHOTOGRAPHS).max(1);
    for (index, view) in dataset.views.iter().enumerate().step_by(every) {
        let Ok(Some(photograph)) = view.loaded() else { continue };
        let size = DVec2::new(photograph.width.into(), photograph.height.into());
        for (point, color) in dataset.points.iter().zip(&mut colors) {
            let is_seen = point.views.is_empty() || point.views.contains(&(index as u32));
            let pixel = view.camera.project(point.position).filter(|_| is_seen && color.is_none());
            if let Some(at) = pixel.filter(|at| at.min_element() >= 0.0 && at.cmplt(size).all()) {
                *color = Some(Vec3::from(photograph.pixel(at.x as u32, at.y as u32)));
            }
        }
    }
    let mut brightness: Vec<f32> = colors.iter().flatten().map(|c| c.max_element()).collect();
    brightness.sort_by(f32::total_cmp);
    let bright = brightness.get(brightness.len() * 19 / 20).copied().unwrap_or(BRIGHT).max(1e-3);
    let shown = |color: Vec3| (color * (BRIGHT / bright)).clamp(Vec3::ZERO, Vec3::ONE);
    colors.into_iter().map(|color| color.map_or(GREY, shown)).collect()
}
