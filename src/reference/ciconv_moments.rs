use glam::Vec2;
use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::ciconv_moments::{Constants, EPSILON, Kernel, Params, Slices, Tolerances};

/// Mean and 1 / standard deviation, from the moments of the workgroups.
fn norm(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let moments = slices.moments;
    let (pixels, size) = (params.pixel_count as usize, params.pixels_per_moment as usize);
    let workgroups = pixels.div_ceil(size);
    let chain = chain(workgroups);
    let parts = || {
        let all = moments.iter().take(workgroups).enumerate();
        all.map(|(i, of)| (Rounded::from_f64(size.min(pixels - i * size) as f64), of))
    };
    let pivot = Rounded::exact(moments[0].x);
    let from_pivot = |of: &Vec2| Rounded::exact(of.x) - pivot;
    let all = Rounded::from_f64(pixels as f64);
    let shift = Rounded::sum(chain, parts().map(|(count, of)| count * from_pivot(of))) / all;
    let squares = parts().map(|(count, of)| {
        let deviation = from_pivot(of) - shift;
        Rounded::exact(of.y) + count * deviation * deviation
    });
    let variance = Rounded::sum(chain, squares) / all;
    [vec![pivot + shift, Rounded::from_f64(1.0) / (variance + Rounded::from_f64(EPSILON)).sqrt()]]
}

bounded_reference!(norm: norm);
