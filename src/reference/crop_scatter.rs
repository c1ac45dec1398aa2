use super::crop_gather::places;
use crate::gpu::Reference;
use crate::kernels::crop_scatter::{Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Self::Constants, Slices { content, image }: Slices<'_>) {
        let &Params { size, origin, crop, first_plane, plane_count } = params;
        let places = places(size, origin, crop, first_plane..first_plane + plane_count);
        content.iter().zip(places).for_each(|(value, at)| image[at] += value);
    }
}
