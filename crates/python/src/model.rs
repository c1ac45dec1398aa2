//! Models.

use std::path::PathBuf;

use nightsplat::Gaussians;
use nightsplat::glam::Vec3;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, numbers};
use crate::call;
use crate::error::usage;

/// Gaussians with what a renderer must know of them; `len` is their number.
#[pyclass(frozen, name = "Model", module = "nightsplat")]
pub(crate) struct PyModel(pub(crate) nightsplat::Model);

#[pymethods]
impl PyModel {
    /// Reads a model: PLY, SPZ, SOG, or a run directory.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        call(py, || nightsplat::Model::load(path)).map(Self)
    }

    /// A model of arrays as `arrays` returns them; without `rest`, of SH degree 0. The means are relative to `origin`,
    /// world units.
    #[staticmethod]
    #[pyo3(signature = (means, quats, log_scales, raw_opacities, dc, rest = None, *, origin = [0.0; 3]))]
    fn from_arrays(
        means: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        log_scales: &Bound<'_, PyAny>,
        raw_opacities: &Bound<'_, PyAny>,
        dc: &Bound<'_, PyAny>,
        rest: Option<&Bound<'_, PyAny>>,
        origin: [f64; 3],
    ) -> PyResult<Self> {
        let (means, shape) = numbers("means", means, &[-1, 3])?;
        let count = shape[0] as isize;
        let (rest, shape) = match rest {
            Some(rest) => numbers("rest", rest, &[count, -1, 3])?,
            None => (vec![], vec![shape[0], 0, 3]),
        };
        let degree = (0..=3_u32).find(|degree| (degree + 1).pow(2) as usize == shape[1] + 1);
        let problem =
            || usage(format!("rest has {} coefficients; it must have 0, 3, 8 or 15", shape[1]));
        let mut gaussians = Gaussians::zeros(shape[0], degree.ok_or_else(problem)?);
        gaussians.origin = origin.into();
        fill(gaussians.means_mut(), &means);
        let (quats, _) = numbers::<f32>("quats", quats, &[count, 4])?;
        gaussians.quats_mut().as_flattened_mut().copy_from_slice(&quats);
        fill(gaussians.log_scales_mut(), &numbers("log_scales", log_scales, &[count, 3])?.0);
        let (opacities, _) = numbers("raw_opacities", raw_opacities, &[count])?;
        gaussians.raw_opacities_mut().copy_from_slice(&opacities);
        fill(gaussians.dc_mut(), &numbers("dc", dc, &[count, 3])?.0);
        fill(gaussians.rest_mut(), &rest);
        let is_finite = gaussians.parameters.iter().all(|value| value.is_finite());
        match is_finite && gaussians.origin.is_finite() {
            true => Ok(Self(gaussians.into())),
            false => Err(usage("the arrays hold NaN or infinity; a model holds finite numbers")),
        }
    }

    /// Writes the model in the format of the extension: .ply, .spz, .glb or .sog. The file appears once it is complete.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        call(py, || self.0.save(path))
    }

    /// Copies of the parameters, float32: means (N, 3), relative to `origin`, world units; quats (N, 4), rotations (w,
    /// x, y, z), not normalised; log_scales (N, 3), natural logarithms of standard deviations; raw_opacities (N,),
    /// before the sigmoid; dc (N, 3), SH of degree 0, RGB; rest (N, (degree + 1)^2 - 1, 3), SH above degree 0.
    fn arrays<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let gaussians = &self.0.gaussians;
        let count = gaussians.count;
        let coefficients = gaussians.rest().len() / count.max(1);
        let quats = gaussians.quats().as_flattened().to_vec();
        let all = PyDict::new(py);
        all.set_item("means", array(py, &[count, 3], flat(gaussians.means()))?)?;
        all.set_item("quats", array(py, &[count, 4], quats)?)?;
        all.set_item("log_scales", array(py, &[count, 3], flat(gaussians.log_scales()))?)?;
        all.set_item("raw_opacities", array(py, &[count], gaussians.raw_opacities().to_vec())?)?;
        all.set_item("dc", array(py, &[count, 3], flat(gaussians.dc()))?)?;
        all.set_item("rest", array(py, &[count, coefficients, 3], flat(gaussians.rest()))?)?;
        Ok(all)
    }

    /// The position that the means are relative to, world units.
    #[getter]
    fn origin(&self) -> (f64, f64, f64) {
        self.0.gaussians.origin.into()
    }

    /// The degree of the spherical harmonics, 0 to 3.
    #[getter]
    fn sh_degree(&self) -> u32 {
        self.0.gaussians.shape.sh_degree
    }

    fn __len__(&self) -> usize {
        self.0.gaussians.count
    }
}

fn flat(vectors: &[Vec3]) -> Vec<f32> {
    vectors.iter().flat_map(|vector| vector.to_array()).collect()
}

fn fill(vectors: &mut [Vec3], values: &[f32]) {
    let values = values.chunks_exact(3).map(Vec3::from_slice);
    vectors.iter_mut().zip(values).for_each(|(vector, value)| *vector = value);
}
