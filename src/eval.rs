//! Scores a model on the test views of its dataset.

use std::path::Path;

use serde_json::{Map, Value, json};

use crate::dataset::{Dataset, View};
use crate::gpu::{Buffer, Gpu};
use crate::image::Image;
use crate::metrics::Scores;
use crate::render::{RenderOptions, RenderSettings, Renderer};
use crate::scene::Gaussians;
use crate::{Error, Result};

/// What a test view scores, and the pictures behind it.
#[derive(Clone, Debug)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// The scores.
    pub scores: Scores,
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
    renderer: Renderer,
}

impl Player {
    /// Uploads `gaussians`.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self> {
        let shape = gaussians.shape;
        let settings = RenderSettings { shape, ..RenderSettings::default() };
        Ok(Self {
            parameters: gpu.buffer("parameters", &gaussians.parameters)?,
            count: gaussians.count,
            sh_degree: shape.sh_degree,
            renderer: Renderer::new(gpu, settings)?,
        })
    }

    /// What the view's camera sees, before a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, view: &View) -> Result<Image> {
        let options = RenderOptions { sh_degree: self.sh_degree, background: [0.0; 3] };
        self.renderer.reserve(self.count, [&view.camera])?;
        self.renderer.render_image(&self.parameters, &view.camera, &options)
    }
}

/// Scores every test view that has a reference image; `render` draws a view. Both images are clamped and rounded to 8
/// bits first, so that what is scored is what is saved.
///
/// # Errors
/// Those of `render`.
pub fn score(
    dataset: &Dataset,
    mut render: impl FnMut(&View) -> Result<Image>,
) -> Result<Vec<ViewScore>> {
    let mut scored = vec![];
    for view in dataset.test_views() {
        let Some(reference) = &view.reference else { continue };
        let (render, reference) = (quantized(&render(view)?), quantized(reference));
        let scores = Scores::of(&render, &reference)?;
        scored.push(ViewScore { name: view.name.clone(), scores, render, reference });
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
    let all: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    let mean = Scores::mean(&all).map_or(Value::Null, |mean| entry(&mean));
    let views: Map<String, Value> =
        scored.iter().map(|view| (view.name.clone(), entry(&view.scores))).collect();
    json!({
        "mean": mean,
        "views": views,
        "seconds": seconds.into(),
        "gaussians": gaussians,
        "steps": steps,
    })
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

/// A score as JSON; infinite PSNR, of equal images, has no JSON number and is null.
fn entry(scores: &Scores) -> Value {
    json!({
        "psnr": scores.psnr,
        "psnr_channel_mean": scores.psnr_channel_mean,
        "ssim": scores.ssim,
    })
}

/// Clamped to [0, 1] and rounded to multiples of 1/255. A NaN becomes 0.
fn quantized(image: &Image) -> Image {
    let data = image.data.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0).round().max(0.0) / 255.0);
    Image { width: image.width, height: image.height, data: data.collect() }
}
