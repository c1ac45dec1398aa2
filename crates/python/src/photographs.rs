//! Photographs: files, tone curves, diagnosis, and a synthetic dataset.

use std::path::PathBuf;

use nightsplat::synthetic::{self, SyntheticOptions};
use nightsplat::targets::pseudo_gt::PseudoGt;
use nightsplat::train::diagnosed;
use nightsplat::train::plan::Plan;
use nightsplat::{Error, Image, ImageFile, Tone, TrainConfig};
use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::MeasuredPhotograph;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Serialize;

use crate::arrays::{Floats, PyImage, of_image};
use crate::device::{PyDevice, opened};
use crate::error::{exception, usage};
use crate::{assignments, call, objects};

/// Decodes a photograph, PNG, JPEG, WebP, TIFF or EXR, to (H, W, 3), float32, sRGB-encoded, as stored.
#[pyfunction]
pub(crate) fn load_image(py: Python<'_>, path: PathBuf) -> PyResult<Floats<'_>> {
    of_image(py, &call(py, || Image::load(path))?)
}

/// Writes an image, (H, W, 3), sRGB-encoded: .exr as floats of linear light, else a PNG of 8 bits.
#[pyfunction]
pub(crate) fn save_image(py: Python<'_>, path: PathBuf, array: PyImage) -> PyResult<()> {
    call(py, || match path.extension() {
        Some(extension) if extension == "exr" => array.0.save_exr(path),
        _ => array.0.save_png8(path),
    })
}

/// Writes a small dataset: dark photographs of a synthetic room, their cameras, and references in normal light. `size`
/// in pixels; every eighth view is a test view.
#[pyfunction]
#[pyo3(signature = (folder, *, size = [160, 120], views = 24, seed = 0))]
pub(crate) fn synthetic_dataset(
    py: Python<'_>,
    folder: PathBuf,
    size: [u32; 2],
    views: usize,
    seed: u64,
) -> PyResult<()> {
    let [width, height] = size;
    let options = SyntheticOptions { width, height, views, seed, ..SyntheticOptions::default() };
    call(py, || synthetic::write(folder, &options))
}

/// Applies a tone curve to a photograph, (H, W, 3), sRGB-encoded, as `nightsplat tone apply` to a single one.
/// `nightsplat tone list` has the curves; "auto" measures the photograph. Settings are those of the section tone:
/// brightness, theta, gain_c, ...
/// Returns (H, W, 3), float32, sRGB-encoded, 0 to 1.
#[pyfunction]
#[pyo3(signature = (array, *, curve = "auto", device = None, **settings))]
pub(crate) fn tone_map<'py>(
    py: Python<'py>,
    array: PyImage,
    curve: &str,
    device: Option<&Bound<'py, PyDevice>>,
    settings: Option<&Bound<'py, PyDict>>,
) -> PyResult<Floats<'py>> {
    let settings = assignments(py, settings)?.into_iter().chain([format!("curve={curve:?}")]);
    let settings: Vec<String> = settings.map(|setting| format!("tone.{setting}")).collect();
    let photograph = array.0;
    if !photograph.data.iter().all(|value| value.is_finite()) {
        return Err(usage("the photograph holds NaN or infinity; replace them"));
    }
    let gpu = opened(py, device)?;
    let mapped = call(py, || {
        let mut tone = TrainConfig::default().with(&settings)?.tone;
        let has_colour = settings.iter().any(|setting| setting.starts_with("tone.colour="));
        if tone.curve == Tone::Auto && !has_colour {
            // As the command: references of single photographs are less saturated than those of scenes.
            tone.colour = 0.0;
        }
        let measured = MeasuredPhotograph::measure(&photograph.data);
        let scene = SceneTone::from_photographs(&tone, std::slice::from_ref(&measured));
        let black = || Error::Usage("the photograph is almost black; expose longer".to_owned());
        let curve = scene.ok_or_else(black)?.curve_of(&measured);
        PseudoGt::new(&gpu, &tone)?.tone_mapped(&photograph, &curve)
    })?;
    of_image(py, &mapped)
}

#[derive(Serialize)]
struct Diagnosed<'a> {
    device: &'a str,
    #[serde(flatten)]
    diagnosis: &'a Diagnosis,
    plan: &'a Plan,
}

/// Measures the training photographs of a dataset, and chooses a model for them: what `nightsplat diagnose --json`
/// prints. Settings are keys of config.toml, such as `downscale=2`.
#[pyfunction]
#[pyo3(signature = (dataset, *, preset = None, device = None, **settings))]
pub(crate) fn diagnose<'py>(
    py: Python<'py>,
    dataset: PathBuf,
    preset: Option<&str>,
    device: Option<&Bound<'py, PyDevice>>,
    settings: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let config = config(dataset, preset, &assignments(py, settings)?)?;
    let gpu = opened(py, device)?;
    let (diagnosis, plan) = call(py, || {
        let (_, diagnosis) = Diagnosis::load(&config.dataset, &diagnosed(&config))?;
        let plan = Plan::new(&diagnosis, &config, gpu.properties().memory);
        Ok((diagnosis, plan))
    })?;
    let device = &gpu.properties().name;
    objects(py, &Diagnosed { device, diagnosis: &diagnosis, plan: &plan })
}

/// The configuration of a dataset, without a plan.
pub(crate) fn config(
    dataset: PathBuf,
    preset: Option<&str>,
    settings: &[String],
) -> PyResult<TrainConfig> {
    let mut config = TrainConfig { dataset, ..TrainConfig::default() };
    if let Some(preset) = preset {
        preset
            .parse()
            .and_then(|preset: nightsplat::Preset| preset.apply(&mut config))
            .map_err(exception)?;
    }
    config.with(settings).map_err(exception)
}
