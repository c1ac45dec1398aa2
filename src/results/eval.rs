//! Scores a model on the test views of its dataset: against their reference images or, without any, against their
//! targets.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use nightsplat_core::camera::{Camera, TrainingFrame};
use nightsplat_core::output::{create_folder, own_file};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::{Image, ImageFile, linear_from_srgb, srgb_from_linear};
use nightsplat_photographs::metrics::{self, Scores, psnr_of_counted};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{Statistics, ToneCurve, ToneSettings};

use crate::gpu::Gpu;
use crate::networks::lpips::Lpips;
use crate::splats::device::{DeviceGaussians, Upload};
use crate::splats::lamp::Lamp;
use crate::splats::model::Model;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
use crate::targets::Targets;
use crate::train::{Networks, Rendered, TrainConfig};
use crate::{Error, Result};
use nightsplat_photographs::exposures::Affine;

mod layers;
mod lit;
mod scores;
mod transmittance;

use layers::Normals;
pub use layers::RenderLayer;
use lit::lit_folder;
use nightsplat_models::gaussians::Shape;
use nightsplat_models::linear_light::{photograph_of, slope_at, stops_between};
pub(crate) use scores::{AGAINST, WITH_REFERENCE, add_reference, with_reference};
pub use scores::{After, Evaluation, Metric, Score};
pub(crate) use transmittance::warn_of_holes;
pub use transmittance::{
    MAX_RESIDUAL_TRANSMITTANCE, ResidualTransmittance, hole_warning, photographs_show_sky,
    shows_sky,
};

/// The images that test views are scored against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReferenceKind {
    /// Normal-light photographs.
    #[default]
    References,
    /// The photographs of the test views, tone-mapped with the run's curve.
    PseudoGt,
    /// Targets of the test views that another program made.
    ExternalTargets,
    /// The photographs of the test views: without a curve, they are the targets.
    Photographs,
    /// The views in the light of the lamp at the camera, of a dataset that has them.
    LitByLamp,
}

impl ReferenceKind {
    /// Note for readers of a score; `None` for references, the usual meaning of a score.
    pub fn label(self) -> Option<&'static str> {
        match self {
            Self::References => None,
            Self::PseudoGt => Some(
                "against their own pseudo-GT: how well the model fits its targets, not how right these are",
            ),
            Self::ExternalTargets => Some(
                "against the targets of another program: how well the model fits them, not how right these are",
            ),
            Self::Photographs => Some(
                "against the photographs themselves, as there are no reference images and no curve",
            ),
            Self::LitByLamp => Some("against the dataset's images in the light of the lamp"),
        }
    }

    /// Short name, for use within a line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::References => "reference images",
            Self::PseudoGt => "pseudo-GT",
            Self::ExternalTargets => "targets of another program",
            Self::Photographs => "photographs",
            Self::LitByLamp => "images in the light of the lamp",
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
    pub fn new(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        Self::made_by(tone, dataset, || Targets::new(gpu, tone, dataset))
    }

    /// [`ScoreReference::new`] with given statistics of the training photographs.
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

    /// The kind that [`ScoreReference::new`] chooses.
    pub fn kind(tone: &ToneSettings, dataset: &Dataset) -> ReferenceKind {
        let has_references = dataset.test_views().any(View::has_reference);
        let has_photographs = dataset.test_views().any(View::has_photograph);
        if has_references || !has_photographs {
            ReferenceKind::References
        } else if tone.targets().is_some() {
            ReferenceKind::ExternalTargets
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

    /// Refuses to score a bright model against dark photographs for want of anything else.
    ///
    /// # Errors
    /// [`Error::Input`] naming `path` if the photographs are what it is scored against, and its render of the first is
    /// much brighter.
    pub(crate) fn check_brightness(
        &self,
        path: &Path,
        dataset: &Dataset,
        mut render: impl FnMut(&View) -> Result<Rendered>,
    ) -> Result<()> {
        /// Of the render relative to the photograph.
        const BRIGHT: f64 = 1.5;
        let first = dataset.test_views().find(|view| view.has_photograph());
        let Some(view) = first.filter(|_| self.against == ReferenceKind::Photographs) else {
            return Ok(());
        };
        let Some(photograph) = view.loaded()? else { return Ok(()) };
        let mean = |image: &Image| f64::from(Statistics::new(&image.data).mean_luminance);
        let times = mean(render(view)?.output()) / mean(&photograph).max(f64::MIN_POSITIVE);
        if times < BRIGHT {
            return Ok(());
        }
        let problem = format!(
            "is {times:.1} times as bright as the photographs and does not state their tone curve: a score against \
             them favours dark corners; pass its run, or --photographs to score it against them all the same"
        );
        Err(Error::input(path, problem))
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

/// The two images that a view's scores compare, in 8 bits as they are saved.
#[derive(Debug)]
pub struct ScoredImages<'a> {
    /// The view.
    pub view: &'a View,
    /// The model's image of it.
    pub render: Image,
    /// The image that it is compared with.
    pub target: Image,
    /// The kind of that image.
    pub against: ReferenceKind,
    /// The scores of the render.
    pub scores: Scores,
}

impl ScoredImages<'_> {
    /// LPIPS of the unmasked pixels.
    pub fn lpips(&self, gpu: &Gpu, lpips: &Lpips) -> Result<f64> {
        lpips.distance(gpu, &self.counted(), &self.target)
    }

    /// SSIM of the unmasked pixels, with a uniform window.
    fn ssim_uniform(&self) -> Result<f64> {
        metrics::ssim_uniform(&self.counted(), &self.target)
    }

    /// The render with the target at masked pixels.
    fn counted(&self) -> Cow<'_, Image> {
        let Self { view, render, target, .. } = self;
        let mask = view.mask.as_ref().map(|mask| mask.resized(render.width, render.height));
        metrics::counted(render, target, mask.as_deref())
    }

    /// The scores of the render by some stops of linear light brighter.
    pub(crate) fn exposed(&self, stops: f64) -> Result<Scores> {
        let light = stops.exp2() as f32;
        let brighter = |&x: &f32| srgb_from_linear(light * linear_from_srgb(x));
        let data = self.render.data.iter().map(brighter).collect();
        let brighter = quantized(&Image { data, ..self.render });
        Scores::of_counted(&brighter, &self.target, self.view.mask.as_ref())
    }

    /// The scores of the render as a photograph, against the photograph of the view; none if it has no photograph.
    fn as_photograph(&self, scene: &SceneTone) -> Result<Vec<(Metric, f64)>> {
        let Self { view, render, .. } = self;
        let Some(photograph) = view.loaded()? else { return Ok(vec![]) };
        let inverse = scene.inverse(view)?;
        let (dark, _) = photograph_of(render, &inverse);
        Ok(vec![
            (Metric::Psnr, psnr_of_counted(&dark, &photograph, view.mask.as_ref())?),
            (Metric::Stops, stops_between(&dark, &photograph)),
            (Metric::Slope, slope_at(render, &inverse)),
        ])
    }

    /// Writes `renders/NAME.png` and `references/NAME.png` in `folder`; `targets/NAME.png` if there are no reference
    /// images.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let targets = match self.against {
            ReferenceKind::References => "references",
            _ => "targets",
        };
        for (name, image) in [("renders", &self.render), (targets, &self.target)] {
            let folder = own_file(own_file(folder.to_owned())?.join(name))?;
            create_folder(&folder)?;
            let path = own_file(folder.join(format!("{}.png", self.view.name)))?;
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

/// What is scored in addition to the renders.
#[derive(Debug, Default)]
pub(crate) struct Extras<'a> {
    /// LPIPS of the renders, and the device of its network.
    pub(crate) lpips: Option<(&'a Lpips, &'a Gpu)>,
    /// SSIM with a uniform window.
    pub(crate) uniform_ssim: bool,
    /// The renders after the least-squares gain and bias of each channel.
    pub(crate) with_gain_and_bias: bool,
    /// The exposures of views by name: stops relative to the mean of the training views.
    pub(crate) stops: BTreeMap<String, f64>,
    /// The curves whose inverses make photographs of renders, to score against the photographs.
    pub(crate) scene: Option<SceneTone>,
}

impl Evaluation {
    /// Scores every test view that has a target; `render` renders a view. Both images are clamped and rounded to 8 bits
    /// first, as they are saved. `look` is called with the images of each view.
    pub(crate) fn new(
        score_reference: &mut ScoreReference,
        dataset: &Dataset,
        extras: &Extras<'_>,
        mut render: impl FnMut(&View) -> Result<Rendered>,
        mut look: impl FnMut(&ScoredImages<'_>) -> Result<()>,
    ) -> Result<Self> {
        let requested = [
            extras.with_gain_and_bias.then_some(After::GainAndBias),
            extras.scene.as_ref().map(|_| After::InverseCurve),
        ];
        let mut evaluation = Self {
            scores: vec![],
            shows_sky: false,
            lpips: extras.lpips.map(|(lpips, _)| lpips.measure()),
            requested: requested.into_iter().flatten().collect(),
        };
        for view in dataset.test_views() {
            let Some(target) = score_reference.target(view)? else { continue };
            let rendered = render(view)?;
            let render = quantized(rendered.output());
            let scores = Scores::of_counted(&render, &target, view.mask.as_ref())?;
            let against = score_reference.against;
            let images = ScoredImages { view, render, target, against, scores };
            evaluation.add_view(&rendered, &images, extras)?;
            look(&images)?;
        }
        Ok(evaluation)
    }

    /// Adds the rows of a view.
    fn add_view(
        &mut self,
        rendered: &Rendered,
        images: &ScoredImages<'_>,
        extras: &Extras<'_>,
    ) -> Result<()> {
        let ScoredImages { view, target, against, scores, .. } = images;
        let (name, against) = (view.name.as_str(), *against);
        self.add(name, scores, against, After::Model);
        if rendered.denoised.is_some() {
            let image = quantized(&rendered.colors);
            let scores = Scores::of_counted(&image, target, view.mask.as_ref())?;
            self.add(name, &scores, against, After::Gaussians);
        }
        if extras.with_gain_and_bias {
            self.add(name, &aligned(&images.render, target)?, against, After::GainAndBias);
        }
        if let Some(stops) = extras.stops.get(name) {
            self.add(name, &images.exposed(*stops)?, against, After::OwnExposure);
        }
        let mut values = vec![];
        if extras.uniform_ssim {
            values.push((Metric::SsimUniform, images.ssim_uniform()?));
        }
        if let Some((lpips, gpu)) = extras.lpips {
            values.push((Metric::Lpips, images.lpips(gpu, lpips)?));
        }
        if let Some(ResidualTransmittance { mean, q99 }) =
            ResidualTransmittance::measure(rendered, view)
        {
            values.push((Metric::ResidualTransmittance, mean));
            values.push((Metric::ResidualTransmittanceQ99, q99));
        }
        let row = |against, after, (metric, value)| Score {
            view: name.to_owned(),
            metric,
            against,
            after,
            value,
        };
        self.scores.extend(values.into_iter().map(|value| row(against, After::Model, value)));
        if let Some(scene) = &extras.scene {
            let values = images.as_photograph(scene)?;
            let row = |value| row(ReferenceKind::Photographs, After::InverseCurve, value);
            self.scores.extend(values.into_iter().map(row));
        }
        Ok(())
    }
}

/// Scores every test view that has a reference image; `render` renders a view.
pub fn score(
    dataset: &Dataset,
    render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Evaluation> {
    let reference = &mut ScoreReference::default();
    Evaluation::new(reference, dataset, &Extras::default(), render, |_| Ok(()))
}

/// The scores after the gain and bias of each channel that minimise the squared error to the target.
fn aligned(render: &Image, target: &Image) -> Result<Scores> {
    let affine = Affine::least_squares(render, target)?;
    Scores::measure(&quantized(&affine.applied(render)), target)
}

/// Clamps to [0, 1] and rounds to multiples of 1/255. A NaN becomes 0.
pub(crate) fn quantized(image: &Image) -> Image {
    let data = image.data.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0).round().max(0.0) / 255.0);
    Image { width: image.width, height: image.height, data: data.collect() }
}
