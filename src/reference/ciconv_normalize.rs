use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference};
use crate::kernels::ciconv_normalize::{Constants, Kernel, Params, Slices, Tolerances};

/// The structure at every pixel.
fn structure(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let [mean, scale] = slices.norm[0].to_array().map(Rounded::exact);
    let normalised = |&log: &f32| {
        let x = (Rounded::exact(log) - mean) * scale;
        x.at_least(Rounded::from_f64(0.0)).at_most(Rounded::from_f64(1.0))
    };
    [slices.logs[..params.pixel_count as usize].iter().map(normalised).collect()]
}

bounded_reference!(structure: structure);
