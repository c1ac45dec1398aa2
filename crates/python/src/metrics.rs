//! Scores of images.

use std::path::PathBuf;

use nightsplat::Gpu;
use nightsplat::networks::lpips::{self, Range};
use nightsplat_photographs::metrics;
use pyo3::prelude::*;

use crate::arrays::PyImage;
use crate::call;
use crate::device::{PyDevice, opened};
use crate::error::usage;

/// Peak signal-to-noise ratio of two images of one size, (H, W, 3), over all values, dB; infinite for equal ones.
#[pyfunction]
pub(crate) fn psnr(py: Python<'_>, render: PyImage, reference: PyImage) -> PyResult<f64> {
    call(py, || metrics::psnr(&render.0, &reference.0))
}

/// Mean structural similarity of two images of one size, (H, W, 3), at most 1: an 11x11 Gaussian window with sigma 1.5
/// and zero padding, as in 3DGS.
#[pyfunction]
pub(crate) fn ssim(py: Python<'_>, render: PyImage, reference: PyImage) -> PyResult<f64> {
    call(py, || metrics::ssim(&render.0, &reference.0))
}

/// LPIPS 0.1, a perceptual distance of two images of one size, (H, W, 3): 0 for equal ones, lower is more similar.
///
/// `weights` is a safetensors file with AlexNet's or VGG-16's, as scripts/lpips-weights.py writes it; `range` the
/// network's input: "signed", [-1, 1], or "unit", [0, 1]. Distances of different ranges or networks do not compare.
#[pyclass(frozen, name = "Lpips", module = "nightsplat")]
pub(crate) struct PyLpips {
    network: lpips::Lpips,
    device: Gpu,
}

#[pymethods]
impl PyLpips {
    #[new]
    #[pyo3(signature = (weights, *, range = "signed", device = None))]
    fn new(
        py: Python<'_>,
        weights: PathBuf,
        range: &str,
        device: Option<&Bound<'_, PyDevice>>,
    ) -> PyResult<Self> {
        let Some(range) = Range::ALL.into_iter().find(|known| known.name() == range) else {
            return Err(usage(format!("the range is {range:?}; it must be signed or unit")));
        };
        let device = opened(py, device)?;
        let network = call(py, || lpips::Lpips::load(&device, weights, range))?;
        Ok(Self { network, device })
    }

    /// The distance between two images.
    fn __call__(&self, py: Python<'_>, render: PyImage, reference: PyImage) -> PyResult<f64> {
        call(py, || self.network.distance(&self.device, &render.0, &reference.0))
    }
}
