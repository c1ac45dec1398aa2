//! The rows of `evals.csv`: intermediate scores of a run.

use super::meter::ResourceUsage;
use crate::results::eval::{After, Evaluation, Metric};

/// The mean scores of the test views at one step, and the resources up to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunProgress {
    /// Counted from 1.
    pub step: u64,
    /// The number of scored views.
    pub views: usize,
    /// The mean over the test views, dB.
    pub psnr: f64,
    /// The mean over the test views of the mean of the channels' own, dB.
    pub psnr_channel_mean: f64,
    /// The mean over the test views.
    pub ssim: f64,
    /// Wall-clock time, without scoring.
    pub seconds: f64,
    /// Time on all processors, without scoring; `None` if the system does not report it.
    pub processor_seconds: Option<f64>,
    /// Energy of the whole machine; `None` if it has no counter.
    pub joules: Option<f64>,
    /// The number of Gaussians.
    pub gaussians: u64,
}

impl RunProgress {
    pub(super) const COLUMNS: &str =
        "step,views,psnr,psnr_channel_mean,ssim,seconds,processor_seconds,joules,gaussians";

    /// The means of an evaluation; `None` without scored views.
    pub(super) fn new(
        step: u64,
        gaussians: usize,
        evaluation: &Evaluation,
        spent: &ResourceUsage,
    ) -> Option<Self> {
        let mean = |metric| evaluation.mean(metric, After::Model);
        Some(Self {
            step,
            views: evaluation.views().len(),
            psnr: mean(Metric::Psnr)?,
            psnr_channel_mean: mean(Metric::PsnrChannelMean)?,
            ssim: mean(Metric::Ssim)?,
            seconds: spent.seconds,
            processor_seconds: spent.processor_seconds,
            joules: spent.joules,
            gaussians: gaussians as u64,
        })
    }

    pub(super) fn line(&self) -> String {
        let Self { step, views, psnr, psnr_channel_mean, ssim, seconds, gaussians, .. } = self;
        let [processor, joules] = [self.processor_seconds, self.joules]
            .map(|value| value.map_or_else(String::new, |value| format!("{value:.2}")));
        format!(
            "{step},{views},{psnr},{psnr_channel_mean},{ssim},{seconds:.3},{processor},{joules},{gaussians}\n"
        )
    }

    /// Parses a line; `None` if it is not a row.
    pub(super) fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.split(',').collect();
        let [step, views, psnr, channel_mean, ssim, seconds, processor, joules, gaussians] =
            fields[..]
        else {
            return None;
        };
        Some(Self {
            step: step.parse().ok()?,
            views: views.parse().ok()?,
            psnr: psnr.parse().ok()?,
            psnr_channel_mean: channel_mean.parse().ok()?,
            ssim: ssim.parse().ok()?,
            seconds: seconds.parse().ok()?,
            processor_seconds: processor.parse().ok(),
            joules: joules.parse().ok(),
            gaussians: gaussians.parse().ok()?,
        })
    }
}
