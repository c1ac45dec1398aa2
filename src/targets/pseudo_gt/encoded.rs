//! A photograph or a target, stored on the device.

use std::sync::Arc;

use crate::Result;
use crate::gpu::{Buffer, Gpu};

/// A planar (3, H, W) photograph or target on the device, in the fewest bits that restore every value.
#[derive(Debug)]
pub struct EncodedPlanes {
    /// 8 or 16; 32 if `values` are the values themselves.
    pub code_bits: u32,
    /// 3 H W.
    pub value_count: usize,
    /// Four or two per word, lowest bits first; empty for 32 bits.
    pub codes: Buffer<u32>,
    /// One value per code, or all values.
    pub values: Arc<Buffer<f32>>,
}

impl EncodedPlanes {
    /// Uncoded values.
    pub fn plain(gpu: &Gpu, values: Arc<Buffer<f32>>) -> Result<Self> {
        let codes = gpu.uninit("no codes", 0)?;
        Ok(Self { code_bits: 32, value_count: values.len(), codes, values })
    }

    /// Its size on the device, bytes.
    pub fn bytes(&self) -> u64 {
        (self.codes.len() * size_of::<u32>() + self.values.len() * size_of::<f32>()) as u64
    }
}
