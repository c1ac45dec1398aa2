//! Scores a model on the test views of its dataset: against their reference images or, without any, against their
//! targets.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value, json};

use crate::camera::{Camera, TrainingFrame};
use crate::gpu::Gpu;
use crate::loss::exposure::Affine;
use crate::networks::lpips::{Lpips, Measure};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::{Image, linear_from_srgb, srgb_from_linear};
use crate::photographs::metrics::{self, Scores};
use crate::photographs::targets::{SceneTone, Targets};
use crate::photographs::tone::{ToneCurve, ToneSettings};
use crate::splats::lamp::Lamp;
use crate::splats::model::Model;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
use crate::splats::scene::{DeviceGaussians, Shape};
use crate::train::{Networks, Rendered, TrainConfig};
use crate::{Error, Result};

mod layers;
mod lit;
mod transmittance;

use layers::Normals;
pub use layers::RenderLayer;
use lit::lit_folder;
pub(crate) use lit::{add_lit, mean_lit, score_lit};
pub use transmittance::{
    MAX_RESIDUAL_TRANSMITTANCE, ResidualTransmittance, hole_warning, warn_of_holes,
};

/// The images that test views are scored against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReferenceKind {
    /// Normal-light photographs.
    #[default]
    References,
    /// The photographs of the test views, tone-mapped with the run's curve.
    PseudoGt,
    /// The photographs of the test views: without a curve, they are the targets.
    Photographs,
}

impl ReferenceKind {
    /// Note for readers of a score; `None` for references, the usual meaning of a score.
    pub fn label(self) -> Option<&'static str> {
        match self {
            Self::References => None,
            Self::PseudoGt => Some(
                "against their own pseudo-GT, as there are no reference images: how well the model reproduces its \
                 targets, not how right these are; runs of different curves do not compare",
            ),
            Self::Photographs => Some(
                "against the photographs themselves, as there are no reference images and no curve",
            ),
        }
    }

    /// Short name, for use within a line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::References => "reference images",
            Self::PseudoGt => "pseudo-GT",
            Self::Photographs => "photographs",
        }
    }
}

/// The images that the test views of a dataset are scored against.
#[derive(Debug, Default)]
pub struct ScoreReference {
    /// Their kind.
    pub against: ReferenceKind,
    /// Makes the targets, unless there are reference images.
    targets: Option<Targets>,
    /// Targets made so far, by view, if photographs are cached as well.
    made: BTreeMap<String, Image>,
}

impl ScoreReference {
    /// The reference images of the test views that have one; without any, the targets that `tone apply` gives the test
    /// views, with the statistics of the training photographs.
    pub fn of(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        Self::made_by(tone, dataset, || Targets::new(gpu, tone, dataset))
    }

    /// [`ScoreReference::of`] with given statistics of the training photographs.
    pub fn in_scene(gpu: &Gpu, dataset: &Dataset, scene: &SceneTone) -> Result<Self> {
        Self::made_by(scene.settings(), dataset, || Targets::in_scene(gpu, scene.clone()))
    }

    fn made_by(
        tone: &ToneSettings,
        dataset: &Dataset,
        targets: impl FnOnce() -> Result<Targets>,
    ) -> Result<Self> {
        let against = Self::kind(tone, dataset);
        let targets = (against != ReferenceKind::References).then(targets).transpose()?;
        Ok(Self { against, targets, made: BTreeMap::new() })
    }

    /// The kind that [`ScoreReference::of`] chooses.
    pub fn kind(tone: &ToneSettings, dataset: &Dataset) -> ReferenceKind {
        let has_references = dataset.test_views().any(View::has_reference);
        let has_photographs = dataset.test_views().any(View::has_photograph);
        if has_references || !has_photographs {
            ReferenceKind::References
        } else if tone.curve == ToneCurve::None {
            ReferenceKind::Photographs
        } else {
            ReferenceKind::PseudoGt
        }
    }

    /// Whether it is evenly lit where a lamp lights the photographs: the reference images of a dataset that has these
    /// views in the lamp's light as well.
    pub(crate) fn is_evenly_lit(&self, dataset: &Dataset) -> bool {
        self.against == ReferenceKind::References && lit_folder(dataset).is_dir()
    }

    /// The number of test views that can be scored.
    pub fn view_count(&self, dataset: &Dataset) -> usize {
        let has_target = match self.against {
            ReferenceKind::References => View::has_reference,
            _ => View::has_photograph,
        };
        dataset.test_views().filter(|view| has_target(view)).count()
    }

    /// The image that a view is scored against, in 8 bits.
    fn target(&mut self, view: &View) -> Result<Option<Image>> {
        let Some(targets) = &mut self.targets else {
            return Ok(view.loaded_reference()?.map(|reference| quantized(&reference)));
        };
        if let Some(made) = self.made.get(&view.name) {
            return Ok(Some(made.clone()));
        }
        let target = targets.target(view)?.map(|target| quantized(&target));
        let kept = target.as_ref().filter(|_| view.image.is_some());
        self.made.extend(kept.map(|target| (view.name.clone(), target.clone())));
        Ok(target)
    }
}

/// The scores of a test view.
#[derive(Clone, Debug)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// Scores of the final image: R_K, or R_0 without a denoiser.
    pub scores: Scores,
    /// Scores of R_0, if the model has a denoiser.
    pub r0: Option<Scores>,
    /// Scores after the least-squares gain and bias of each channel, if requested.
    pub aligned: Option<Scores>,
    /// Scores at the view's own exposure, if it is known.
    pub exposed: Option<Scores>,
    /// Scores in the light of the lamp, against `lit/NAME.png`, after the least-squares gain and bias of each channel;
    /// if the model has a lamp and the dataset the image.
    pub lit: Option<Scores>,
    /// The view as a photograph against its own photograph, if requested: PSNR in dB, by how many stops of linear light
    /// it is brighter, and how many times a small difference of photographs is that of their targets.
    pub photograph: Option<[f64; 3]>,
    /// The background that shows through; `None` if the image is not a render.
    pub residual_transmittance: Option<ResidualTransmittance>,
    /// What the view was scored against.
    pub against: ReferenceKind,
}

/// The two images that a view's scores compare, in 8 bits as they are saved.
#[derive(Debug)]
pub struct ScoredImages<'a> {
    /// The view.
    pub view: &'a View,
    /// The model's image of it.
    pub render: Image,
    /// The image that it is compared with.
    pub target: Image,
}

impl ScoredImages<'_> {
    /// LPIPS of the unmasked pixels.
    pub fn lpips(&self, gpu: &Gpu, lpips: &Lpips) -> Result<f64> {
        let Self { view, render, target } = self;
        let mask = view.mask.as_ref().map(|mask| mask.resized(render.width, render.height));
        lpips.distance(gpu, &metrics::counted(render, target, mask.as_deref()), target)
    }

    /// The scores after the gain and bias of each channel that minimise the squared error to the target.
    pub fn aligned(&self) -> Result<Scores> {
        let affine = Affine::least_squares(&self.render, &self.target)?;
        Scores::of(&quantized(&affine.applied(&self.render)), &self.target)
    }

    /// The scores of the render by some stops of linear light brighter.
    pub(crate) fn exposed(&self, stops: f64) -> Result<Scores> {
        let light = stops.exp2() as f32;
        let brighter = |&x: &f32| srgb_from_linear(light * linear_from_srgb(x));
        let data = self.render.data.iter().map(brighter).collect();
        let brighter = quantized(&Image { data, ..self.render });
        Scores::of_counted(&brighter, &self.target, self.view.mask.as_ref())
    }

    /// Writes `renders/NAME.png` and `references/NAME.png` in `folder`; `targets/NAME.png` if there are no reference
    /// images.
    pub fn save(&self, folder: &Path, against: ReferenceKind) -> Result<()> {
        let targets = match against {
            ReferenceKind::References => "references",
            _ => "targets",
        };
        for (name, image) in [("renders", &self.render), (targets, &self.target)] {
            let folder = folder.join(name);
            std::fs::create_dir_all(&folder)
                .map_err(|error| Error::output(&folder, format!("cannot be created ({error})")))?;
            let path = folder.join(format!("{}.png", self.view.name));
            self.view.upright(image.clone()).save_png8(path)?;
        }
        Ok(())
    }
}

/// A finished model on the device, ready to render.
#[derive(Debug)]
pub struct ModelRenderer {
    gpu: Gpu,
    gaussians: DeviceGaussians,
    renderer: Renderer,
    networks: Option<Networks>,
    /// The training frame, in which the Gaussians are.
    frame: TrainingFrame,
    background: [f32; 3],
    /// Made for the first render of normals.
    normals: Option<Normals>,
}

impl ModelRenderer {
    /// Uploads the model of a run of `config`, with its `networks`. The run's tile size is used if the device supports
    /// it.
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
            gpu: gpu.clone(),
            frame,
            background: [0.0; 3],
            normals: None,
            gaussians: model.gaussians.to_frame(&frame).upload(gpu)?,
            renderer: Renderer::new(gpu, settings)?,
            networks,
        })
    }

    /// Lights what is rendered from now on by a lamp at the camera, in units of the dataset's world, or evenly.
    pub(crate) fn set_lamp(&mut self, lamp: Option<Lamp>) -> Result<()> {
        self.renderer.set_lamp(lamp.map(|lamp| lamp.scaled(self.frame.scale)))
    }

    /// Renders a view as [`ScoreReference`] shows it: in the light of its photograph, or evenly lit.
    pub(crate) fn render_as(&mut self, view: &View, in_even_light: bool) -> Result<Rendered> {
        self.renderer.set_even_light(in_even_light);
        let rendered = self.render(view);
        self.renderer.set_even_light(false);
        rendered
    }

    /// Renders over this colour, display-referred, from now on; black is the default.
    pub(crate) fn set_background(&mut self, background: [f32; 3]) {
        self.background = background;
    }

    /// Renders a view over the background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, view: &View) -> Result<Rendered> {
        self.render_camera(&view.camera)
    }

    /// Renders a camera in the dataset's world over the background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render_camera(&mut self, camera: &Camera) -> Result<Rendered> {
        let (camera, options) = (&self.frame.camera(camera), self.options());
        let networks = self.networks.as_mut();
        Rendered::new(&mut self.renderer, &self.gaussians, camera, &options, networks)
    }

    fn options(&self) -> RenderOptions {
        RenderOptions { sh_degree: self.shape().sh_degree, background: self.background }
    }

    fn shape(&self) -> Shape {
        self.gaussians.layout.shape
    }
}

/// Scores every test view that has a reference image; `render` renders a view. Both images are clamped and rounded to 8
/// bits first, as they are saved.
#[cfg(feature = "testing")]
pub fn score(
    dataset: &Dataset,
    render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Vec<ViewScore>> {
    score_by(&mut ScoreReference::default(), dataset, render, |_, _| Ok(()))
}

/// [`score`] against any reference; `inspect` is called with the images of each view.
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
            exposed: None,
            lit: None,
            photograph: None,
            residual_transmittance: ResidualTransmittance::of(&rendered, view),
            against,
        };
        look(&mut score, &compared)?;
        scored.push(score);
    }
    Ok(scored)
}

/// `metrics.json`: means, views, and the resources of the run; unknown values are null. [`add_lpips`] adds LPIPS.
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

/// Key in `metrics.json` for what the scores are against, unless it is reference images.
pub const AGAINST: &str = "against";

/// Note for readers of the scores, unless they are against reference images.
pub fn label(scored: &[ViewScore]) -> Option<&'static str> {
    scored.first().and_then(|view| view.against.label())
}

/// Key in `metrics.json` for what the targets take from reference images, if anything.
pub const WITH_REFERENCE: &str = "with_reference";

/// The note next to scores whose targets depend on reference images.
pub fn with_reference(known: &str) -> String {
    format!(
        "with reference: the targets depend on {known}; not comparable with scores without reference"
    )
}

/// Adds [`WITH_REFERENCE`] to `metrics.json` if the targets depend on reference images.
pub fn add_reference(metrics: &mut Value, tone: &ToneSettings) {
    if let Some(known) = tone.knows_references() {
        metrics[WITH_REFERENCE] = json!(known);
    }
}

/// Adds the mean LPIPS and that of each view to `metrics.json`, with the name of the measure.
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

/// Adds to `metrics.json` of a model with learned exposures the exposure at which the test views were scored: the
/// neutral one, the mean of the training views, since no exposure is learned for test views. Also adds the scores after
/// a least-squares affine correction of each channel to the reference image, as other work reports them; these use the
/// reference and are not comparable with other scores here.
pub fn add_exposure(metrics: &mut Value, scored: &[ViewScore]) {
    metrics["exposure"] = json!("neutral: the mean of the training views' in stops");
    add_aligned(metrics, scored);
}

/// Adds to `metrics.json` the scores after a least-squares affine correction of each channel to the reference image.
pub(crate) fn add_aligned(metrics: &mut Value, scored: &[ViewScore]) {
    let what = "after the least-squares gain and bias of each channel of each test view against its reference image";
    metrics["aligned_with_reference"] = other_scores(what, scored, |view| view.aligned);
}

/// Adds to `metrics.json` the scores of test views at their own exposure, relative to the mean of the training views.
pub(crate) fn add_exposed(metrics: &mut Value, scored: &[ViewScore]) {
    if scored.iter().any(|view| view.exposed.is_some()) {
        let what = "at each test view's own exposure, from EXIF or exposures.csv: the render is brighter by those \
                    stops of linear light; no pixel of a test view is used";
        metrics["at_own_exposure"] = other_scores(what, scored, |view| view.exposed);
    }
}

/// A second kind of scores of some views, with its description.
fn other_scores(
    what: &str,
    scored: &[ViewScore],
    of: impl Fn(&ViewScore) -> Option<Scores>,
) -> Value {
    let all = || scored.iter().filter_map(|view| Some((&view.name, of(view)?)));
    let scores: Vec<Scores> = all().map(|(_, scores)| scores).collect();
    let views: Map<String, Value> =
        all().map(|(name, scores)| (name.clone(), entry(&scores, None))).collect();
    let mean = Scores::mean(&scores).map(|mean| entry(&mean, None));
    json!({ "what": what, "mean": mean, "views": views })
}

/// Adds to `metrics.json` the scores of renders in the light of the photographs, against these.
pub(crate) fn add_photographs(metrics: &mut Value, scored: &[ViewScore]) {
    let entry =
        |[psnr, stops, slope]: [f64; 3]| json!({ "psnr": psnr, "stops": stops, "slope": slope });
    let all = || scored.iter().filter_map(|view| Some((&view.name, view.photograph?)));
    let views: Map<String, Value> = all().map(|(name, own)| (name.clone(), entry(own))).collect();
    metrics["as_photographs"] = json!({
        "what": "renders through the inverse of the tone curve, against the dark photographs",
        "mean": mean_photograph(scored).map(entry),
        "views": views,
    });
}

/// The mean scores against the photographs, if there are any.
pub(crate) fn mean_photograph(scored: &[ViewScore]) -> Option<[f64; 3]> {
    let all: Vec<[f64; 3]> = scored.iter().filter_map(|view| view.photograph).collect();
    let mean = |at: usize| all.iter().map(|own| own[at]).sum::<f64>() / all.len() as f64;
    (!all.is_empty()).then(|| [0, 1, 2].map(mean))
}

/// The mean scores, and the mean scores of R_0 if the model has a denoiser.
pub fn means(scored: &[ViewScore]) -> (Option<Scores>, Option<Scores>) {
    let all: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    let r0: Vec<Scores> = scored.iter().filter_map(|view| view.r0).collect();
    (Scores::mean(&all), Scores::mean(&r0))
}

/// A score as JSON, with that of R_0; the infinite PSNR of equal images is null.
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

/// Clamps to [0, 1] and rounds to multiples of 1/255. A NaN becomes 0.
pub(crate) fn quantized(image: &Image) -> Image {
    let data = image.data.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0).round().max(0.0) / 255.0);
    Image { width: image.width, height: image.height, data: data.collect() }
}
