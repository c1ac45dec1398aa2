//! Scores that a training does not take: LPIPS, kept beside `metrics.json` of each run, and those of the renders of
//! other programs.

use std::path::Path;

use nightsplat_core::output::{create_folder, own_file, write_whole};
use nightsplat_photographs::dataset::{Dataset, View, ViewPictures};
use serde_json::json;

use super::SweepArgs;
use crate::cli::opener;
use crate::gpu::Gpu;
use crate::networks::lpips::{Lpips, Range};
use crate::results::comparison::NamedRenders;
use crate::results::eval::{Evaluation, Extras, ScoreReference};
use crate::results::finished_run::FinishedRun;
use crate::results::sweep::{LPIPS_FILE, RENDERS, SweepPoint, SweepRun, measured_later};
use crate::train::{Rendered, TrainConfig};
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

/// Scores the renders of another program against the reference images of the test views, into a folder as of a run.
pub(super) fn of_renders(
    NamedRenders { name, folder }: &NamedRenders,
    args: &SweepArgs,
    dataset: &Dataset,
    config: &TrainConfig,
) -> Result<SweepRun> {
    let pictures = ViewPictures::of_tests(folder, dataset)?;
    let network = args.lpips.as_deref().map(|weights| {
        let gpu = super::open(config)?;
        Ok::<_, Error>((Lpips::load(&gpu, weights, args.lpips_range.into())?, gpu))
    });
    let network = network.transpose()?;
    let lpips = network.as_ref().map(|(lpips, gpu)| (lpips, gpu));
    let extras = Extras { lpips, ..Extras::default() };
    let render = |view: &View| pictures.load(view).map(Rendered::from);
    let mut references = ScoreReference::default();
    let evaluation = Evaluation::new(&mut references, dataset, &extras, render, |_| Ok(()))?;
    let mut metrics = evaluation.json(None, None, None);
    let absolute = std::path::absolute(folder).unwrap_or_else(|_| folder.clone());
    metrics[RENDERS] = json!(absolute);
    let point = SweepPoint { values: vec![(RENDERS.to_owned(), name.clone())] };
    let run = SweepRun { name: point.name(), folder: args.out.join(point.name()), point };
    create_folder(&run.folder)?;
    write_whole(&own_file(run.folder.join("metrics.json"))?, format!("{metrics:#}").as_bytes())?;
    Ok(run)
}
