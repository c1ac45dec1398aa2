//! Planes of a render to the pixels of a host's image, in f64.

use half::f16;

use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_pixels::{
    Constants, Kernel, LARGEST_FLOAT, LARGEST_HALF, LARGEST_OF_10, LARGEST_OF_11, LEAST_NORMAL,
    NOTHING_SEEN, PQ_C1, PQ_C2, PQ_C3, PQ_M1, PQ_M2, PQ_NITS, Params, Slices, Tolerances,
};
use crate::kernels::pixels::{
    LIGHT_DISPLAY, LIGHT_HDR10, LIGHT_SRGB, STORED_FLOATS, STORED_HALVES, STORED_SMALL_FLOATS,
    STORED_TENS,
};

type Pixel = [f64; 4];

/// The rows of BT.2087: from the primaries of BT.709 to those of BT.2020.
const PRIMARIES: [[f64; 3]; 3] = [
    [0.627403896, 0.329283038, 0.043313066],
    [0.069097289, 0.919540395, 0.011362316],
    [0.016391439, 0.088013308, 0.895595253],
];

/// The light of a display-referred value: the sRGB curve of IEC 61966-2-1.
pub fn eotf(c: f64) -> f64 {
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

fn inverse_eotf(c: f64) -> f64 {
    if c <= 0.0031308 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

/// The light of a code of ST 2084, where 1 is `nits`.
pub fn pq_eotf(code: f64, nits: f64) -> f64 {
    let p = code.powf(1.0 / PQ_M2);
    PQ_NITS / nits * ((p - PQ_C1).max(0.0) / (PQ_C2 - PQ_C3 * p)).powf(1.0 / PQ_M1)
}

fn inverse_pq_eotf(c: f64, nits: f64) -> f64 {
    let p = (c * nits / PQ_NITS).clamp(0.0, 1.0).powf(PQ_M1);
    ((PQ_C1 + PQ_C2 * p) / (1.0 + PQ_C3 * p)).powf(PQ_M2)
}

fn is_linear(params: &Params) -> bool {
    params.light != LIGHT_DISPLAY
}

fn encoded(params: &Params, color: f64) -> f64 {
    let color = color.max(0.0);
    if is_linear(params) { eotf(color) * f64::from(params.exposure) } else { color }
}

/// A NaN is 0, and nothing is beyond `largest`.
fn bounded(x: f64, largest: f64) -> f64 {
    if x.is_nan() { 0.0 } else { x.clamp(-largest, largest) }
}

/// The nearest float without sign, of 5 bits of exponent and `mantissa` bits; a tie is even.
fn small_float(x: f64, mantissa: i32, largest: f64) -> u32 {
    let x = x.clamp(0.0, largest);
    let exponent = (x.max(LEAST_NORMAL).to_bits() >> 52) as i32 - 1023;
    let steps = (x * 2f64.powi(mantissa - exponent)).round_ties_even();
    (((exponent + 14) as u32) << mantissa) + steps as u32
}

/// A half has the same exponents.
fn of_small_float(bits: u32, mantissa: u32) -> f64 {
    f16::from_bits((bits << (10 - mantissa)) as u16).to_f64()
}

/// Red and blue in the other's place where blue comes first.
fn swapped<T: Copy>(params: &Params, [r, g, b, a]: [T; 4]) -> [T; 4] {
    if params.swaps != 0 { [b, g, r, a] } else { [r, g, b, a] }
}

/// Bits of red, green, blue and alpha from the lowest on.
fn widths(params: &Params) -> &'static [u32] {
    match params.storage {
        STORED_TENS => &[10, 10, 10, 2],
        STORED_SMALL_FLOATS => &[11, 11, 10],
        _ => &[8; 4],
    }
}

/// The fields of a word from the lowest bit on, of these widths.
fn fields(word: u32, widths: &[u32]) -> [u32; 4] {
    let (mut all, mut shift) = ([0; 4], 0);
    for (field, width) in all.iter_mut().zip(widths) {
        *field = word >> shift & ((1 << width) - 1);
        shift += width;
    }
    all
}

/// The word of these fields.
fn word(all: [u32; 4], widths: &[u32]) -> u32 {
    let places =
        widths.iter().scan(0, |shift, width| Some(std::mem::replace(shift, *shift + width)));
    all.into_iter().zip(places).map(|(field, shift)| field << shift).sum()
}

fn load(params: &Params, under: &[u32], at: usize) -> Pixel {
    match params.storage {
        STORED_HALVES => {
            let halves = [under[2 * at], under[2 * at + 1]].map(|word| {
                [word as u16, (word >> 16) as u16].map(|bits| f16::from_bits(bits).to_f64())
            });
            let [[r, g], [b, a]] = halves;
            [r, g, b, a]
        }
        STORED_FLOATS => [0, 1, 2, 3].map(|c| f32::from_bits(under[4 * at + c]).into()),
        STORED_SMALL_FLOATS => {
            let [r, g, b, _] = fields(under[at], widths(params));
            [of_small_float(r, 6), of_small_float(g, 6), of_small_float(b, 5), 1.0]
        }
        _ => {
            let widths = widths(params);
            let fields = fields(under[at], widths);
            let most = |at: usize| f64::from((1u32 << widths[at]) - 1);
            let codes = [0, 1, 2, 3].map(|at| f64::from(fields[at]) / most(at));
            let [r, g, b, a] = swapped(params, codes);
            let light = |code: f64| match params.light {
                LIGHT_SRGB => eotf(code),
                LIGHT_HDR10 => pq_eotf(code, params.nits.into()),
                _ => code,
            };
            [light(r), light(g), light(b), a]
        }
    }
}

fn store(params: &Params, pixels: &mut [u32], at: usize, pixel: Pixel) {
    let pixel = pixel.map(|x| bounded(x, LARGEST_FLOAT));
    let [r, g, b, a] = pixel;
    match params.storage {
        STORED_HALVES => {
            let half = |x: f64| u32::from(f16::from_f64(bounded(x, LARGEST_HALF)).to_bits());
            pixels[2 * at] = half(r) | half(g) << 16;
            pixels[2 * at + 1] = half(b) | half(a) << 16;
        }
        STORED_FLOATS => {
            for (word, value) in pixels[4 * at..].iter_mut().zip(pixel) {
                *word = (value as f32).to_bits();
            }
        }
        STORED_SMALL_FLOATS => {
            let of_11 = |x: f64| small_float(x, 6, LARGEST_OF_11);
            let blue = small_float(b, 5, LARGEST_OF_10);
            pixels[at] = word([of_11(r), of_11(g), blue, 0], widths(params));
        }
        _ => {
            let code = |x: f64| match params.light {
                LIGHT_SRGB => inverse_eotf(x.min(1.0)),
                LIGHT_HDR10 => inverse_pq_eotf(x, params.nits.into()),
                _ => x,
            };
            let codes = swapped(params, [code(r), code(g), code(b), a]);
            let widths = widths(params);
            let most = |at: usize| f64::from((1u32 << widths[at]) - 1);
            let fields =
                [0, 1, 2, 3].map(|at| (codes[at].clamp(0.0, 1.0) * most(at)).round() as u32);
            pixels[at] = word(fields, widths);
        }
    }
}

/// A depth in the view as the image has it.
fn stored_depth(params: &Params, depth: f64, scene: &[u32], at: usize) -> f32 {
    let is_seen = depth < NOTHING_SEEN;
    match (is_seen, params.is_linear_depth != 0) {
        (false, _) if params.has_scene != 0 => return f32::from_bits(scene[at]),
        (false, true) => return f32::INFINITY,
        (true, true) => return depth as f32,
        (_, false) => {}
    }
    let (near, far) = (f64::from(params.near), f64::from(params.far));
    let e = match (params.is_orthographic != 0, far > 0.0) {
        (true, _) => (far - depth) / (far - near),
        (false, true) => near / depth * (far - depth) / (far - near),
        (false, false) => near / depth,
    };
    let e = if is_seen { e.clamp(0.0, 1.0) } else { 0.0 };
    (if params.is_reversed != 0 { e } else { 1.0 - e }) as f32
}

/// The pixel before it is stored.
fn composed(params: &Params, slices: &Slices<'_>, at: usize) -> Pixel {
    let count = params.pixel_count as usize;
    let transmittance = f64::from(slices.transmittances[at]);
    let alpha = 1.0 - transmittance;
    let is_over = params.is_over != 0;
    let mut light: [f64; 3] = std::array::from_fn(|c| {
        let color = f64::from(slices.render[c * count + at]);
        let seen = match is_linear(params) && alpha > 0.0 {
            true => encoded(params, color / alpha) * alpha,
            false => color.max(0.0),
        };
        let background = if is_over { 0.0 } else { f64::from(params.background[c]) };
        seen + transmittance * background
    });
    if params.light == LIGHT_HDR10 {
        light = PRIMARIES.map(|row| row.iter().zip(light).map(|(part, c)| part * c).sum());
    }
    let [r, g, b] = light;
    let mut pixel = [r, g, b, alpha];
    if is_over {
        let under = load(params, slices.under, at);
        for (channel, below) in pixel.iter_mut().zip(under) {
            *channel += transmittance * below;
        }
    }
    pixel
}

/// The depth in the view.
fn view_depth(params: &Params, slices: &Slices<'_>, at: usize) -> f64 {
    let alpha = 1.0 - f64::from(slices.transmittances[at]);
    let plane = (params.depth_plane * params.pixel_count) as usize;
    let depth = f64::from(slices.render[plane + at]);
    match params.is_mean != 0 {
        true if alpha > 0.0 => depth / alpha,
        true => NOTHING_SEEN,
        false => depth,
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        for at in 0..params.pixel_count as usize {
            if params.depth_plane != 0 {
                let depth = view_depth(params, &slices, at);
                slices.depths[at] = stored_depth(params, depth, slices.scene, at);
            }
            if params.has_color != 0 {
                let pixel = composed(params, &slices, at);
                store(params, slices.pixels, at, pixel);
            }
        }
    }

    /// A channel takes a power, which doubles the roundings of what it is a power of, and those of `log2` and `exp2`. A
    /// depth that is stored as a part of 1 loses what the other part has.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let unit = f64::from(f32::EPSILON);
        let float = |at: usize| 64.0 * unit * composed(params, &slices, at / 4)[at % 4].abs();
        let count = params.pixel_count as usize;
        let pixels = match params.storage {
            STORED_HALVES => Tolerance::Halves,
            STORED_FLOATS if params.has_color != 0 => {
                Tolerance::Floats((0..4 * count).map(float).collect())
            }
            _ => Tolerance::Fields(widths(params)),
        };
        let depths = match params.is_linear_depth != 0 {
            true => Tolerance::Roundings(8.0),
            false => Tolerance::Each(vec![8.0 * unit; count]),
        };
        Tolerances { pixels, depths }
    }
}
