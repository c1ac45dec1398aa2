use crate::gpu::Reference;
use crate::kernels::depth_limits::{Constants, Kernel, NO_DEPTH, Params, Slices, Tolerances};
use crate::kernels::pixels::{DEPTH_16, DEPTH_24};

/// The number of a depth image, in single precision as the device has it.
fn stored_depth(params: &Params, words: &[u32], at: usize) -> f32 {
    match params.format {
        DEPTH_16 => (words[at / 2] >> (16 * (at % 2)) & 0xffff) as f32 / 65_535.0,
        DEPTH_24 => (words[at] & 0x00ff_ffff) as f32 / 16_777_215.0,
        _ => f32::from_bits(words[at]),
    }
}

/// 1 at the near plane, 0 at the far one.
fn nearness(params: &Params, depth: f32) -> f64 {
    f64::from(if params.is_reversed != 0 { depth } else { 1.0 - depth })
}

/// The depth in the view of this nearness.
fn view_depth(params: &Params, nearness: f64) -> f64 {
    let (near, far) = (f64::from(params.near), f64::from(params.far));
    if params.is_orthographic != 0 {
        return far - nearness * (far - near);
    }
    if far > 0.0 { near * far / (near + nearness * (far - near)) } else { near / nearness }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        for at in 0..params.pixel_count as usize {
            let depth = stored_depth(params, slices.words, at);
            let e = nearness(params, depth);
            slices.limits[at] = match (params.is_linear != 0, e > 0.0) {
                (true, _) => depth,
                (false, true) => view_depth(params, e) as f32,
                (false, false) => NO_DEPTH as f32,
            };
        }
    }

    /// A quotient by 65535 or 2^24 - 1 may be off by a few roundings, which count most where e is small.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        if params.is_linear != 0 {
            return Tolerances::default();
        }
        let is_float = params.format != DEPTH_16 && params.format != DEPTH_24;
        let unit = f64::from(f32::EPSILON);
        let bound = |at: usize| {
            let depth = stored_depth(params, slices.words, at);
            let e = nearness(params, depth);
            let error = if is_float { 0.0 } else { 4.0 * unit * f64::from(depth) };
            if e <= 0.0 || e.is_nan() {
                return if error > 0.0 && e > -error { f64::INFINITY } else { 0.0 };
            }
            if error >= e {
                return f64::INFINITY;
            }
            let z = |e: f64| view_depth(params, e);
            let size = z(e).abs().max(f64::from(params.far) * f64::from(params.is_orthographic));
            (z(e - error) - z(e + error)).abs() + 12.0 * unit * size
        };
        Tolerances { limits: (0..params.pixel_count as usize).map(bound).collect() }
    }
}
