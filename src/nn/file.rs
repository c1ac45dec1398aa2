//! Networks on disk: safetensors, with `PyTorch`'s names, shapes and order.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde_json::Value;

use super::parameters::{Parameters, Tensor};
use crate::gpu::Gpu;
use crate::output::write_whole;
use crate::{Error, Result};

/// The key of the metadata that holds the settings of every network, as one JSON object.
const SETTINGS: &str = "networks";

/// Writes each network's tensors as `network.tensor`.
///
/// # Errors
/// The file cannot be written, or the device was lost.
pub fn save(path: &Path, networks: &[&Parameters], gpu: &Gpu) -> Result<()> {
    let mut settings = BTreeMap::new();
    let mut values = vec![];
    for parameters in networks {
        settings.insert(
            parameters.name,
            serde_json::from_str(parameters.settings()).unwrap_or(Value::Null),
        );
        values.push(gpu.read(&parameters.values)?);
    }
    let failed = |error: &dyn std::fmt::Display| {
        Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
    };
    let mut views = vec![];
    for (parameters, values) in networks.iter().zip(&values) {
        for tensor in parameters.tensors() {
            let bytes = bytemuck::cast_slice(&values[tensor.offset..][..tensor.len()]);
            let view = TensorView::new(Dtype::F32, tensor.shape.clone(), bytes);
            views.push((
                format!("{}.{}", parameters.name, tensor.name),
                view.map_err(|e| failed(&e))?,
            ));
        }
    }
    let settings = serde_json::json!(settings).to_string();
    let metadata = HashMap::from([(SETTINGS.to_owned(), settings)]);
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|error| failed(&error))?;
    write_whole(path, &bytes)
}

/// Reads each network's values from the tensors `network.tensor`; all networks are read, or none is changed.
///
/// # Errors
/// The file is missing or damaged, a value is not finite, or the file holds a network of another configuration.
pub fn load(path: &Path, networks: &mut [&mut Parameters], gpu: &Gpu) -> Result<()> {
    let bytes = std::fs::read(path)
        .map_err(|error| Error::input(path, format!("cannot be read ({error})")))?;
    let damaged = |error| Error::input(path, format!("is no whole safetensors file ({error})"));
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
    let file = SafeTensors::deserialize(&bytes).map_err(damaged)?;
    let settings = header.metadata().as_ref().and_then(|metadata| metadata.get(SETTINGS));
    let settings: Value = settings.and_then(|s| serde_json::from_str(s).ok()).unwrap_or_default();

    let mut values = vec![];
    for parameters in networks.iter() {
        let prefix = parameters.name;
        let remedy = match settings.get(prefix) {
            Some(made_with) => format!("use the settings it was made with: {made_with}"),
            None => "use the settings it was made with".to_owned(),
        };
        let other = |problem: String| {
            let own = parameters.settings();
            Error::input(path, format!("{problem}; this network has the settings {own}, {remedy}"))
        };
        let read = |tensor: &Tensor| {
            let name = format!("{prefix}.{}", tensor.name);
            let expected = &tensor.shape;
            let found = file.tensor(&name).map_err(|_| {
                other(format!("has no tensor `{name}`, which must be {expected:?}"))
            })?;
            if found.shape() != expected || found.dtype() != Dtype::F32 {
                let (shape, dtype) = (found.shape(), found.dtype());
                let problem = format!("tensor `{name}` is {shape:?} {dtype}, not {expected:?} F32");
                return Err(other(problem));
            }
            let values = found.data().chunks_exact(4);
            let values: Vec<f32> =
                values.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            if values.iter().all(|value| value.is_finite()) {
                return Ok(values);
            }
            let problem =
                format!("tensor `{name}` holds values that are not finite; save it again");
            Err(Error::input(path, problem))
        };
        let known: BTreeSet<String> =
            parameters.tensors().iter().map(|tensor| format!("{prefix}.{}", tensor.name)).collect();
        let is_stray = |name: &&str| {
            let is_own = name.strip_prefix(prefix).is_some_and(|rest| rest.starts_with('.'));
            is_own && !known.contains(*name)
        };
        values.push(parameters.tensors().iter().map(read).collect::<Result<Vec<_>>>()?.concat());
        if let Some(stray) = file.names().into_iter().filter(is_stray).min() {
            return Err(other(format!("holds a tensor `{stray}` that this network lacks")));
        }
    }
    networks
        .iter_mut()
        .zip(values)
        .try_for_each(|(parameters, values)| gpu.write(&mut parameters.values, &values))
}
