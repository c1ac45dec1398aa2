//! `nightsplat view`: a live page of a run, a model or a dataset.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use anyhow::Result;
use glam::{DAffine3, DVec3, Vec3};
use nightsplat_core::camera::Camera;
use nightsplat_photographs::dataset::Dataset;

use super::tell_on_stderr;
use crate::driver;
use crate::gpu::{DeviceChoice, Gpu};
use crate::live::{DEFAULT_ADDRESS, Feed, Listen, Pictures, Server, Site};
use crate::results::export::Provenance;
use crate::results::export::page::{Bookmark, ModelPage};
use crate::results::finished_run::{config_of_file, is_model};
use crate::results::run::{self, Requests};
use crate::splats::render::RenderSettings;
use crate::splats::scene::{Gaussians, ModelFacts, Shape};
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
        let config = config_of_file(&gaussians, &facts, args.dataset.as_deref());
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
    let (bookmarks, up) = (pictures.bookmarks(), pictures.dataset().up());
    let dataset = pictures.dataset().root.file_name().unwrap_or_default();
    let provenance = Provenance {
        dataset: dataset.to_string_lossy().into_owned(),
        facts: *facts,
        ..Default::default()
    };
    let origin = pictures.origin();
    page(path, feed, Some(pictures), bookmarks, up, provenance, origin)
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
    let provenance = Provenance { facts: *facts, ..Provenance::default() };
    page(path, feed, None, vec![bookmark], DVec3::NEG_Y, provenance, gaussians.origin)
}

fn page(
    path: &Path,
    feed: Feed,
    pictures: Option<Pictures>,
    bookmarks: Vec<Bookmark>,
    up: DVec3,
    provenance: Provenance,
    origin: DVec3,
) -> Result<Arc<Site>> {
    let title = path.display().to_string();
    let near = provenance.facts.near.unwrap_or_else(|| RenderSettings::default().near).into();
    let (gaussians, fingerprint, lamp) = (None, None, None);
    let page =
        ModelPage { title, gaussians, provenance, bookmarks, origin, fingerprint, near, up, lamp };
    let html = page.html()?;
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

/// The points of a dataset, in grey.
fn points(dataset: &Dataset) -> crate::Result<Gaussians> {
    const GREY: Vec3 = Vec3::splat(0.6);
    let origin = dataset.frame().file_origin();
    let positions: Vec<DVec3> =
        dataset.points.iter().map(|point| point.position - origin).collect();
    let start = Initialization { opacity: 0.9, scale: 0.3, ..Initialization::default() };
    let mut gaussians = Gaussians::from_points(
        &positions,
        &vec![GREY; positions.len()],
        Shape::default(),
        &start,
        0,
    )?;
    gaussians.origin = origin;
    Ok(gaussians)
}
