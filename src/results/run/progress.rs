//! The rows of `evals.csv`: how a run came to where it is.

use super::meter::ResourceUsage;
use crate::photographs::metrics::Scores;

/// The scores of the test views at one step of a run, and what the steps up to it took.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Counted from 1.
    pub step: u64,
    /// How many were scored.
    pub views: usize,
    /// The mean over the test views, dB.
    pub psnr: f64,
    /// The mean over the test views of the mean of the channels' own, dB.
    pub psnr_channel_mean: f64,
    /// The mean over the test views.
    pub ssim: f64,
    /// On the wall, without scoring.
    pub seconds: f64,
    /// On all processors together, without scoring; none where the system does not say.
    pub processor_seconds: Option<f64>,
    /// Of the whole machine; none where it has no counter.
    pub joules: Option<f64>,
    /// The number of Gaussians.
    pub gaussians: u64,
}

impl Progress {
    pub(super) const COLUMNS: &str =
        "step,views,psnr,psnr_channel_mean,ssim,seconds,processor_seconds,joules,gaussians";

    pub(super) fn new(
        step: u64,
        gaussians: usize,
        views: usize,
        scores: &Scores,
        spent: &ResourceUsage,
    ) -> Self {
        Self {
            step,
            views,
            psnr: scores.psnr,
            psnr_channel_mean: scores.psnr_channel_mean,
            ssim: scores.ssim,
            seconds: spent.seconds,
            processor_seconds: spent.processor_seconds,
            joules: spent.joules,
            gaussians: gaussians as u64,
        }
    }

    pub(super) fn line(&self) -> String {
        let Self { step, views, psnr, psnr_channel_mean, ssim, seconds, gaussians, .. } = self;
        let [processor, joules] = [self.processor_seconds, self.joules]
            .map(|value| value.map_or_else(String::new, |value| format!("{value:.2}")));
        format!(
            "{step},{views},{psnr},{psnr_channel_mean},{ssim},{seconds:.3},{processor},{joules},{gaussians}\n"
        )
    }

    /// None of a line that is no row.
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
