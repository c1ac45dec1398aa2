//! Devices.

use nightsplat::{DeviceChoice, Gpu};
use pyo3::prelude::*;

use crate::call;

/// A Vulkan device: its index, a part of its name, "uuid:...", "pci:..." or "cpu"; by default the best.
///
/// With `validation`, VK_LAYER_KHRONOS_validation checks every call, and synchronization; its messages are errors of
/// the logger "vulkan".
#[pyclass(frozen, name = "Device", module = "nightsplat")]
pub(crate) struct PyDevice(Gpu);

#[pymethods]
impl PyDevice {
    #[new]
    #[pyo3(signature = (choice = "", *, validation = false))]
    fn new(py: Python<'_>, choice: &str, validation: bool) -> PyResult<Self> {
        let gpu = call(py, || {
            let choice: DeviceChoice = choice.parse()?;
            if validation { Gpu::with_validation(&choice) } else { Gpu::new(&choice) }
        })?;
        Ok(Self(gpu))
    }

    /// The names of the devices of this machine, in the order of their indices.
    #[staticmethod]
    fn names(py: Python<'_>) -> PyResult<Vec<String>> {
        let found = call(py, nightsplat::devices)?;
        Ok(found.into_iter().map(|device| device.name).collect())
    }

    /// The device's name.
    #[getter]
    fn name(&self) -> &str {
        &self.0.properties().name
    }
}

/// The device of an argument; without one, the best is opened.
pub(crate) fn opened(py: Python<'_>, device: Option<&Bound<'_, PyDevice>>) -> PyResult<Gpu> {
    match device {
        Some(device) => Ok(device.get().0.clone()),
        None => call(py, || Gpu::new(&DeviceChoice::Best)),
    }
}
