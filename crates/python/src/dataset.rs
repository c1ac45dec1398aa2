//! Datasets and their views.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;

use nightsplat::{Image, Split};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{Floats, of_image};
use crate::camera;
use crate::photographs::config;
use crate::{assignments, call};

/// Photographs with their cameras.
#[pyclass(frozen, name = "Dataset", module = "nightsplat")]
pub(crate) struct PyDataset(Arc<nightsplat::Dataset>);

#[pymethods]
impl PyDataset {
    /// Loads a folder with transforms*.json or a COLMAP model. Settings are keys of config.toml, such as `downscale=2`.
    #[staticmethod]
    #[pyo3(signature = (folder, **settings))]
    fn load(
        py: Python<'_>,
        folder: PathBuf,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let config = config(folder, None, &assignments(py, settings)?)?;
        let load = || nightsplat::Dataset::load(&config.dataset, &config.load_options());
        Ok(Self(Arc::new(call(py, load)?)))
    }

    /// The views, sorted by name.
    #[getter]
    fn views(&self) -> Vec<PyView> {
        let view = |index| PyView { dataset: self.0.clone(), index };
        (0..self.0.views.len()).map(view).collect()
    }
}

/// A photograph's place in a dataset.
#[pyclass(frozen, name = "View", module = "nightsplat")]
pub(crate) struct PyView {
    dataset: Arc<nightsplat::Dataset>,
    index: usize,
}

#[pymethods]
impl PyView {
    /// The photograph's file name without extension.
    #[getter]
    fn name(&self) -> &str {
        &self.view().name
    }

    /// Whether the view is trained on; else it is only scored.
    #[getter]
    fn is_train(&self) -> bool {
        self.view().split != Split::Test
    }

    /// Its camera, undistorted, of the pixels as stored.
    #[getter]
    fn camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        camera::of_python(py, &self.view().camera)
    }

    /// The photograph, (H, W, 3), float32, sRGB-encoded, of the camera's size; None if the view has none.
    fn photograph<'py>(&self, py: Python<'py>) -> PyResult<Option<Floats<'py>>> {
        self.decoded(py, nightsplat::View::loaded)
    }

    /// The reference in normal light of a test view, as its photograph; None if it has none.
    fn reference<'py>(&self, py: Python<'py>) -> PyResult<Option<Floats<'py>>> {
        self.decoded(py, nightsplat::View::loaded_reference)
    }
}

impl PyView {
    fn view(&self) -> &nightsplat::View {
        &self.dataset.views[self.index]
    }

    fn decoded<'py>(
        &self,
        py: Python<'py>,
        decode: fn(&nightsplat::View) -> nightsplat::Result<Option<Cow<'_, Image>>>,
    ) -> PyResult<Option<Floats<'py>>> {
        let image = call(py, || Ok(decode(self.view())?.map(Cow::into_owned)))?;
        image.map(|image| of_image(py, &image)).transpose()
    }
}
