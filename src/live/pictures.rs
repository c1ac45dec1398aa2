//! Images of a dataset's views for the live page, made when they are asked for.

use std::borrow::Cow;
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

use glam::DVec3;
use hyper::body::Bytes;
use nightsplat_core::camera::CameraModel;
use nightsplat_core::natural;
use nightsplat_models::export::page::{Bookmark, PageImage, moved};
use nightsplat_photographs::dataset::{Dataset, LoadOptions, MeasuredSize, View};
use nightsplat_photographs::image::{Image, ImageFile};
use nightsplat_photographs::tone::ToneCurve;

use crate::Result;
use crate::driver;
use crate::gpu::Gpu;
use crate::targets::Targets;
use crate::train::TrainConfig;

/// What an image shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Photograph,
    Target,
    Reference,
}

const KINDS: [(&str, Kind); 3] =
    [("photograph", Kind::Photograph), ("target", Kind::Target), ("reference", Kind::Reference)];

/// Quality of the JPEGs.
const QUALITY: u8 = 90;
/// The most memory of finished images, in bytes.
const KEPT: usize = 64 << 20;

/// The images of a dataset's views.
#[derive(Debug)]
pub(crate) struct Pictures {
    dataset: Arc<Dataset>,
    /// The names of views with a photograph that `dataset` does not have.
    unloaded: BTreeSet<String>,
    /// With the photographs of all views, loaded for the first of those.
    complete: Option<Dataset>,
    config: TrainConfig,
    /// Opened for the first target.
    gpu: Option<Gpu>,
    /// The training photographs are measured for the first target.
    targets: Option<Targets>,
    /// The last are kept.
    finished: VecDeque<((usize, Kind), Bytes)>,
}

impl Pictures {
    /// Loads the dataset of a configuration, but no photograph. Without a device, one is opened for the first target.
    pub(crate) fn load(config: TrainConfig, gpu: Option<Gpu>) -> Result<Self> {
        let dataset = Dataset::load(&config.dataset, &options(&config))?;
        Ok(Self::new(dataset.into(), BTreeSet::new(), config, gpu))
    }

    /// The dataset that a training has loaded, unless it has a fisheye: then it is loaded again for the pinhole cameras
    /// of the viewer.
    pub(crate) fn of_training(
        config: TrainConfig,
        gpu: Gpu,
        dataset: &Arc<Dataset>,
    ) -> Result<Self> {
        if dataset.views.iter().any(|view| view.camera.model != CameraModel::Pinhole) {
            return Self::load(config, Some(gpu));
        }
        // A training does not load the photographs of test views.
        let (listed, ..) = Dataset::listed(&config.dataset, &options(&config))?;
        let listed: BTreeSet<String> = listed.into_iter().map(|listed| listed.name).collect();
        let lacks = |view: &&View| !view.has_photograph() && listed.contains(&view.name);
        let unloaded = dataset.views.iter().filter(lacks).map(|view| view.name.clone()).collect();
        Ok(Self::new(Arc::clone(dataset), unloaded, config, Some(gpu)))
    }

    fn new(
        dataset: Arc<Dataset>,
        unloaded: BTreeSet<String>,
        config: TrainConfig,
        gpu: Option<Gpu>,
    ) -> Self {
        let finished = VecDeque::new();
        Self { dataset, unloaded, complete: None, config, gpu, targets: None, finished }
    }

    pub(crate) fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// The world position that the coordinates of models and bookmarks are relative to.
    pub(crate) fn origin(&self) -> DVec3 {
        self.config.frame.unwrap_or_else(|| self.dataset.frame()).file_origin()
    }

    /// The cameras of all views, for a model whose origin is that of the dataset's training frame, and the addresses of
    /// their images.
    pub(crate) fn bookmarks(&self) -> Vec<Bookmark> {
        let origin = self.origin();
        let bookmark = |(index, view): (usize, &View)| {
            let kinds = KINDS.iter().filter(|(_, kind)| self.has(view, *kind));
            let picture = |(name, _): &(&str, Kind)| {
                ((*name).to_owned(), PageImage::At(format!("picture/{index}/{name}")))
            };
            Bookmark {
                name: view.name.clone(),
                camera: moved(&view.upright_camera(), origin),
                pictures: kinds.map(picture).collect(),
            }
        };
        let mut bookmarks: Vec<Bookmark> =
            self.dataset.views.iter().enumerate().map(bookmark).collect();
        bookmarks.sort_by(|a, b| natural::compare(&a.name, &b.name));
        bookmarks
    }

    fn has(&self, view: &View, kind: Kind) -> bool {
        let has_photograph = view.has_photograph() || self.unloaded.contains(&view.name);
        match kind {
            Kind::Photograph => has_photograph,
            Kind::Reference => view.has_reference(),
            Kind::Target => has_photograph && self.config.tone.curve != ToneCurve::None,
        }
    }

    /// An image of the view at `view` in the dataset, upright, as JPEG; `None` if there is none.
    pub(super) fn jpeg(&mut self, view: usize, kind: &str) -> Result<Option<Bytes>> {
        let Some((_, kind)) = KINDS.iter().find(|(name, _)| *name == kind) else { return Ok(None) };
        let wanted = (view, *kind);
        if let Some((_, encoded)) = self.finished.iter().find(|(key, _)| *key == wanted) {
            return Ok(Some(encoded.clone()));
        }
        let Some(image) = self.image(view, *kind)? else { return Ok(None) };
        let jpeg = Bytes::from(image.to_jpeg(QUALITY)?);
        self.finished.push_back((wanted, jpeg.clone()));
        while self.finished.iter().map(|(_, jpeg)| jpeg.len()).sum::<usize>() > KEPT {
            self.finished.pop_front();
        }
        Ok(Some(jpeg))
    }

    fn image(&mut self, index: usize, kind: Kind) -> Result<Option<Image>> {
        let Self { dataset, unloaded, complete, config, gpu, targets, .. } = self;
        let Some(mut view) = dataset.views.get(index) else { return Ok(None) };
        if kind != Kind::Reference && unloaded.contains(&view.name) {
            let all = match complete.take() {
                Some(all) => all,
                None => Dataset::load(&config.dataset, &options(config))?,
            };
            let all = complete.insert(all);
            view = all.views.iter().find(|loaded| loaded.name == view.name).unwrap_or(view);
        }
        let image = match kind {
            Kind::Photograph => view.loaded()?.map(Cow::into_owned),
            Kind::Reference => view.loaded_reference()?.map(Cow::into_owned),
            Kind::Target if config.tone.curve == ToneCurve::None => None,
            Kind::Target => {
                if targets.is_none() {
                    let opened = match gpu.take() {
                        Some(made) => made,
                        None => driver::open(&config.device.parse()?)?,
                    };
                    *targets = Some(Targets::new(&opened, &config.tone, dataset)?);
                    *gpu = Some(opened);
                }
                targets.as_ref().map_or(Ok(None), |targets| targets.target(view))?
            }
        };
        Ok(image.map(|image| view.upright(image)))
    }
}

/// How the page loads a dataset: no photograph is kept, and photographs are measured for the first target, if one is
/// asked for.
fn options(config: &TrainConfig) -> LoadOptions {
    let mut options = config.load_options();
    // The viewer has a pinhole camera.
    (options.undistort, options.load_low_test, options.keep) = (true, true, Some(0));
    options.measured = MeasuredSize::None;
    options
}
