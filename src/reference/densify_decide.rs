use nightsplat_models::attributes::Attribute;

use crate::gpu::Reference;
use crate::kernels::densify_action::{
    ACTION_CLONE, ACTION_KEEP, ACTION_PRUNE, ACTION_SPLIT, COUNTER_CANDIDATES, COUNTER_CLONED,
    COUNTER_PRUNED, COUNTER_SPLIT, KEY_KEEP, KEY_PRUNE,
};
use crate::kernels::densify_decide::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let (first, of_batch) = (params.first_gaussian as usize, params.batch_count as usize);
        let log_scales = Attribute::LogScales.column(0) * of_batch;
        let kept = params.gaussian_count - slices.counters[COUNTER_PRUNED as usize];
        let available = params
            .max_gaussians
            .saturating_sub(kept)
            .div_ceil(params.rounds_left)
            .min(params.max_added);
        let end = if slices.counters[COUNTER_CANDIDATES as usize] > available {
            slices.sorted_keys[available as usize]
        } else {
            KEY_KEEP
        };
        for rank in 0..n {
            let (i, key) = (slices.sorted_ids[rank] as usize, slices.sorted_keys[rank]);
            if !(first..first + of_batch).contains(&i) {
                continue;
            }
            let log_scales = &slices.parameters[log_scales + 3 * (i - first)..][..3];
            let largest = log_scales.iter().copied().fold(f32::MIN, f32::max);
            let action = if key < end {
                let is_small = !constants.conserving && largest <= params.split_log_scale;
                if is_small { ACTION_CLONE } else { ACTION_SPLIT }
            } else if key == KEY_PRUNE {
                ACTION_PRUNE
            } else {
                ACTION_KEEP
            };
            slices.actions[i] = action;
            slices.child_counts[i] = [0, 1, 2, 2][action as usize];
            slices.counters[COUNTER_CLONED as usize] += u32::from(action == ACTION_CLONE);
            slices.counters[COUNTER_SPLIT as usize] += u32::from(action == ACTION_SPLIT);
        }
    }
}
