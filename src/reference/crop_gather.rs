use glam::UVec2;

use crate::gpu::Reference;
use crate::kernels::crop_gather::{Kernel, Params, Slices};

/// The index in the image of each value of a padded crop, in the crop's order.
pub(super) fn indices(
    size: UVec2,
    origin: UVec2,
    crop: UVec2,
    planes: std::ops::Range<u32>,
) -> impl Iterator<Item = usize> {
    let rows = planes.flat_map(move |plane| (0..crop.y).map(move |y| (plane, y)));
    rows.flat_map(move |(plane, y)| {
        let row = (plane as usize * size.y as usize + (origin.y + y) as usize) * size.x as usize;
        (0..crop.x).map(move |x| row + (origin.x + x) as usize)
    })
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Self::Constants, Slices { image, content }: Slices<'_>) {
        let &Params { size, origin, crop, first_plane, plane_count } = params;
        let indices = indices(size, origin, crop, first_plane..first_plane + plane_count);
        content.iter_mut().zip(indices).for_each(|(value, at)| *value = image[at]);
    }
}
