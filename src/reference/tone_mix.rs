use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::ToneParameters;
use crate::kernels::curves::{CURVE_AUTO, CURVE_LUM_PRESERVE};
use crate::kernels::tone_mix::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::{Real, measurable};

/// The pixel's channels under the curve.
fn mixed(curve: u32, rgb: [f32; 3], tone: &ToneParameters) -> [Rounded; 3] {
    let rgb = rgb.map(|x| Rounded::exact(measurable(x)));
    let [white, offset, gain] = [tone.white, tone.offset, tone.gain].map(Rounded::exact);
    let (one, of) = (Rounded::of(1.0), Rounded::of);
    let y = of(0.299) * rgb[0] + of(0.587) * rgb[1] + of(0.114) * rgb[2];
    let channel = |channel: usize| match curve {
        CURVE_AUTO => {
            let (t, y) = (rgb[channel] / white, (y / white).at_least(of(1e-20)));
            let share = Rounded::exact(tone.constants[0]);
            let kept = t * (y.one_minus_exp() / y);
            offset + (one - offset) * ((one - share) * t.one_minus_exp() + share * kept)
        }
        CURVE_LUM_PRESERVE => rgb[channel] * (y * gain / (y + of(1e-6))),
        _ => rgb[channel] * (one / Rounded::exact(tone.constants[channel])),
    };
    [0, 1, 2].map(channel).map(|mapped| mapped.at_least(of(0.0)).at_most(one))
}

/// Planar, as the target.
fn mapped(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
    let n = params.pixel_count as usize;
    let tone = &slices.parameters[params.view as usize];
    let pixel = |i: usize| {
        let rgb = [0, 1, 2].map(|channel| slices.image[channel * n + i]);
        mixed(constants.tone_curve, rgb, tone)
    };
    let pixels: Vec<_> = (0..n).map(pixel).collect();
    (0..3).flat_map(|channel| pixels.iter().map(move |mixed| mixed[channel])).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let mapped = values(mapped(params, constants, &slices));
        slices.target.iter_mut().zip(mapped).for_each(|(to, y)| *to = y);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { target: mapped(params, constants, &slices).into_iter().collect() }
    }
}
