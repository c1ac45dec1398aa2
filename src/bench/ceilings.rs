//! What the device can do at most, in a second.

use serde_json::{Value, json};

use super::Bench;
use crate::Result;
use crate::ceilings::{Ceiling, CeilingOperation};

/// The measured ceilings.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ceilings {
    /// Bytes read and written per second.
    pub(super) bytes: f64,
    /// Multiplications and additions per second.
    flops: f64,
    /// 32-bit numbers exchanged between lanes per second.
    exchanges: f64,
}

impl Ceilings {
    pub(super) fn measure(bench: &Bench, ceiling: &mut Ceiling) -> Result<Self> {
        let mut speed = |operation| -> Result<f64> {
            let seconds = bench.median(|| ceiling.seconds(&bench.gpu, operation))?;
            Ok(ceiling.amount(operation) / seconds)
        };
        Ok(Self {
            bytes: speed(CeilingOperation::Copy)?,
            flops: speed(CeilingOperation::MultiplyAdd)?,
            exchanges: speed(CeilingOperation::Exchange)?,
        })
    }

    pub(super) fn as_json(&self) -> Value {
        json!({
            "copy_gb_per_s": self.bytes * 1e-9,
            "multiply_add_tflops": self.flops * 1e-12,
            "exchange_g_per_s": self.exchanges * 1e-9,
        })
    }

    pub(super) fn as_text(&self) -> String {
        let [copy, flops, exchanges] =
            [self.bytes * 1e-9, self.flops * 1e-12, self.exchanges * 1e-9];
        format!(
            "ceilings: {copy:.1} GB/s read and written, {flops:.3} TFLOPS, {exchanges:.1} G exchanges of lanes/s"
        )
    }
}
