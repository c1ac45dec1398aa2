use super::crop_gather::indices;
use crate::gpu::Reference;
use crate::kernels::crop_scatter::{Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Self::Constants, Slices { content, image }: Slices<'_>) {
        let &Params { size, origin, crop, first_plane, plane_count } = params;
        let indices = indices(size, origin, crop, first_plane..first_plane + plane_count);
        content.iter().zip(indices).for_each(|(value, at)| image[at] += value);
    }
}
