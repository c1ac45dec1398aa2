use super::CompensatedSum;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ToneStatistics;
use crate::kernels::tone_statistics::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { searches, sums, statistics } = slices;
        let mut total = CompensatedSum::default();
        for thread in 0..256 {
            let mut of_thread = CompensatedSum::default();
            for i in (thread..params.sum_count as usize).step_by(256) {
                of_thread.add(sums[i]);
            }
            total.add(of_thread.sum);
        }
        let means = total.sum / params.pixel_count as f32;
        let percentile = |search: usize, weight: f32| {
            let lower = f32::from_bits(searches[search].prefix);
            let upper = f32::from_bits(searches[search + 1].prefix);
            lower + weight * (upper - lower) + 1e-6
        };
        statistics[0] = ToneStatistics {
            p10: percentile(0, params.weights.x),
            p80: if constants.takes_p80 { percentile(4, params.weights.z) } else { 0.0 },
            p90: percentile(2, params.weights.y),
            mean_luminance: 0.299 * means.x + 0.587 * means.y + 0.114 * means.z,
            mean: (means.x + means.y + means.z) / 3.0,
            channel_means: means,
        };
    }

    /// The sums are the same bits; each statistic is a division of five and six more roundings, as in the reference.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { statistics: Tolerance::Roundings(22.0) }
    }
}
