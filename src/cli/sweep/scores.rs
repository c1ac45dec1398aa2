//! Scores that a training does not take: LPIPS, kept beside `metrics.json` of each run.

use std::path::Path;

use nightsplat_core::output::{own_file, write_whole};
use nightsplat_photographs::dataset::View;

use crate::cli::opener;
use crate::gpu::Gpu;
use crate::networks::lpips::{Lpips, Range};
use crate::results::eval::{Evaluation, Extras, ScoreReference};
use crate::results::finished_run::FinishedRun;
use crate::results::sweep::{LPIPS_FILE, measured_later};
use crate::{Error, Result};

/// Measures the finished runs in these folders that have no value of this network and range yet.
pub(super) fn add_lpips(runs: &[&Path], gpu: &Gpu, weights: &Path, range: Range) -> Result<()> {
    let key = Lpips::load(gpu, weights, range)?.measure().key();
    for run in runs {
        let mut metrics = measured_later(run);
        if metrics["mean"].get(&key).is_some() {
            continue;
        }
        let FinishedRun { gpu, config, dataset, mut model_renderer, .. } =
            FinishedRun::open_lit(run, None, &opener(None), |_| {})?;
        let lpips = Lpips::load(&gpu, weights, range)?;
        let mut reference = ScoreReference::new(&gpu, &config.tone, &dataset)?;
        let is_even = reference.is_evenly_lit(&dataset);
        let render = |view: &View| model_renderer.render_as(view, is_even);
        let extras = Extras { lpips: Some((&lpips, &gpu)), ..Extras::default() };
        let evaluation = Evaluation::new(&mut reference, &dataset, &extras, render, |_| Ok(()))?;
        evaluation.add_lpips(&mut metrics);
        let text = serde_json::to_string_pretty(&metrics)
            .map_err(|error| Error::output(run.join(LPIPS_FILE), error.to_string()))?;
        write_whole(&own_file(run.join(LPIPS_FILE))?, text.as_bytes())?;
    }
    Ok(())
}
