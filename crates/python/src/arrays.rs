//! Arrays of numpy, to and from the library's images and numbers. `_convert.py` checks what comes in.

use nightsplat::Image;
use numpy::ndarray::ArrayD;
use numpy::{
    Element, PyArray, PyArrayDyn, PyReadonlyArray3, PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::error::usage;

/// An array of Python.
pub(crate) type Floats<'py> = Bound<'py, PyArrayDyn<f32>>;

/// An image, from anything that numpy takes for an array (H, W, 3) of uint8, of uint16 or of floats from 0 to 1.
pub(crate) struct PyImage(pub(crate) Image);

impl<'py> FromPyObject<'_, 'py> for PyImage {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let converted =
            object.py().import("nightsplat._convert")?.call_method1("planes", (object,))?;
        let planes: PyReadonlyArray3<'py, f32> = converted.extract()?;
        let [height, width] = [1, 2].map(|axis| planes.shape()[axis] as u32);
        Ok(Self(Image { width, height, data: planes.as_slice()?.to_vec() }))
    }
}

/// The numbers of anything that numpy takes for an array of this shape, in the order of C, and their shape. -1 is any
/// length.
pub(crate) fn numbers<'py, T: Element + Copy>(
    name: &str,
    array: &Bound<'py, PyAny>,
    shape: &[isize],
) -> PyResult<(Vec<T>, Vec<usize>)> {
    let py = array.py();
    let arguments = (name, array, shape.to_vec(), numpy::dtype::<T>(py));
    let converted = py.import("nightsplat._convert")?.call_method1("numbers", arguments)?;
    let numbers: PyReadonlyArrayDyn<'py, T> = converted.extract()?;
    Ok((numbers.as_slice()?.to_vec(), numbers.shape().to_vec()))
}

/// An array of `shape` with the values in the order of C.
pub(crate) fn array<'py, T: Element>(
    py: Python<'py>,
    shape: &[usize],
    values: Vec<T>,
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let array = ArrayD::from_shape_vec(shape, values).map_err(|error| usage(error.to_string()))?;
    Ok(PyArray::from_owned_array(py, array))
}

/// The values of an image by pixel, (H, W, 3).
pub(crate) fn interleaved(Image { data, .. }: &Image) -> Vec<f32> {
    (0..data.len()).map(|index| data[index % 3 * (data.len() / 3) + index / 3]).collect()
}

/// The array of an image, (H, W, 3).
pub(crate) fn of_image<'py>(py: Python<'py>, image: &Image) -> PyResult<Floats<'py>> {
    array(py, &[image.height as usize, image.width as usize, 3], interleaved(image))
}
