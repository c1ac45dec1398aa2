//! The kernel that measures what a device can do at most.

use nightsplat::gpu::Threads;
use nightsplat::kernels::ceiling;

#[test]
fn the_ceilings_are_of_operations_that_the_device_does() {
    for vector_count in [0, 1, 255, 256, 1000] {
        let source: Vec<f32> = (0..4 * vector_count.max(1)).map(|i| i as f32 - 7.0).collect();
        for operation in 0..=2 {
            for turns in [0, 3] {
                let target = vec![-1.0f32; source.len()];
                let params = ceiling::Params { vector_count, turns, factor: 0.5, lane_bits: 1 };
                let constants = ceiling::Constants { operation };
                let threads = Threads::Exactly([vector_count, 1, 1]);
                run_kernel!(ceiling, constants, params, threads, [source], [target]);
            }
        }
    }
}
