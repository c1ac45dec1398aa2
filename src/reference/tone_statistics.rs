use super::CompensatedSum;
use super::tone::{CURVE_ASE, CURVE_LINEAR, CURVE_NONE};
use crate::gpu::Reference;
use crate::kernels::tone_statistics::{Constants, Kernel, Params, Slices};
use crate::kernels::{ToneParameters, ToneStatistics};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { searches, sums, statistics, parameters } = slices;
        let mut total = CompensatedSum::default();
        for thread in 0..256 {
            let mut of_thread = CompensatedSum::default();
            for i in (thread..params.thread_count as usize).step_by(256) {
                of_thread.add(sums[i]);
            }
            total.add(of_thread.sum);
        }
        let mean = total.sum / params.pixel_count as f32;
        let percentile = |search: usize, weight: f32| {
            let lower = f32::from_bits(searches[search].prefix);
            let upper = f32::from_bits(searches[search + 1].prefix);
            lower + weight * (upper - lower) + 1e-6
        };
        statistics[0] = ToneStatistics {
            p10: percentile(0, params.weights.x),
            p90: percentile(2, params.weights.y),
            mean_luminance: mean.x,
            mean: mean.y / 3.0,
        };
        parameters[params.view as usize] = curve_of(constants.tone_curve, params, &statistics[0]);
    }
}

fn curve_of(curve: u32, params: &Params, of: &ToneStatistics) -> ToneParameters {
    if curve == CURVE_NONE {
        return ToneParameters { white: 1.0, offset: 0.0, gain: 1.0 };
    }
    if curve == CURVE_LINEAR {
        return ToneParameters {
            white: (of.mean / params.theta).max(1e-12),
            offset: 0.0,
            gain: 1.0,
        };
    }
    let crushed = 1.0 - (of.p10 / of.p90).clamp(0.0, 1.0);
    let offset = params.alpha * crushed.powf(params.beta);
    let base = if curve == CURVE_ASE { params.base_gain } else { 1.0 };
    ToneParameters { white: of.p90, offset, gain: base + params.gain_c * of.mean_luminance }
}
