//! Network files: safetensors with `PyTorch`'s names, shapes and order.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

use nightsplat_core::input;
use nightsplat_core::output::write_whole;
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, Metadata, SafeTensors, TensorInfo, TensorView};
use serde_json::Value;

use super::parameters::{Parameters, Tensor};
use crate::gpu::Gpu;
use crate::{Error, Result};

/// The metadata key for the settings of every network, as one JSON object.
const SETTINGS: &str = "networks";

/// A safetensors file whose header is read once.
pub(crate) struct TensorFile<'a> {
    metadata: Metadata,
    /// The data after the header.
    data: &'a [u8],
}

impl<'a> TensorFile<'a> {
    pub(crate) fn parse(bytes: &'a [u8]) -> std::result::Result<Self, SafeTensorError> {
        let (header_bytes, metadata) = SafeTensors::read_metadata(bytes)?;
        // The length of the header precedes it.
        Ok(Self { metadata, data: &bytes[size_of::<u64>() + header_bytes..] })
    }

    /// The metadata under `key`.
    pub(crate) fn note(&self, key: &str) -> Option<&str> {
        self.metadata.metadata().as_ref()?.get(key).map(String::as_str)
    }

    /// Every tensor's name and bytes, in file order.
    pub(crate) fn tensors(&self) -> Vec<(String, &'a [u8])> {
        let names = self.metadata.offset_keys().into_iter();
        let bytes = |name: String| Some((self.tensor(&name)?.1, name));
        names.filter_map(bytes).map(|(bytes, name)| (name, bytes)).collect()
    }

    /// A tensor and its bytes.
    pub(crate) fn tensor(&self, name: &str) -> Option<(&TensorInfo, &'a [u8])> {
        let info = self.metadata.info(name)?;
        let (begin, end) = info.data_offsets;
        Some((info, &self.data[begin..end]))
    }

    /// The values of a tensor of 32-bit floats; an error describes the problem.
    pub(crate) fn floats(
        &self,
        name: &str,
        expected: &[usize],
    ) -> std::result::Result<Vec<f32>, String> {
        let (TensorInfo { shape, dtype, .. }, bytes) = self
            .tensor(name)
            .ok_or_else(|| format!("has no tensor `{name}`, which must be {expected:?}"))?;
        if shape != expected || *dtype != Dtype::F32 {
            return Err(format!("tensor `{name}` is {shape:?} {dtype}, not {expected:?} F32"));
        }
        let values = bytes.chunks_exact(4);
        Ok(values.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }
}

/// Writes each network's tensors as `network.tensor`.
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
            let bytes = bytemuck::cast_slice(&values[tensor.offset..][..tensor.element_count()]);
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

/// Reads each network's values from the tensors `network.tensor`: all networks, or none on failure.
pub fn load(path: &Path, networks: &mut [&mut Parameters], gpu: &Gpu) -> Result<()> {
    let bytes = input::bytes(path)?;
    let damaged =
        |error| Error::input(path, format!("is not an intact safetensors file ({error})"));
    let file = TensorFile::parse(&bytes).map_err(damaged)?;
    let settings = file.note(SETTINGS);
    let settings: Value = settings.and_then(|s| serde_json::from_str(s).ok()).unwrap_or_default();

    let mut values = vec![];
    for parameters in networks.iter() {
        let prefix = parameters.name;
        let remedy = match settings.get(prefix) {
            Some(made_with) => format!("use the settings it was made with: {made_with}"),
            None => "use the settings it was made with".to_owned(),
        };
        let other = |problem: String| {
            let settings = parameters.settings();
            Error::input(
                path,
                format!("{problem}; this network has the settings {settings}, {remedy}"),
            )
        };
        let read = |tensor: &Tensor| {
            let name = format!("{prefix}.{}", tensor.name);
            let values = file.floats(&name, &tensor.shape).map_err(other)?;
            if values.iter().all(|value| value.is_finite()) {
                return Ok(values);
            }
            let problem =
                format!("tensor `{name}` holds values that are not finite; save it again");
            Err(Error::input(path, problem))
        };
        let expected_names: BTreeSet<String> =
            parameters.tensors().iter().map(|tensor| format!("{prefix}.{}", tensor.name)).collect();
        let is_stray = |name: &&str| {
            let is_own = name.strip_prefix(prefix).is_some_and(|rest| rest.starts_with('.'));
            is_own && !expected_names.contains(*name)
        };
        values.push(parameters.tensors().iter().map(read).collect::<Result<Vec<_>>>()?.concat());
        let names = file.metadata.tensors();
        if let Some(stray) = names.keys().map(String::as_str).filter(is_stray).min() {
            return Err(other(format!("holds a tensor `{stray}` that this network lacks")));
        }
    }
    networks
        .iter_mut()
        .zip(values)
        .try_for_each(|(parameters, values)| gpu.write(&mut parameters.values, &values))
}
