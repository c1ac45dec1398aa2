use super::random::random_bits;
use crate::gpu::Reference;
use crate::kernels::depth_boxes::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { regions }: Slices<'_>) {
        let Params { size, side, box_count, key } = *params;
        let draw = |at: u32, range: u32| {
            ((u64::from(random_bits(key.wrapping_add(at))) * u64::from(range)) >> 32) as u32
        };
        regions[0] = [0, 0, size.x, size.y];
        for i in 1..=box_count {
            let corner = [draw(2 * i, size.x - side), draw(2 * i + 1, size.y - side)];
            regions[i as usize] = [corner[0], corner[1], side, side];
        }
    }
}
