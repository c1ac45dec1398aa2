//! Exceptions: a class for each kind of error, with the texts of the command.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(nightsplat, Error, PyException, "One line that names the object and the remedy.");

/// The classes below [`Error`].
macro_rules! exceptions {
    ($($class:ident: $doc:literal,)*) => {
        $(create_exception!(nightsplat, $class, Error, $doc);)*

        /// Adds every class to the module.
        pub(crate) fn add(module: &Bound<'_, PyModule>) -> PyResult<()> {
            module.add("Error", module.py().get_type::<Error>())?;
            $(module.add(stringify!($class), module.py().get_type::<$class>())?;)*
            Ok(())
        }
    };
}

exceptions! {
    InputError: "A file or folder is missing, truncated or invalid.",
    OutputError: "A file or folder cannot be written.",
    SettingError: "A setting has an invalid value.",
    UsageError: "An argument, or a combination of them, is invalid.",
    DeviceError: "There is no such device, or it lacks what the kernels need.",
    OutOfMemoryError: "Device memory does not suffice.",
    DeviceLostError: "The device stopped answering.",
    VulkanError: "A Vulkan call failed for another reason.",
    TileLimitError: "More splats are on one tile than the device can process.",
    NotFiniteError: "A loss, a gradient or a parameter is NaN or infinite.",
    DisagreesError: "A checked pass differs from its CPU reference.",
}

/// The exception for an error of the library.
pub(crate) fn exception(error: nightsplat::Error) -> PyErr {
    use nightsplat::Error as Kind;
    let text = error.to_string();
    match error {
        Kind::Input { .. } => InputError::new_err(text),
        Kind::Output { .. } => OutputError::new_err(text),
        Kind::Setting { .. } => SettingError::new_err(text),
        Kind::Usage(_) => UsageError::new_err(text),
        Kind::NoDevice(_)
        | Kind::MissingFeature { .. }
        | Kind::SelfTest { .. }
        | Kind::Kernel { .. } => DeviceError::new_err(text),
        Kind::OutOfMemory { .. } | Kind::BufferTooLarge { .. } => OutOfMemoryError::new_err(text),
        Kind::DeviceLost { .. } => DeviceLostError::new_err(text),
        Kind::Vulkan { .. } => VulkanError::new_err(text),
        Kind::TileLimit { .. } => TileLimitError::new_err(text),
        Kind::NotFinite { .. } | Kind::ParameterNotFinite { .. } => NotFiniteError::new_err(text),
        Kind::Disagrees { .. } => DisagreesError::new_err(text),
        _ => Error::new_err(text),
    }
}

/// The exception for an invalid argument.
pub(crate) fn usage(text: impl Into<String>) -> PyErr {
    UsageError::new_err(text.into())
}
