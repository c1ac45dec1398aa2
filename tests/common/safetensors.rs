//! Reads and writes the float32 tensors of a safetensors file: a length, a JSON header, then the values.

use std::collections::BTreeMap;
use std::path::Path;

use safetensors::tensor::{Dtype, TensorView, serialize};

/// The values of every tensor by its name, in row-major order.
pub(crate) fn read(path: impl AsRef<Path>) -> BTreeMap<String, Vec<f32>> {
    let bytes = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap();
    let header_end = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..header_end]).unwrap();
    let entries = header.as_object().unwrap().iter().filter(|(name, _)| *name != "__metadata__");
    let tensor = |(name, entry): (&String, &serde_json::Value)| {
        assert_eq!(entry["dtype"], "F32", "{name}");
        let offset = |i: usize| header_end + entry["data_offsets"][i].as_u64().unwrap() as usize;
        let values = bytes[offset(0)..offset(1)].chunks_exact(4);
        let values = values.map(|value| f32::from_le_bytes(value.try_into().unwrap()));
        (name.clone(), values.collect())
    };
    entries.map(tensor).collect()
}

pub(crate) fn write(path: impl AsRef<Path>, tensors: &[(&str, &[usize], &[f32])]) {
    let views = tensors.iter().map(|(name, shape, values)| {
        let bytes = bytemuck::cast_slice(values);
        (*name, TensorView::new(Dtype::F32, shape.to_vec(), bytes).unwrap())
    });
    std::fs::write(path, serialize(views, None).unwrap()).unwrap();
}
