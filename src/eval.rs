//! Scores a model on the test views of its dataset.

use std::path::Path;
use std::str::FromStr;

use serde_json::{Map, Value, json};

use crate::dataset::{Dataset, View};
use crate::exposure::Affine;
use crate::gpu::{Buffer, Gpu};
use crate::image::Image;
use crate::metrics::Scores;
use crate::render::{RenderOptions, RenderSettings, Renderer};
use crate::scene::{Feature, Features, Gaussians};
use crate::tone::ToneSettings;
use crate::train::{Networks, Rendered};
use crate::{Error, Result};

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
}

impl Player {
    /// Uploads `gaussians`, whose colours are `raw_colors` or as viewers show them; `networks` belong to them. Their run's
    /// `tile` is taken where it suits the device.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(
        gpu: &Gpu,
        gaussians: &Gaussians,
        raw_colors: bool,
        tile: Option<[u32; 2]>,
        networks: Option<Networks>,
    ) -> Result<Self> {
        let shape = gaussians.shape;
        let tile = tile.filter(|&tile| gpu.properties().suits_tile(tile));
        let settings = RenderSettings { shape, raw_colors, tile, ..RenderSettings::default() };
        Ok(Self {
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
        let (camera, options) = (&view.camera, self.options());
        self.renderer.reserve(self.count, [camera])?;
        let networks = self.networks.as_mut();
        Rendered::new(&mut self.renderer, &self.parameters, camera, &options, networks)
    }

    /// One layer of what the view's camera sees; a feature of one channel is repeated.
    ///
    /// # Errors
    /// The model has no such layer, or the device is out of memory or lost.
    pub fn layer(&mut self, view: &View, layer: Layer) -> Result<Image> {
        let lacks =
            || Error::Usage(format!("the model has no {}; {}", layer.name(), self.layers()));
        let feature = match layer {
            Layer::Rgb => return Ok(self.render(view)?.colors),
            Layer::Denoised => {
                let lacks = lacks();
                return self.render(view)?.denoised.ok_or(lacks);
            }
            Layer::Depth => Feature::Depth,
            Layer::Structure => Feature::Structure,
            Layer::Illumination => Feature::Illumination,
            Layer::Noise => Feature::Noise,
        };
        let planes = self.features.channels_of(feature).ok_or_else(lacks)?;
        let (width, height) = (view.camera.width, view.camera.height);
        let pixels = width as usize * height as usize;
        self.renderer.reserve(self.count, [&view.camera])?;
        let options = self.options();
        let channels = self.renderer.render_channels(&self.parameters, &view.camera, &options)?;
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
    mut render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<Vec<ViewScore>> {
    let mut scored = vec![];
    for view in dataset.test_views() {
        let Some(reference) = &view.reference else { continue };
        let (rendered, reference) = (render(view)?, quantized(reference));
        let render = quantized(rendered.output());
        let mask = view.mask.as_ref();
        let scores = Scores::of_counted(&render, &reference, mask)?;
        let r0 = rendered.denoised.is_some();
        let of_r0 = || Scores::of_counted(&quantized(&rendered.colors), &reference, mask);
        let r0 = r0.then(of_r0).transpose()?;
        scored.push(ViewScore { name: view.name.clone(), scores, r0, render, reference });
    }
    Ok(scored)
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
    json!({
        "mean": mean,
        "views": views,
        "seconds": seconds.into(),
        "gaussians": gaussians,
        "steps": steps,
    })
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

/// Writes `renders/NAME.png` and `references/NAME.png` below `folder`.
///
/// # Errors
/// The folder cannot be written.
pub fn save_images(folder: &Path, scored: &[ViewScore]) -> Result<()> {
    for (name, image) in [
        ("renders", (|view| &view.render) as fn(&ViewScore) -> &Image),
        ("references", |view| &view.reference),
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
