use glam::{DAffine3, DMat3, DVec2, DVec3};
use half::f16;

use crate::gpu::{Reference, Tolerance};
use crate::kernels::motion_vectors::{
    Constants, Kernel, NO_SPLAT, NOTHING_SEEN, Params, Slices, Tolerances,
};
use crate::kernels::pixels::STORED_HALVES;

/// The transform of the points of a pixel.
fn before_from_now(slices: &Slices<'_>, mover: usize) -> DAffine3 {
    let columns = slices.movers[mover].before_from_now;
    let [x, y, z, translation] = columns.map(|column| DVec3::from(column.map(f64::from)));
    DAffine3 { matrix3: DMat3::from_cols(x, y, z), translation }
}

/// The motion of a pixel, and the bound of its rounding: that of the point, over its depth before.
fn motion(params: &Params, slices: &Slices<'_>, at: usize) -> (DVec2, f64) {
    let width = params.size.x as usize;
    let pixels = width * params.size.y as usize;
    let alpha = 1.0 - f64::from(slices.transmittances[at]);
    let plane = f64::from(slices.render[params.depth_plane as usize * pixels + at]);
    let depth = match params.is_mean != 0 {
        true if alpha > 0.0 => plane / alpha,
        true => NOTHING_SEEN,
        false => plane,
    };
    let is_seen = depth < NOTHING_SEEN;
    let splat = if params.mover_count > 1 { slices.picks[2 * at] } else { NO_SPLAT };
    let movers = &slices.movers[1..params.mover_count as usize];
    let mover = match is_seen && splat != NO_SPLAT {
        true => movers.iter().take_while(|mover| mover.first <= splat).count(),
        false => 0,
    };
    let pixel = DVec2::new((at % width) as f64, (at / width) as f64) + 0.5;
    let slope = (pixel - params.principal_point.as_dvec2()) / params.focal.as_dvec2();
    let moved = before_from_now(slices, mover);
    let is_orthographic = params.is_orthographic != 0;
    let (point, before) = match (is_orthographic, is_seen) {
        (true, _) => {
            let point = slope.extend(if is_seen { depth } else { 0.0 });
            (point, moved.transform_point3(point))
        }
        (false, true) => {
            let point = slope.extend(1.0) * depth;
            (point, moved.transform_point3(point))
        }
        (false, false) => (slope.extend(1.0), moved.transform_vector3(slope.extend(1.0))),
    };
    let scale = if is_orthographic { 1.0 } else { before.z };
    if scale <= 0.0 {
        return (DVec2::ZERO, 0.0);
    }
    let focal = params.focal_before.as_dvec2();
    let seen = focal * before.truncate() / scale + params.principal_point_before.as_dvec2();
    // Lengths before the terms of a product cancel.
    let lengths = point.length() * moved.matrix3.x_axis.length() + moved.translation.length();
    let tilted = 1.0 + before.truncate().length() / scale;
    let error = focal.max_element() * tilted * lengths / scale + pixel.length() + seen.length();
    (seen - pixel, error)
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, mut slices: Slices<'_>) {
        let pixels = std::mem::take(&mut slices.pixels);
        for at in 0..params.size.element_product() as usize {
            let (motion, _) = motion(params, &slices, at);
            if params.storage == STORED_HALVES {
                let half = |x: f64| u32::from(f16::from_f64(x.clamp(-65504.0, 65504.0)).to_bits());
                pixels[at] = half(motion.x) | half(motion.y) << 16;
            } else {
                pixels[2 * at] = (motion.x as f32).to_bits();
                pixels[2 * at + 1] = (motion.y as f32).to_bits();
            }
        }
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let unit = f64::from(f32::EPSILON);
        let bounds: Vec<f64> = (0..params.size.element_product() as usize)
            .map(|at| 16.0 * unit * motion(params, &slices, at).1)
            .collect();
        let value = |bits: u16| f16::from_bits(bits).to_f64();
        let pixels = if params.storage == STORED_HALVES {
            let rounded = |at: usize| {
                let (motion, _) = motion(params, &slices, at);
                motion.to_array().map(|x| bounds[at] + x.abs() / 1024.0 + 1e-7)
            };
            let pairs = (0..bounds.len()).map(rounded).collect();
            Tolerance::Packed { numbers: vec![], format: value, pairs }
        } else {
            Tolerance::Floats(bounds.iter().flat_map(|&bound| [bound; 2]).collect())
        };
        Tolerances { pixels }
    }
}
