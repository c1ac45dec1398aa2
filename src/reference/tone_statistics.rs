use super::CompensatedSum;
use super::real::Real;
use super::tone::{CURVE_LINEAR, CURVE_LUM_PRESERVE, CURVE_NONE, CURVE_P80, CURVE_PER_CHANNEL};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::tone_statistics::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::{ToneParameters, ToneStatistics};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { searches, sums, statistics, parameters } = slices;
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
        let takes_p80 = constants.tone_curve == CURVE_P80;
        statistics[0] = ToneStatistics {
            p10: percentile(0, params.weights.x),
            p80: if takes_p80 { percentile(4, params.weights.z) } else { 0.0 },
            p90: percentile(2, params.weights.y),
            mean_luminance: 0.299 * means.x + 0.587 * means.y + 0.114 * means.z,
            mean: (means.x + means.y + means.z) / 3.0,
            channel_means: means,
        };
        parameters[params.view as usize] = curve_of(constants.tone_curve, params, &statistics[0]);
    }

    /// The sums are the same bits; each statistic is a division of five and six more roundings, as in the reference, and
    /// the curve's constants take a division, and a power of 6 + 6 |beta ln| more.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances {
            statistics: Tolerance::Roundings(22.0),
            parameters: Tolerance::Roundings(100.0),
        }
    }
}

fn curve_of(curve: u32, params: &Params, of: &ToneStatistics) -> ToneParameters {
    let bounded_gain = |value: f32| (params.theta / value).clamp(1.0, 6.0);
    let mut tone =
        ToneParameters { white: 1.0, offset: 0.0, gain: 1.0, constants: params.constants };
    match curve {
        CURVE_NONE => {}
        CURVE_LINEAR => tone.white = (of.mean / params.theta).max(1e-12),
        CURVE_P80 => tone.white = 1.0 / bounded_gain(of.p80),
        CURVE_LUM_PRESERVE => tone.gain = bounded_gain(of.mean_luminance + 1e-6),
        CURVE_PER_CHANNEL => {
            for channel in 0..3 {
                tone.constants[channel] = (of.channel_means[channel] + 1e-6) / params.theta;
            }
        }
        _ => {
            let crushed = 1.0 - (of.p10 / of.p90).clamp(0.0, 1.0);
            tone.white = of.p90;
            tone.offset = params.alpha;
            if params.beta > 0.0 {
                tone.offset *= crushed.power(params.beta);
            }
            tone.gain = params.least_gain + params.gain_c * of.mean_luminance;
        }
    }
    tone
}
