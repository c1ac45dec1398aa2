use super::rounding::Rounded;
use crate::gpu::Reference;
use crate::kernels::ciconv_normalize::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::Real;

/// The structure at every pixel.
fn structure(params: &Params, slices: &Slices<'_>) -> impl Iterator<Item = Rounded> {
    let [mean, scale] = slices.norm[0].to_array().map(Rounded::exact);
    let logs = slices.logs[..params.pixel_count as usize].iter();
    let normalised = logs.map(move |&log| (Rounded::exact(log) - mean) * scale);
    normalised.map(|x| x.at_least(Rounded::of(0.0)).at_most(Rounded::of(1.0)))
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let structure: Vec<Rounded> = structure(params, &slices).collect();
        slices.structure.iter_mut().zip(structure).for_each(|(s, of)| *s = of.value as f32);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { structure: structure(params, &slices).collect() }
    }
}
