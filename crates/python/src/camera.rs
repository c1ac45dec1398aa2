//! Cameras, from the attributes of `nightsplat.Camera`.

use nightsplat::glam::{DAffine3, DMat3, DVec2, DVec3};
use nightsplat_core::camera::{CameraModel, Distortion, Lens, deviation_from_rigid};
use pyo3::prelude::*;

use crate::arrays::numbers;
use crate::error::usage;

/// A camera of Python.
#[derive(FromPyObject)]
pub(crate) struct PyCamera<'py> {
    view_from_world: Bound<'py, PyAny>,
    size: [u32; 2],
    focal: [f64; 2],
    principal_point: Option<[f64; 2]>,
    fisheye: Option<[f64; 4]>,
    is_orthographic: bool,
}

impl PyCamera<'_> {
    /// The library's camera; refused where the pose is not rigid or the lens cannot be used.
    pub(crate) fn checked(&self) -> PyResult<nightsplat::Camera> {
        let Self { view_from_world, size: [width, height], focal, principal_point, .. } = self;
        let (m, _) = numbers::<f64>("a pose", view_from_world, &[4, 4])?;
        let column = |column: usize| DVec3::new(m[column], m[4 + column], m[8 + column]);
        let turn = DMat3::from_cols(column(0), column(1), column(2));
        let view_from_world = DAffine3::from_mat3_translation(turn, column(3));
        let middle = DVec2::new((*width).into(), (*height).into()) / 2.0;
        let [k1, k2, k3, k4] = self.fisheye.unwrap_or_default();
        let is_fisheye = self.fisheye.is_some();
        if is_fisheye && self.is_orthographic {
            return Err(usage("a camera is a fisheye or orthographic, not both"));
        }
        let lens = Lens {
            width: *width,
            height: *height,
            focal: (*focal).into(),
            principal_point: principal_point.map_or(middle, DVec2::from),
            distortion: Distortion { k1, k2, k3, k4, is_fisheye, ..Distortion::default() },
        };
        if let Some(problem) = lens.problem() {
            return Err(usage(format!("the camera cannot be used: {problem}")));
        }
        if m[12..] != [0.0, 0.0, 0.0, 1.0] || deviation_from_rigid(&view_from_world).is_some() {
            return Err(usage("the pose is not rigid; take scale and reflection out"));
        }
        let Lens { width, height, focal, principal_point, .. } = lens;
        let model = match self.is_orthographic {
            true => CameraModel::Orthographic,
            false => lens.model().unwrap_or_default(),
        };
        Ok(nightsplat::Camera { width, height, focal, principal_point, model, view_from_world })
    }
}

/// Raises where a camera cannot be rendered.
#[pyfunction]
pub(crate) fn check_camera(camera: PyCamera<'_>) -> PyResult<()> {
    camera.checked().map(drop)
}

/// One of the library's cameras, for Python.
pub(crate) fn of_python<'py>(
    py: Python<'py>,
    camera: &nightsplat::Camera,
) -> PyResult<Bound<'py, PyAny>> {
    let DAffine3 { matrix3, translation } = camera.view_from_world;
    let row = |row: usize| {
        let [x, y, z] = matrix3.row(row).to_array();
        [x, y, z, translation[row]]
    };
    let pose = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
    let fisheye = match camera.model {
        CameraModel::Fisheye(lens) => Some(lens.coefficients),
        CameraModel::Pinhole | CameraModel::Orthographic => None,
    };
    let is_orthographic = camera.model == CameraModel::Orthographic;
    let (size, focal) = ((camera.width, camera.height), <(f64, f64)>::from(camera.focal));
    let principal_point = <(f64, f64)>::from(camera.principal_point);
    let class = py.import("nightsplat._camera")?.getattr("Camera")?;
    class.call1((pose, size, focal, principal_point, fisheye, is_orthographic))
}
