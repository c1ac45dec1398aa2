//! Devices.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use nightsplat::{DeviceChoice, Gpu};
use pyo3::prelude::*;

use crate::call;

/// The best device: open as long as an object holds it.
static BEST: Mutex<Weak<Gpu>> = Mutex::new(Weak::new());

/// A Vulkan device: its index, a part of its name, "uuid:...", "pci:..." or "cpu"; by default the best.
///
/// With `validation`, VK_LAYER_KHRONOS_validation checks every call, and synchronization; its messages are errors of
/// the logger "vulkan".
#[pyclass(frozen, module = "nightsplat")]
pub(crate) struct Device(Arc<Gpu>);

#[pymethods]
impl Device {
    #[new]
    #[pyo3(signature = (choice = "", *, validation = false))]
    fn new(py: Python<'_>, choice: &str, validation: bool) -> PyResult<Self> {
        let gpu = call(py, || {
            let choice: DeviceChoice = choice.parse()?;
            if validation { Gpu::with_validation(&choice) } else { Gpu::new(&choice) }
        })?;
        Ok(Self(Arc::new(gpu)))
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

/// The device of an argument, or the best.
pub(crate) fn opened(py: Python<'_>, device: Option<&Bound<'_, Device>>) -> PyResult<Arc<Gpu>> {
    if let Some(device) = device {
        return Ok(device.get().0.clone());
    }
    call(py, || {
        let mut best = BEST.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(gpu) = best.upgrade() {
            return Ok(gpu);
        }
        let gpu = Arc::new(Gpu::new(&DeviceChoice::Best)?);
        *best = Arc::downgrade(&gpu);
        Ok(gpu)
    })
}
