use nightsplat_photographs::tone::{Real, bounded, profiled, shoulder, table_at, toe};

use super::rounding::{Rounded, rounded_tone_curve};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ToneParameters;
use crate::kernels::curves::{
    CURVE_AUTO, CURVE_LUM_PRESERVE, CURVE_PER_CHANNEL, CURVE_PROFILE, CURVE_TABLE,
};
use crate::kernels::pseudo_gt::{Constants, Kernel, Params, Slices, Tolerances};

/// The largest value that a curve of several channels takes.
const LARGEST: f32 = 65504.0;

/// The stored code of a value.
fn stored(code_bits: u32, slices: &Slices<'_>, i: usize) -> f32 {
    if code_bits == 32 {
        return slices.values[i];
    }
    let per_word = 32 / code_bits as usize;
    let shift = code_bits as usize * (i % per_word);
    let code = slices.codes[i / per_word] >> shift & ((1 << code_bits) - 1);
    slices.values[code as usize]
}

/// The curves whose channels depend on more than their own value.
fn mixed(curve: u32, rgb: [f32; 3], tone: &ToneParameters) -> [Rounded; 3] {
    let rgb = rgb.map(|x| Rounded::exact(bounded(x, LARGEST)));
    let [white, offset, gain] = [tone.white, tone.offset, tone.gain].map(Rounded::exact);
    let (one, of) = (Rounded::from_f64(1.0), Rounded::from_f64);
    let y = (of(0.299) * rgb[0] + of(0.587) * rgb[1] + of(0.114) * rgb[2]).abs();
    let channel = |channel: usize| match curve {
        CURVE_AUTO => {
            let (t, y) = (rgb[channel] / white, (y / white).at_least(of(1e-20)));
            let [share, bend, end, weight] =
                [0, 1, 2, 3].map(|at| Rounded::exact(tone.constants[at]));
            let kept = t * (shoulder(y, bend) / y);
            let size = shoulder(t.abs(), bend);
            let size = if t.value < 0.0 { -size } else { size };
            let soft = (one - share) * size + share * kept;
            toe(offset + (one - offset) * soft, offset, [end, weight])
        }
        CURVE_LUM_PRESERVE => rgb[channel] * (y * gain / (y + of(1e-6))),
        _ => rgb[channel] * (one / Rounded::exact(tone.constants[channel])),
    };
    [0, 1, 2].map(channel).map(|mixed| mixed.at_least(-one).at_most(one))
}

/// A value on its channel's knots, three numbers each.
fn tabled(knots: &[Rounded], count: usize, channel: usize, x: Rounded) -> Rounded {
    let (knots, _) = knots.as_chunks::<3>();
    table_at(&knots[channel * count..][..count], x)
}

/// A pixel under the whole curve.
fn mapped(
    (params, constants): (&Params, &Constants),
    rgb: [f32; 3],
    tone: &ToneParameters,
    numbers: &[Rounded],
) -> [Rounded; 3] {
    let white = Rounded::exact(tone.white);
    match constants.tone_curve {
        CURVE_AUTO | CURVE_LUM_PRESERVE | CURVE_PER_CHANNEL => {
            mixed(constants.tone_curve, rgb, tone)
        }
        CURVE_TABLE => [0, 1, 2].map(|channel| {
            let x = Rounded::exact(rgb[channel]) / white;
            tabled(numbers, params.knot_count as usize, channel, x)
        }),
        CURVE_PROFILE => {
            profiled(rgb.map(|x| Rounded::exact(bounded(x, LARGEST)) / white), numbers)
        }
        curve => rgb.map(|x| rounded_tone_curve(curve, x, tone)),
    }
}

/// Planar, as the target.
fn targets(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
    let n = params.pixel_count as usize;
    let numbers: Vec<Rounded> = slices.numbers.iter().map(|&x| Rounded::exact(x)).collect();
    let tone = slices.parameters[params.view as usize];
    let pixel = |i: usize| {
        let rgb = [0, 1, 2].map(|c| stored(constants.code_bits, slices, c * n + i));
        let curved = mapped((params, constants), rgb, &tone, &numbers);
        [0, 1, 2].map(|channel| {
            let plain = Rounded::exact(bounded(rgb[channel], 1.0));
            let weight = Rounded::exact(tone.weight);
            let part = plain + weight * (curved[channel] - plain);
            if tone.weight < 1.0 { part } else { curved[channel] }
        })
    };
    let pixels: Vec<_> = (0..n).map(pixel).collect();
    (0..3).flat_map(|channel| pixels.iter().map(move |pixel| pixel[channel])).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let decoded = |i: usize| stored(constants.code_bits, &slices, i);
        let target: Vec<f32> = match constants.with_curve {
            true => targets(params, constants, &slices).iter().map(|y| y.value as f32).collect(),
            false => (0..3 * params.pixel_count as usize).map(decoded).collect(),
        };
        slices.target[..target.len()].copy_from_slice(&target);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let target = match constants.with_curve {
            true => targets(params, constants, &slices).into_iter().collect(),
            false => Tolerance::Exact,
        };
        Tolerances { target }
    }
}
