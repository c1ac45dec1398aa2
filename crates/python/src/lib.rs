//! The native module of the Python package: models, renders, training and scores as objects and arrays of numpy.
//!
//! A thin layer: every function converts its arguments, releases the interpreter, calls the library and converts the
//! result. Arrays are copied. What is public, with its types, is `python/nightsplat`.

mod arrays;
mod camera;
mod dataset;
mod device;
mod error;
mod metrics;
mod model;
mod photographs;
mod renderer;
mod training;

use pyo3::prelude::*;
use pyo3::types::PyDict;

/// The classes and functions of `nightsplat`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::{
        camera::check_camera,
        dataset::{PyDataset, PyView},
        device::PyDevice,
        metrics::{PyLpips, psnr, ssim},
        model::PyModel,
        photographs::{diagnose, load_image, save_image, synthetic_dataset, tone_map},
        renderer::{PyRender, PyRenderer},
        training::{PyStep, PyTraining, train},
    };
    use pyo3::prelude::*;

    #[pymodule_init]
    fn begin(module: &Bound<'_, PyModule>) -> PyResult<()> {
        pyo3_log::init();
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        crate::error::add(module)
    }
}

/// Calls the library without holding the interpreter; other threads of Python run meanwhile. An error becomes an
/// exception.
fn call<T: Send>(
    py: Python<'_>,
    work: impl FnOnce() -> nightsplat::Result<T> + Send,
) -> PyResult<T> {
    py.detach(work).map_err(error::exception)
}

/// Keyword arguments as assignments, such as `tone.curve="ap3"`.
fn assignments(py: Python<'_>, settings: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<String>> {
    py.import("nightsplat._convert")?.call_method1("assignments", (settings,))?.extract()
}

/// What a value is in JSON, as objects of Python.
fn objects<'py>(py: Python<'py>, value: &impl serde::Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(|error| error::usage(error.to_string()))?;
    py.import("json")?.call_method1("loads", (text,))
}
