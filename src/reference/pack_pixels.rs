//! Planes of a render to the pixels of a host's image, in f64.

use half::f16;

use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_pixels::{
    Constants, Kernel, LARGEST_HALF, NOTHING_SEEN, Params, Slices, Tolerances,
};
use crate::kernels::pixels::{PIXELS_DISPLAY_HALF, PIXELS_LINEAR_HALF, PIXELS_SRGB};

type Pixel = [f64; 4];

/// The light of a display-referred value: the sRGB curve of IEC 61966-2-1.
pub fn eotf(c: f64) -> f64 {
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

fn inverse_eotf(c: f64) -> f64 {
    if c <= 0.0031308 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

fn is_half(params: &Params) -> bool {
    params.encoding <= PIXELS_DISPLAY_HALF
}

fn is_linear(params: &Params) -> bool {
    params.encoding == PIXELS_LINEAR_HALF || params.encoding == PIXELS_SRGB
}

fn encoded(params: &Params, color: f64) -> f64 {
    let color = color.max(0.0);
    if is_linear(params) { eotf(color) * f64::from(params.exposure) } else { color }
}

/// Red and blue in the other's place where blue comes first.
fn swapped<T: Copy>(params: &Params, [r, g, b, a]: [T; 4]) -> [T; 4] {
    if params.swaps != 0 { [b, g, r, a] } else { [r, g, b, a] }
}

fn load(params: &Params, under: &[u32], at: usize) -> Pixel {
    if is_half(params) {
        let halves = [under[2 * at], under[2 * at + 1]].map(|word| {
            [word as u16, (word >> 16) as u16].map(|bits| f16::from_bits(bits).to_f64())
        });
        let [[r, g], [b, a]] = halves;
        return [r, g, b, a];
    }
    let [r, g, b, a] = swapped(params, under[at].to_le_bytes().map(|byte| f64::from(byte) / 255.0));
    match params.encoding {
        PIXELS_SRGB => [eotf(r), eotf(g), eotf(b), a],
        _ => [r, g, b, a],
    }
}

fn store(params: &Params, pixels: &mut [u32], at: usize, [r, g, b, a]: Pixel) {
    if is_half(params) {
        let half = |x: f64| u32::from(f16::from_f64(x.min(LARGEST_HALF)).to_bits());
        pixels[2 * at] = half(r) | half(g) << 16;
        pixels[2 * at + 1] = half(b) | half(a) << 16;
        return;
    }
    let srgb = |x: f64| if params.encoding == PIXELS_SRGB { inverse_eotf(x.min(1.0)) } else { x };
    let bytes = swapped(params, [srgb(r), srgb(g), srgb(b), a]);
    let bytes = bytes.map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8);
    pixels[at] = u32::from_le_bytes(bytes);
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { render, transmittances, under, pixels, depths } = slices;
        let count = params.pixel_count as usize;
        for at in 0..count {
            let transmittance = f64::from(transmittances[at]);
            let alpha = 1.0 - transmittance;
            if params.depth_plane != 0 {
                let depth = f64::from(render[params.depth_plane as usize * count + at]);
                let depth = match params.is_mean != 0 {
                    true if alpha > 0.0 => depth / alpha,
                    true => NOTHING_SEEN,
                    false => depth,
                };
                depths[at] = if depth >= NOTHING_SEEN { f32::INFINITY } else { depth as f32 };
            }
            if params.has_color == 0 {
                continue;
            }
            let color = [0, 1, 2].map(|c| f64::from(render[c * count + at]));
            let background = params.background.to_array().map(f64::from);
            let under = if params.is_over != 0 { load(params, under, at) } else { [0.0; 4] };
            let mut pixel = [0.0, 0.0, 0.0, alpha + transmittance * under[3]];
            for c in 0..3 {
                let seen = match is_linear(params) && alpha > 0.0 {
                    true => encoded(params, color[c] / alpha) * alpha,
                    false => color[c].max(0.0),
                };
                let backdrop = match params.is_over != 0 {
                    true => under[c],
                    false => encoded(params, background[c]),
                };
                pixel[c] = seen + transmittance * backdrop;
            }
            store(params, pixels, at, pixel);
        }
    }

    fn tolerances(params: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances {
            pixels: if is_half(params) { Tolerance::Halves } else { Tolerance::Bytes },
            depths: Tolerance::Roundings(8.0),
        }
    }
}
