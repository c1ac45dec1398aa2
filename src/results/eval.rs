//! Scores a model on the test views of its dataset: against their reference images, or where there are none against what
//! the model was trained to show of them.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use serde_json::{Map, Value, json};

use crate::camera::{Camera, TrainingFrame};
use crate::gpu::Gpu;
use crate::loss::exposure::Affine;
use crate::networks::lpips::{Lpips, Measure};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::photographs::metrics::{self, Scores};
use crate::photographs::tone::{SceneTone, ToneCurve, ToneSettings};
use crate::splats::model::Model;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
use crate::splats::scene::{DeviceGaussians, Feature, Shape};
use crate::train::{Networks, Rendered, TestTargets, TrainConfig};
use crate::{Error, Result};

mod transmittance;

pub use transmittance::{
    MAX_RESIDUAL_TRANSMITTANCE, ResidualTransmittance, hole_warning, warn_of_holes,
};

/// What test views are scored against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReferenceKind {
    /// Normal-light photographs.
    #[default]
    References,
    /// What the run's own curve makes of the test views' photographs.
    PseudoGt,
    /// The test views' photographs: there is no curve, they are the targets.
    Photographs,
}

impl ReferenceKind {
    /// What a score is to be read with; none against references, as scores are understood.
    pub fn label(self) -> Option<&'static str> {
        match self {
            Self::References => None,
            Self::PseudoGt => Some(
                "against their own pseudo-GT, as there are no reference images: how well the model shows its targets, not how \
                 right these are; runs of different curves do not compare",
            ),
            Self::Photographs => Some(
                "against the photographs themselves, as there are no reference images and no curve",
            ),
        }
    }

    /// In a word or two, within a line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::References => "reference images",
            Self::PseudoGt => "pseudo-GT",
            Self::Photographs => "photographs",
        }
    }
}

/// What the test views of a dataset are scored against.
#[derive(Debug, Default)]
pub struct ScoreReference {
    /// Which kind that is.
    pub against: ReferenceKind,
    /// What makes them, where they are no reference images.
    targets: Option<TestTargets>,
    /// What it made, by view, of photographs that are kept as well.
    made: BTreeMap<String, Image>,
}

impl ScoreReference {
    /// The reference images where a test view has one; without any, the targets that `tone apply` gives the test views in the
    /// scene of the training photographs.
    ///
    /// # Errors
    /// Every photograph is as good as black, one can no longer be read, or the device is out of memory or lost.
    pub fn of(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        Self::made_by(tone, dataset, || TestTargets::new(gpu, tone, dataset))
    }

    /// The same where the scene of the training photographs is known.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn in_scene(
        gpu: &Gpu,
        tone: &ToneSettings,
        dataset: &Dataset,
        scene: &SceneTone,
    ) -> Result<Self> {
        Self::made_by(tone, dataset, || TestTargets::in_scene(gpu, tone, scene))
    }

    fn made_by(
        tone: &ToneSettings,
        dataset: &Dataset,
        targets: impl FnOnce() -> Result<TestTargets>,
    ) -> Result<Self> {
        let against = Self::kind(tone, dataset);
        let targets = (against != ReferenceKind::References).then(targets).transpose()?;
        Ok(Self { against, targets, made: BTreeMap::new() })
    }

    /// Which kind it will be.
    pub fn kind(tone: &ToneSettings, dataset: &Dataset) -> ReferenceKind {
        let has_references = dataset.test_views().any(View::has_reference);
        let has_photographs = dataset.test_views().any(View::has_photograph);
        match tone.curve {
            _ if has_references || !has_photographs => ReferenceKind::References,
            ToneCurve::None => ReferenceKind::Photographs,
            _ => ReferenceKind::PseudoGt,
        }
    }

    /// How many of the dataset's test views it has something for.
    pub fn view_count(&self, dataset: &Dataset) -> usize {
        let has_target = match self.against {
            ReferenceKind::References => View::has_reference,
            _ => View::has_photograph,
        };
        dataset.test_views().filter(|view| has_target(view)).count()
    }

    /// What a view is held to, in 8 bits.
    fn target(&mut self, view: &View) -> Result<Option<Image>> {
        let Some(targets) = &mut self.targets else {
            return Ok(view.loaded_reference()?.map(|reference| quantized(&reference)));
        };
        if let Some(made) = self.made.get(&view.name) {
            return Ok(Some(made.clone()));
        }
        let target = targets.of(view)?.map(|target| quantized(&target));
        let kept = target.as_ref().filter(|_| view.image.is_some());
        self.made.extend(kept.map(|target| (view.name.clone(), target.clone())));
        Ok(target)
    }
}

/// What a test view scores.
#[derive(Clone, Debug)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// The scores of what the model shows: R_K, or R_0 where it has no denoiser.
    pub scores: Scores,
    /// Those of R_0, where the model has a denoiser.
    pub r0: Option<Scores>,
    /// Those behind the gain and bias of each channel that bring the render nearest to what it should be, where it was asked.
    pub aligned: Option<Scores>,
    /// How much of the background shows; none of what is no render.
    pub residual_transmittance: Option<ResidualTransmittance>,
    /// What it was scored against.
    pub against: ReferenceKind,
}

/// The two pictures that a view's scores compare, in 8 bits as they are saved.
#[derive(Debug)]
pub struct ScoredImages<'a> {
    /// The view.
    pub view: &'a View,
    /// What the model shows of it.
    pub render: Image,
    /// What it should be.
    pub target: Image,
}

impl ScoredImages<'_> {
    /// LPIPS over the pixels that count.
    ///
    /// # Errors
    /// Those of [`Lpips::distance`].
    pub fn lpips(&self, gpu: &Gpu, lpips: &Lpips) -> Result<f64> {
        let Self { view, render, target } = self;
        let mask = view.mask.as_ref().map(|mask| mask.resized(render.width, render.height));
        lpips.distance(gpu, &metrics::counted(render, target, mask.as_deref()), target)
    }

    /// The scores behind the gain and bias of each channel that bring the render nearest to what it should be.
    ///
    /// # Errors
    /// None for what [`score_by`] shows.
    pub fn aligned(&self) -> Result<Scores> {
        let affine = Affine::least_squares(&self.render, &self.target)?;
        Scores::of(&quantized(&affine.applied(&self.render)), &self.target)
    }

    /// Writes `renders/NAME.png` and `references/NAME.png` below `folder`; what is no reference image, to `targets`.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn save(&self, folder: &Path, against: ReferenceKind) -> Result<()> {
        let targets = match against {
            ReferenceKind::References => "references",
            _ => "targets",
        };
        for (name, image) in [("renders", &self.render), (targets, &self.target)] {
            let folder = folder.join(name);
            std::fs::create_dir_all(&folder)
                .map_err(|error| Error::output(&folder, format!("cannot be made ({error})")))?;
            let path = folder.join(format!("{}.png", self.view.name));
            self.view.upright(image.clone()).save_png8(path)?;
        }
        Ok(())
    }
}

/// A finished model on the device, ready to be rendered.
#[derive(Debug)]
pub struct ModelRenderer {
    gaussians: DeviceGaussians,
    renderer: Renderer,
    networks: Option<Networks>,
    /// Where the Gaussians lie.
    frame: TrainingFrame,
}

impl ModelRenderer {
    /// Uploads the model of a run of `config`; `networks` belong to it. The run's tile is taken where it suits the device.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(
        gpu: &Gpu,
        model: &Model,
        config: &TrainConfig,
        networks: Option<Networks>,
    ) -> Result<Self> {
        let frame = config.frame.unwrap_or_default();
        let settings = RenderSettings {
            tile: config.tile.filter(|&tile| gpu.properties().suits_tile(tile)),
            patch_pixels: config.patch_pixels,
            near: (f64::from(model.near) * frame.scale) as f32,
            ..model.render_settings()
        };
        Ok(Self {
            frame,
            gaussians: model.gaussians.to_frame(&frame).upload(gpu)?,
            renderer: Renderer::new(gpu, settings)?,
            networks,
        })
    }

    /// What the view's camera sees, before a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, view: &View) -> Result<Rendered> {
        self.render_camera(&view.camera)
    }

    /// What any camera of the dataset's world sees, before a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render_camera(&mut self, camera: &Camera) -> Result<Rendered> {
        let (camera, options) = (&self.frame.camera(camera), self.options());
        let networks = self.networks.as_mut();
        Rendered::new(&mut self.renderer, &self.gaussians, camera, &options, networks)
    }

    /// One layer of what a camera sees; a feature of one channel is repeated.
    ///
    /// # Errors
    /// The model has no such layer, or the device is out of memory or lost.
    pub fn layer(&mut self, camera: &Camera, layer: RenderLayer) -> Result<Image> {
        let lacks =
            || Error::Usage(format!("the model has no {}; {}", layer.name(), self.layers()));
        let feature = match layer {
            RenderLayer::Rgb => return Ok(self.render_camera(camera)?.colors),
            RenderLayer::Denoised => {
                let lacks = lacks();
                return self.render_camera(camera)?.denoised.ok_or(lacks);
            }
            RenderLayer::Depth => Feature::Depth,
            RenderLayer::Structure => Feature::Structure,
            RenderLayer::Illumination => Feature::Illumination,
            RenderLayer::Noise => Feature::Noise,
        };
        let planes = self.shape().features.channels_of(feature).ok_or_else(lacks)?;
        let Camera { width, height, .. } = *camera;
        let pixels = width as usize * height as usize;
        let (camera, options) = (&self.frame.camera(camera), self.options());
        self.renderer.reserve(self.gaussians.layout.count, [camera])?;
        let channels = self.renderer.render_channels(&self.gaussians, camera, &options)?;
        let plane = |c: usize| {
            let plane = planes.start + c.min(planes.len() - 1);
            channels[plane * pixels..][..pixels].iter().copied()
        };
        Ok(Image { width, height, data: (0..3).flat_map(plane).collect() })
    }

    /// What the model does have, for a message.
    fn layers(&self) -> String {
        let denoised = self.networks.as_ref().is_some_and(Networks::has_denoiser);
        let features = self.shape().features.specs().map(|spec| spec.name);
        let names: Vec<&str> =
            ["rgb"].into_iter().chain(denoised.then_some("denoised")).chain(features).collect();
        format!("it has {}", names.join(", "))
    }

    fn options(&self) -> RenderOptions {
        RenderOptions { sh_degree: self.shape().sh_degree, background: [0.0; 3] }
    }

    fn shape(&self) -> Shape {
        self.gaussians.layout.shape
    }
}

/// What can be seen of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RenderLayer {
    /// R_0, the Gaussians' colours.
    Rgb,
    /// R_K, behind the denoiser.
    Denoised,
    /// The depth feature, in units of its own.
    Depth,
    /// The structure feature.
    Structure,
    /// The illumination feature.
    Illumination,
    /// The noise feature.
    Noise,
}

impl RenderLayer {
    /// Every layer.
    pub const ALL: [Self; 6] =
        [Self::Rgb, Self::Denoised, Self::Depth, Self::Structure, Self::Illumination, Self::Noise];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb",
            Self::Denoised => "denoised",
            Self::Depth => "depth",
            Self::Structure => "structure",
            Self::Illumination => "illumination",
            Self::Noise => "noise",
        }
    }

    /// Whether its values are colour, sRGB-encoded, rather than numbers.
    pub(crate) fn is_color(self) -> bool {
        matches!(self, Self::Rgb | Self::Denoised)
    }
}

impl FromStr for RenderLayer {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|layer| layer.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown layer `{name}`; the layers are {names}"))
        })
    }
}

/// Scores every test view that has a reference image; `render` draws a view. Both images are clamped and rounded to 8
/// bits first, so that what is scored is what is saved.
///
/// # Errors
/// Those of `render`; a reference image that is not kept can no longer be read.
#[cfg(feature = "testing")]
pub fn score(
    dataset: &Dataset,
    render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Vec<ViewScore>> {
    score_by(&mut ScoreReference::default(), dataset, render, |_, _| Ok(()))
}

/// As [`score`], by any yardstick; `look` sees the pictures of each view, which are gone behind it.
///
/// # Errors
/// As there, and those of `look`; a photograph that is not kept can no longer be read, or the device is out of memory or lost.
pub fn score_by(
    score_reference: &mut ScoreReference,
    dataset: &Dataset,
    mut render: impl FnMut(&View) -> Result<Rendered>,
    mut look: impl FnMut(&mut ViewScore, &ScoredImages<'_>) -> Result<()>,
) -> Result<Vec<ViewScore>> {
    let (mut scored, against) = (vec![], score_reference.against);
    for view in dataset.test_views() {
        let Some(target) = score_reference.target(view)? else { continue };
        let rendered = render(view)?;
        let compared = ScoredImages { view, render: quantized(rendered.output()), target };
        let of = |render: &Image| Scores::of_counted(render, &compared.target, view.mask.as_ref());
        let has_denoiser = rendered.denoised.is_some();
        let mut score = ViewScore {
            name: view.name.clone(),
            scores: of(&compared.render)?,
            r0: has_denoiser.then(|| of(&quantized(&rendered.colors))).transpose()?,
            aligned: None,
            residual_transmittance: ResidualTransmittance::of(&rendered, view),
            against,
        };
        look(&mut score, &compared)?;
        scored.push(score);
    }
    Ok(scored)
}

/// `metrics.json`: means and views, and what the run took; null where that, or a mean, is not known. [`add_lpips`] adds LPIPS.
pub fn metrics(
    scored: &[ViewScore],
    seconds: impl Into<Option<f64>>,
    gaussians: usize,
    steps: u64,
) -> Value {
    let (all, r0) = means(scored);
    let mean = all.map_or(Value::Null, |mean| entry(&mean, r0.as_ref()));
    let views: Map<String, Value> = scored
        .iter()
        .map(|view| (view.name.clone(), entry(&view.scores, view.r0.as_ref())))
        .collect();
    let mut metrics = json!({
        "mean": mean,
        "views": views,
        "seconds": seconds.into(),
        "gaussians": gaussians,
        "steps": steps,
    });
    if let Some(label) = label(scored) {
        metrics[AGAINST] = json!(label);
    }
    let residual_transmittances =
        || scored.iter().filter_map(|view| Some((&view.name, view.residual_transmittance?)));
    if let Some(mean) = ResidualTransmittance::mean(
        residual_transmittances().map(|(_, residual_transmittance)| residual_transmittance),
    ) {
        let views: BTreeMap<_, _> = residual_transmittances().collect();
        metrics["residual_transmittance"] = json!({ "mean": mean, "views": views });
    }
    metrics
}

/// Where `metrics.json` says what the scores are against, where that is no reference image.
pub const AGAINST: &str = "against";

/// What the scores are to be read with, where they are against no reference images.
pub fn label(scored: &[ViewScore]) -> Option<&'static str> {
    scored.first().and_then(|view| view.against.label())
}

/// Where `metrics.json` says what the targets know of references, where they know any.
pub const WITH_REFERENCE: &str = "with_reference";

/// The line beside scores of targets that know references.
pub fn with_reference(known: &str) -> String {
    format!(
        "with reference: the targets follow {known}; not comparable with scores that know no reference"
    )
}

/// Says in `metrics.json` of targets that know references what they know.
pub fn add_reference(metrics: &mut Value, tone: &ToneSettings) {
    if let Some(known) = tone.knows_references() {
        metrics[WITH_REFERENCE] = json!(known);
    }
}

/// Adds LPIPS to the mean and the views of `metrics.json` under the key of its measure, and says which measure that is.
pub fn add_lpips(metrics: &mut Value, scored: &[ViewScore], measure: Measure) {
    let key = measure.key();
    let Measure { network, range } = measure;
    metrics["lpips"] = json!({ "network": network.name(), "range": range.name(), "key": key });
    let (mean, _) = means(scored);
    if let Some(lpips) = mean.and_then(|mean| mean.lpips) {
        metrics["mean"][&key] = json!(lpips);
    }
    for ViewScore { name, scores, .. } in scored {
        if let Some(lpips) = scores.lpips {
            metrics["views"][name][&key] = json!(lpips);
        }
    }
}

/// Says in `metrics.json` of a model with learned exposures at which one the test views were scored, as no photograph of
/// theirs was trained on: at the neutral one, the mean of the training views. Beside it stand the scores behind the affine
/// of each channel that brings each render nearest to its reference image, which is what others report; they know the
/// reference and compare with nothing else here.
pub fn add_exposure(metrics: &mut Value, scored: &[ViewScore]) {
    let aligned = || scored.iter().filter_map(|view| Some((&view.name, view.aligned?)));
    let scores: Vec<Scores> = aligned().map(|(_, scores)| scores).collect();
    let views: Map<String, Value> =
        aligned().map(|(name, scores)| (name.clone(), entry(&scores, None))).collect();
    metrics["exposure"] = json!("neutral: the mean of the training views'");
    metrics["aligned_with_reference"] = json!({
        "what": "behind the least-squares gain and bias of each channel of each test view against its reference image",
        "mean": Scores::mean(&scores).map(|mean| entry(&mean, None)),
        "views": views,
    });
}

/// The mean scores, and those of R_0 where the model has a denoiser.
pub fn means(scored: &[ViewScore]) -> (Option<Scores>, Option<Scores>) {
    let all: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    let r0: Vec<Scores> = scored.iter().filter_map(|view| view.r0).collect();
    (Scores::mean(&all), Scores::mean(&r0))
}

/// A score as JSON, that of R_0 in it; infinite PSNR, of equal images, has no JSON number and is null.
fn entry(scores: &Scores, r0: Option<&Scores>) -> Value {
    let mut entry = json!({
        "psnr": scores.psnr,
        "psnr_channel_mean": scores.psnr_channel_mean,
        "ssim": scores.ssim,
    });
    if let Some(r0) = r0 {
        entry["r0"] = self::entry(r0, None);
    }
    entry
}

/// Clamped to [0, 1] and rounded to multiples of 1/255. A NaN becomes 0.
pub(crate) fn quantized(image: &Image) -> Image {
    let data = image.data.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0).round().max(0.0) / 255.0);
    Image { width: image.width, height: image.height, data: data.collect() }
}
