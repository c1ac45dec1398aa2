//! The render kernels against their references.

use glam::UVec2;
use nightsplat::gpu::testing::{assert_no_validation_messages, gpu};
use nightsplat::gpu::{Reference, Threads};
use nightsplat::kernels::tile_ranges;

#[test]
fn tile_ranges_matches_the_reference() {
    let gpu = gpu();
    let pipeline = gpu.pipeline::<tile_ranges::Kernel>(&tile_ranges::Constants::default()).unwrap();
    for tiles in [
        vec![],
        vec![3],
        vec![0, 0, 2, 2, 2, 5],
        (0..1000).map(|i| i / 7).collect(),
        (0..257u32).map(|i| i / 100 * 40).collect(),
    ] {
        let tile_count = 120;
        let params = tile_ranges::Params { tile_count };
        let mut expected = vec![UVec2::ZERO; tile_count as usize];
        let counts = [tiles.len() as u32];
        tile_ranges::Kernel::run(
            &params,
            &tile_ranges::Constants::default(),
            tile_ranges::Slices {
                counts: &counts,
                sorted_tiles: &tiles,
                tile_ranges: &mut expected,
            },
        );
        let counts = gpu.buffer("counts", &counts).unwrap();
        let sorted_tiles = gpu.buffer("sorted_tiles", &tiles).unwrap();
        let mut ranges = gpu.zeros::<UVec2>("tile_ranges", tile_count as usize).unwrap();
        gpu.run("tile_ranges", |pass| {
            pass.dispatch(
                &pipeline,
                &params,
                tile_ranges::Buffers {
                    counts: &counts,
                    sorted_tiles: &sorted_tiles,
                    tile_ranges: &mut ranges,
                },
                Threads::Exactly([tiles.len() as u32, 1, 1]),
            )
        })
        .unwrap();
        assert_eq!(gpu.read(&ranges).unwrap(), expected);
    }
    assert_no_validation_messages();
}
