//! Scores a model on the test views of its dataset: against their reference images, or where there are none against what
//! the model was trained to show of them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use serde_json::{Map, Value, json};

use crate::camera::{Camera, Frame};
use crate::dataset::{Dataset, View};
use crate::exposure::Affine;
use crate::gpu::{Buffer, Gpu};
use crate::image::Image;
use crate::lpips::Lpips;
use crate::metrics::{self, Scores};
use crate::render::{RenderOptions, RenderSettings, Renderer};
use crate::scene::{Feature, Features, Gaussians};
use crate::tone::{ToneCurve, ToneSettings};
use crate::train::{Networks, Rendered, TrainConfig, targets_of_test_views};
use crate::{Error, Result};

/// What test views are scored against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Against {
    /// Normal-light photographs.
    #[default]
    References,
    /// What the run's own curve makes of the test views' photographs.
    PseudoGt,
    /// The test views' photographs: there is no curve, they are the targets.
    Photographs,
}

impl Against {
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
    pub fn name(self) -> &'static str {
        match self {
            Self::References => "reference images",
            Self::PseudoGt => "pseudo-GT",
            Self::Photographs => "photographs",
        }
    }
}

/// What the test views of a dataset are scored against.
#[derive(Clone, Debug, Default)]
pub struct Yardstick {
    /// Which kind that is.
    pub against: Against,
    /// By the view's name, where it is no reference image.
    targets: BTreeMap<String, Image>,
}

impl Yardstick {
    /// The reference images where a test view has one; without any, the targets that `tone` gives the test views in the
    /// scene of the training photographs.
    ///
    /// # Errors
    /// Every photograph is as good as black, one can no longer be read, or the device is out of memory or lost.
    pub fn of(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let against = Self::kind(tone, dataset);
        let targets = match against {
            Against::References => BTreeMap::new(),
            _ => targets_of_test_views(gpu, tone, dataset)?.into_iter().collect(),
        };
        Ok(Self { against, targets })
    }

    /// Which kind it will be.
    pub fn kind(tone: &ToneSettings, dataset: &Dataset) -> Against {
        let has_references = dataset.test_views().any(|view| view.reference.is_some());
        let has_photographs = dataset.test_views().any(View::has_photograph);
        match tone.curve {
            _ if has_references || !has_photographs => Against::References,
            ToneCurve::None => Against::Photographs,
            _ => Against::PseudoGt,
        }
    }

    /// How many of the dataset's test views it has something for.
    pub fn view_count(&self, dataset: &Dataset) -> usize {
        dataset.test_views().filter(|view| self.target(view).is_some()).count()
    }

    fn target<'a>(&'a self, view: &'a View) -> Option<&'a Image> {
        match self.against {
            Against::References => view.reference.as_ref(),
            _ => self.targets.get(&view.name),
        }
    }
}

/// What a test view scores, and the pictures behind it.
#[derive(Clone, Debug)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// The scores of what the model shows: R_K, or R_0 where it has no denoiser.
    pub scores: Scores,
    /// Those of R_0, where the model has a denoiser.
    pub r0: Option<Scores>,
    /// What was scored, in 8 bits as it is saved.
    pub render: Image,
    /// What it was scored against, in 8 bits as it is saved.
    pub reference: Image,
    /// What that is.
    pub against: Against,
}

/// A finished model on the device, ready to be rendered.
#[derive(Debug)]
pub struct Player {
    parameters: Buffer<f32>,
    count: usize,
    sh_degree: u32,
    features: Features,
    renderer: Renderer,
    networks: Option<Networks>,
    /// Where the Gaussians lie.
    frame: Frame,
}

impl Player {
    /// Uploads the `gaussians` of a run of `config`, as its `model.ply` has them but for the colours, which are the model's;
    /// `networks` belong to them. The run's tile is taken where it suits the device.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(
        gpu: &Gpu,
        gaussians: &Gaussians,
        config: &TrainConfig,
        networks: Option<Networks>,
    ) -> Result<Self> {
        let shape = gaussians.shape;
        let RenderSettings { raw_colors, near, tile, .. } = config.render_settings();
        let tile = tile.filter(|&tile| gpu.properties().suits_tile(tile));
        let settings =
            RenderSettings { shape, raw_colors, near, tile, ..RenderSettings::default() };
        let frame = config.frame.unwrap_or_default();
        let gaussians = match frame {
            Frame::WORLD => Cow::Borrowed(gaussians),
            _ => Cow::Owned(gaussians.from_world(&frame, frame.file_origin())),
        };
        Ok(Self {
            frame,
            parameters: gpu.buffer("parameters", &gaussians.parameters)?,
            count: gaussians.count,
            sh_degree: shape.sh_degree,
            features: shape.features,
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
        self.renderer.reserve(self.count, [camera])?;
        let networks = self.networks.as_mut();
        Rendered::new(&mut self.renderer, &self.parameters, camera, &options, networks)
    }

    /// One layer of what a camera sees; a feature of one channel is repeated.
    ///
    /// # Errors
    /// The model has no such layer, or the device is out of memory or lost.
    pub fn layer(&mut self, camera: &Camera, layer: Layer) -> Result<Image> {
        let lacks =
            || Error::Usage(format!("the model has no {}; {}", layer.name(), self.layers()));
        let feature = match layer {
            Layer::Rgb => return Ok(self.render_camera(camera)?.colors),
            Layer::Denoised => {
                let lacks = lacks();
                return self.render_camera(camera)?.denoised.ok_or(lacks);
            }
            Layer::Depth => Feature::Depth,
            Layer::Structure => Feature::Structure,
            Layer::Illumination => Feature::Illumination,
            Layer::Noise => Feature::Noise,
        };
        let planes = self.features.channels_of(feature).ok_or_else(lacks)?;
        let Camera { width, height, .. } = *camera;
        let pixels = width as usize * height as usize;
        let (camera, options) = (&self.frame.camera(camera), self.options());
        self.renderer.reserve(self.count, [camera])?;
        let channels = self.renderer.render_channels(&self.parameters, camera, &options)?;
        let plane = |c: usize| {
            let plane = planes.start + c.min(planes.len() - 1);
            channels[plane * pixels..][..pixels].iter().copied()
        };
        Ok(Image { width, height, data: (0..3).flat_map(plane).collect() })
    }

    /// What the model does have, for a message.
    fn layers(&self) -> String {
        let denoised = self.networks.as_ref().is_some_and(Networks::has_denoiser);
        let features = self.features.specs().map(|spec| spec.name);
        let names: Vec<&str> =
            ["rgb"].into_iter().chain(denoised.then_some("denoised")).chain(features).collect();
        format!("it has {}", names.join(", "))
    }

    fn options(&self) -> RenderOptions {
        RenderOptions { sh_degree: self.sh_degree, background: [0.0; 3] }
    }
}

/// What can be seen of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
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

impl Layer {
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
    pub fn is_color(self) -> bool {
        matches!(self, Self::Rgb | Self::Denoised)
    }
}

impl FromStr for Layer {
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
/// Those of `render`.
pub fn score(
    dataset: &Dataset,
    render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Vec<ViewScore>> {
    score_by(&Yardstick::default(), dataset, render)
}

/// As [`score`], by any yardstick.
///
/// # Errors
/// As there.
pub fn score_by(
    yardstick: &Yardstick,
    dataset: &Dataset,
    mut render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Vec<ViewScore>> {
    let (mut scored, against) = (vec![], yardstick.against);
    for view in dataset.test_views() {
        let Some(reference) = yardstick.target(view) else { continue };
        let (rendered, reference) = (render(view)?, quantized(reference));
        let render = quantized(rendered.output());
        let mask = view.mask.as_ref();
        let scores = Scores::of_counted(&render, &reference, mask)?;
        let r0 = rendered.denoised.is_some();
        let of_r0 = || Scores::of_counted(&quantized(&rendered.colors), &reference, mask);
        let r0 = r0.then(of_r0).transpose()?;
        let name = view.name.clone();
        scored.push(ViewScore { name, scores, r0, render, reference, against });
    }
    Ok(scored)
}

/// Adds LPIPS to the scores of what was shown, over the pixels that count.
///
/// # Errors
/// A view is too small for it, or the device is out of memory or lost.
pub fn add_lpips(
    scored: &mut [ViewScore],
    dataset: &Dataset,
    gpu: &Gpu,
    lpips: &Lpips,
) -> Result<()> {
    for ViewScore { name, scores, render, reference, .. } in scored {
        let view = dataset.views.iter().find(|view| view.name == *name);
        let mask = view.and_then(|view| view.mask.as_ref());
        let mask = mask.map(|mask| mask.resized(render.width, render.height).into_owned());
        let shown = metrics::counted(render, reference, mask.as_ref());
        scores.lpips = Some(lpips.distance(gpu, &shown, reference)?);
    }
    Ok(())
}

/// `metrics.json`: means and views, and what the run took; null where that, or a mean, is not known.
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

/// Says in `metrics.json` of a model with learned exposures at which one the test views were scored, as no photograph of
/// theirs was trained on: at the neutral one, the mean of the training views. Beside it stand the scores behind the affine
/// of each channel that brings each render nearest to its reference image, which is what others report; they know the
/// reference and compare with nothing else here.
///
/// # Errors
/// None for what [`score`] gives.
pub fn add_exposure(metrics: &mut Value, scored: &[ViewScore]) -> Result<()> {
    let aligned = |view: &ViewScore| -> Result<(String, Scores)> {
        let affine = Affine::least_squares(&view.render, &view.reference)?;
        let render = quantized(&affine.applied(&view.render));
        Ok((view.name.clone(), Scores::of(&render, &view.reference)?))
    };
    let aligned = scored.iter().map(aligned).collect::<Result<Vec<_>>>()?;
    let scores: Vec<Scores> = aligned.iter().map(|(_, scores)| *scores).collect();
    let views: Map<String, Value> =
        aligned.into_iter().map(|(name, scores)| (name, entry(&scores, None))).collect();
    metrics["exposure"] = json!("neutral: the mean of the training views'");
    metrics["aligned_with_reference"] = json!({
        "what": "behind the least-squares gain and bias of each channel of each test view against its reference image",
        "mean": Scores::mean(&scores).map(|mean| entry(&mean, None)),
        "views": views,
    });
    Ok(())
}

/// The mean scores, and those of R_0 where the model has a denoiser.
pub fn means(scored: &[ViewScore]) -> (Option<Scores>, Option<Scores>) {
    let all: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    let r0: Vec<Scores> = scored.iter().filter_map(|view| view.r0).collect();
    (Scores::mean(&all), Scores::mean(&r0))
}

/// Writes `renders/NAME.png` and `references/NAME.png` below `folder`; what is no reference image, to `targets`.
///
/// # Errors
/// The folder cannot be written.
pub fn save_images(folder: &Path, scored: &[ViewScore]) -> Result<()> {
    let against = match scored.first().map(|view| view.against) {
        None | Some(Against::References) => "references",
        Some(_) => "targets",
    };
    for (name, image) in [
        ("renders", (|view| &view.render) as fn(&ViewScore) -> &Image),
        (against, |view| &view.reference),
    ] {
        let folder = folder.join(name);
        std::fs::create_dir_all(&folder)
            .map_err(|error| Error::output(&folder, format!("cannot be made ({error})")))?;
        for view in scored {
            image(view).save_png8(folder.join(format!("{}.png", view.name)))?;
        }
    }
    Ok(())
}

/// A score as JSON, that of R_0 in it; infinite PSNR, of equal images, has no JSON number and is null.
fn entry(scores: &Scores, r0: Option<&Scores>) -> Value {
    let mut entry = json!({
        "psnr": scores.psnr,
        "psnr_channel_mean": scores.psnr_channel_mean,
        "ssim": scores.ssim,
    });
    if let Some(lpips) = scores.lpips {
        entry["lpips"] = json!(lpips);
    }
    if let Some(r0) = r0 {
        entry["r0"] = self::entry(r0, None);
    }
    entry
}

/// Clamped to [0, 1] and rounded to multiples of 1/255. A NaN becomes 0.
fn quantized(image: &Image) -> Image {
    let data = image.data.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0).round().max(0.0) / 255.0);
    Image { width: image.width, height: image.height, data: data.collect() }
}
