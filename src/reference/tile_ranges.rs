use glam::UVec2;

use crate::gpu::Reference;
use crate::kernels::status::STATUS_CROWDED;
use crate::kernels::tile_ranges::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { counts, sorted_tiles, tile_ranges, status } = slices;
        let mut first = 0;
        for tile in 0..params.tile_count {
            let rest = &sorted_tiles[first..counts[0] as usize];
            let run = rest.iter().take_while(|&&other| other == tile).count();
            tile_ranges[tile as usize] = UVec2::new(first as u32, (first + run) as u32);
            if run as u32 > params.longest_run {
                tile_ranges[tile as usize].y = first as u32;
                status[0] |= STATUS_CROWDED;
                status[2] = status[2].max(run as u32);
            }
            first += run;
        }
    }
}
