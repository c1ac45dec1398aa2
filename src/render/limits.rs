//! How far kernels get on a device that ends loops after so many turns.

use crate::gpu::{Gpu, Properties};

/// How many splats the blending kernels take in one turn of their inner loop. A device that ends loops after so many turns
/// follows a hundred thousand splats on a tile with two; one and four were measured slower there.
pub(super) fn splats_per_turn(gpu: &Gpu) -> u32 {
    if gpu.properties().max_loop_iterations < u32::MAX { 2 } else { 1 }
}

/// Turns of a kernel's loops beside those that are counted.
const SOME_TURNS: u32 = 64;

/// How many tiles a view may have: where every Gaussian of a subgroup covers all of them, `reduce_records` makes as many
/// turns as there are tiles, its lanes taking turns at each; `emit` makes fewer.
pub(super) fn most_tiles(gpu: &Gpu) -> usize {
    let Properties { max_loop_iterations, subgroup_size, .. } = *gpu.properties();
    let turns_of_owners = 2 * subgroup_size;
    (max_loop_iterations - SOME_TURNS - turns_of_owners) as usize
}

/// How many splats of a tile the blending kernels get through: of a subgroup of splats they make one turn of the
/// outer loop and the turns of the inner one; some more find the run, and end a loop.
pub(super) fn longest_run(gpu: &Gpu) -> u32 {
    let properties = gpu.properties();
    let lanes = properties.subgroup_size;
    let turns_per_batch = 1 + lanes.div_ceil(splats_per_turn(gpu));
    ((properties.max_loop_iterations - SOME_TURNS) / turns_per_batch).saturating_mul(lanes)
}
