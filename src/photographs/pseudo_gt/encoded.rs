//! What a photograph or a target is on the device.

use std::sync::Arc;

use crate::Result;
use crate::gpu::{Buffer, Gpu};

/// A planar (3, H, W) photograph or target on the device, in as few bits as give every value back.
#[derive(Debug)]
pub struct Encoded {
    /// 8 or 16; 32 where `values` are the values themselves.
    pub code_bits: u32,
    /// 3 H W.
    pub value_count: usize,
    /// Four or two in a word, the lowest bits first; empty where there are none.
    pub codes: Buffer<u32>,
    /// One per code, or all.
    pub values: Arc<Buffer<f32>>,
}

impl Encoded {
    /// The values as they are.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn plain(gpu: &Gpu, values: Arc<Buffer<f32>>) -> Result<Self> {
        let codes = gpu.uninit("no codes", 0)?;
        Ok(Self { code_bits: 32, value_count: values.len(), codes, values })
    }

    /// What it takes on the device, bytes.
    pub fn bytes(&self) -> u64 {
        (self.codes.len() * size_of::<u32>() + self.values.len() * size_of::<f32>()) as u64
    }
}
