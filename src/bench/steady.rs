//! Many steps as training submits them: time on the wall, on the device, in the passes, and of the processor.

use std::time::Instant;

use serde_json::{Value, json};

use super::{Bench, total};
use crate::Result;
use crate::train::Trainer;

/// Milliseconds of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Steady {
    steps: u64,
    wall: f64,
    /// From the start of the first pass to the end of the last.
    device: f64,
    /// Of all passes, each with a timestamp after it, which keeps it from overlapping with the next.
    passes: f64,
    /// User and system time of this process; absent where the system does not report it.
    processor: Option<f64>,
}

pub(super) fn time(bench: &Bench, trainer: &mut Trainer, steps: u64) -> Result<Steady> {
    let passes = bench.median(|| Ok(total(&trainer.profile_step()?)))?;
    let device = bench.median(|| trainer.profile_whole_step())?;
    let (begin, processor) = (Instant::now(), processor_seconds());
    let until = trainer.steps_done() + steps;
    while trainer.steps_done() < until {
        trainer.advance(until)?;
    }
    let per_step = |seconds: f64| seconds * 1e3 / steps as f64;
    let used = processor_seconds().zip(processor).map(|(now, before)| now - before);
    Ok(Steady {
        steps,
        wall: per_step(begin.elapsed().as_secs_f64()),
        device,
        passes,
        processor: used.map(per_step),
    })
}

impl Steady {
    pub(super) fn as_json(&self) -> Value {
        json!({
            "steps": self.steps,
            "wall_ms": self.wall,
            "device_ms": self.device,
            "passes_ms": self.passes,
            "idle_ms": self.wall - self.device,
            "processor_ms": self.processor,
        })
    }

    pub(super) fn as_text(&self) -> String {
        let Self { steps, wall, device, passes, processor } = self;
        let processor = processor.map(|ms| format!(", {ms:.3} of the processor"));
        format!(
            "{steps} steps: {wall:.3} ms each, {device:.3} on the device, {:.3} between steps{}; \
             {passes:.3} with every pass timed",
            wall - device,
            processor.unwrap_or_default()
        )
    }
}

/// User and system time of this process on Linux, where a tick is a hundredth of a second.
fn processor_seconds() -> Option<f64> {
    processor_ticks(&std::fs::read_to_string("/proc/self/stat").ok()?).map(|ticks| ticks / 100.0)
}

/// The name of the program, in brackets, may contain spaces and brackets.
fn processor_ticks(stat: &str) -> Option<f64> {
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<f64>().ok();
    Some(next()? + next()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_is_read_past_a_name_with_brackets() {
        let stat = "7 (a) b) R 1 7 7 0 -1 4194304 95 0 0 0 30 12 0 0 20 0 1 0 5 8 9";
        assert_eq!(processor_ticks(stat), Some(42.0));
        assert_eq!(processor_ticks("7 (a"), None);
    }
}
