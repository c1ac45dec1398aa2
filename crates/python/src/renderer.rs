//! Renders of a model.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use nightsplat::TrainConfig;
use nightsplat::config::TrainingFrame;
use nightsplat::run::{ModelRenderer, RenderLayer, load_config, load_networks};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::arrays::{Floats, array, interleaved, of_image};
use crate::call;
use crate::camera::PyCamera;
use crate::device::{PyDevice, opened};
use crate::error::usage;
use crate::model::PyModel;

/// The images of a camera, or of each camera of a batch of N: then every shape begins with N.
#[pyclass(frozen, get_all, name = "Render", module = "nightsplat")]
pub(crate) struct PyRender {
    /// (H, W, 3), float32: sRGB-encoded colours over black; white is 1, and values may exceed it.
    color: Py<PyArrayDyn<f32>>,
    /// (H, W), float32: the median depth in the view, world units; infinite where under half of the light is stopped.
    depth: Py<PyArrayDyn<f32>>,
    /// (H, W), float32: one minus the transmittance, 0 to 1.
    alpha: Py<PyArrayDyn<f32>>,
}

/// A model on a device, ready to render.
#[pyclass(frozen, name = "Renderer", module = "nightsplat")]
pub(crate) struct PyRenderer {
    renderer: Mutex<ModelRenderer>,
}

#[pymethods]
impl PyRenderer {
    #[new]
    #[pyo3(signature = (model, device = None))]
    fn new(
        py: Python<'_>,
        model: &Bound<'_, PyModel>,
        device: Option<&Bound<'_, PyDevice>>,
    ) -> PyResult<Self> {
        let (device, model) = (opened(py, device)?, &model.get().0);
        // Positions keep their precision relative to the model's origin.
        let frame = TrainingFrame { center: model.gaussians.origin.into(), scale: 1.0 };
        let config = TrainConfig { frame: Some(frame), ..TrainConfig::default() };
        let renderer = call(py, || ModelRenderer::new(&device, model, &config, None))?;
        Ok(Self { renderer: Mutex::new(renderer) })
    }

    /// The model of a run directory, with its networks, as `nightsplat render` shows it.
    #[staticmethod]
    #[pyo3(signature = (run, device = None))]
    fn of_run(
        py: Python<'_>,
        run: PathBuf,
        device: Option<&Bound<'_, PyDevice>>,
    ) -> PyResult<Self> {
        let device = opened(py, device)?;
        let renderer = call(py, || {
            let config = load_config(&run)?;
            let model = nightsplat::Model::load(&run)?;
            let features = model.gaussians.shape.features;
            let networks = load_networks(&device, &run, &config.model, features)?;
            ModelRenderer::new(&device, &model, &config, networks)
        })?;
        Ok(Self { renderer: Mutex::new(renderer) })
    }

    /// Renders a camera in the model's world, or a batch: a list of cameras of one size.
    fn render(&self, py: Python<'_>, camera: &Bound<'_, PyAny>) -> PyResult<PyRender> {
        let is_batch = camera.is_instance_of::<PyList>();
        let cameras = match is_batch {
            true => batch(camera.extract()?)?,
            false => vec![camera.extract::<PyCamera<'_>>()?.checked()?],
        };
        let views = call(py, || {
            let mut renderer = self.lock();
            let mut views = [vec![], vec![], vec![]];
            for camera in &cameras {
                let rendered = renderer.render_camera(camera)?;
                let alpha = rendered.transmittances.iter().flatten().map(|light| 1.0 - light);
                views[2].extend(alpha);
                views[0].extend(interleaved(rendered.output()));
                let pixels = camera.width as usize * camera.height as usize;
                let depth = renderer.layer(camera, RenderLayer::Depth)?;
                views[1].extend_from_slice(&depth.data[..pixels]);
            }
            Ok(views)
        })?;
        let nightsplat::Camera { width, height, .. } = cameras[0];
        let mut shape = vec![height as usize, width as usize];
        if is_batch {
            shape.insert(0, cameras.len());
        }
        let [color, depth, alpha] = views;
        let of_color = [&shape[..], &[3]].concat();
        Ok(PyRender {
            color: array(py, &of_color, color)?.unbind(),
            depth: array(py, &shape, depth)?.unbind(),
            alpha: array(py, &shape, alpha)?.unbind(),
        })
    }

    /// Renders a layer, as `nightsplat render --layer` names it, to (H, W, 3), float32; one of a single channel is
    /// repeated in all three.
    fn layer<'py>(
        &self,
        py: Python<'py>,
        camera: PyCamera<'_>,
        name: &str,
    ) -> PyResult<Floats<'py>> {
        let camera = camera.checked()?;
        of_image(py, &call(py, || self.lock().layer(&camera, name.parse()?))?)
    }
}

impl PyRenderer {
    fn lock(&self) -> MutexGuard<'_, ModelRenderer> {
        self.renderer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The cameras of a batch: of one size, at least one.
fn batch(cameras: Vec<PyCamera<'_>>) -> PyResult<Vec<nightsplat::Camera>> {
    let cameras = cameras.iter().map(PyCamera::checked).collect::<PyResult<Vec<_>>>()?;
    let mut sizes = cameras.iter().map(|camera| [camera.width, camera.height]);
    let Some(first) = sizes.next() else {
        return Err(usage("a batch has no camera; pass at least one"));
    };
    match sizes.find(|other| *other != first) {
        Some(other) => Err(usage(format!(
            "the cameras of a batch are {first:?} and {other:?} pixels; render them one by one"
        ))),
        None => Ok(cameras),
    }
}
