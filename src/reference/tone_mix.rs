use crate::gpu::{Reference, Tolerance};
use crate::kernels::curves::CURVE_LUM_PRESERVE;
use crate::kernels::tone_mix::{Constants, Kernel, Params, Slices, Tolerances};
use crate::tone::{clamped, luminance, measurable};

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { image, parameters, target }: Slices<'_>,
    ) {
        let (n, tone) = (params.pixel_count as usize, &parameters[params.view as usize]);
        for i in 0..n {
            let rgb = [0, 1, 2].map(|channel| measurable(image[channel * n + i]));
            let y = luminance(rgb);
            for channel in 0..3 {
                let scale = if constants.tone_curve == CURVE_LUM_PRESERVE {
                    y * tone.gain / (y + 1e-6)
                } else {
                    1.0 / tone.constants[channel]
                };
                target[channel * n + i] = clamped(rgb[channel] * scale);
            }
        }
    }

    /// Luminance five roundings, the scale a product, a sum and a division of five, then a product; the reference as many.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { target: Tolerance::Roundings(30.0) }
    }
}
