use crate::gpu::Reference;
use crate::kernels::densify_decide::{Constants, Kernel, Params, Slices};
use crate::kernels::fate::{
    FATE_CLONE, FATE_KEEP, FATE_PRUNE, FATE_SPLIT, KEY_KEEP, KEY_PRUNE, TALLY_CANDIDATES,
    TALLY_CLONED, TALLY_PRUNED, TALLY_SPLIT,
};
use crate::splats::attributes::Attribute;

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let (first, of_batch) = (params.first_gaussian as usize, params.batch_count as usize);
        let log_scales = Attribute::LogScales.column(0) * of_batch;
        let kept = params.gaussian_count - slices.tally[TALLY_PRUNED as usize];
        let room = params
            .max_gaussians
            .saturating_sub(kept)
            .div_ceil(params.rounds_left)
            .min(params.most_added);
        let end = if slices.tally[TALLY_CANDIDATES as usize] > room {
            slices.sorted_keys[room as usize]
        } else {
            KEY_KEEP
        };
        for place in 0..n {
            let (i, key) = (slices.sorted_ids[place] as usize, slices.sorted_keys[place]);
            if !(first..first + of_batch).contains(&i) {
                continue;
            }
            let log_scales = &slices.parameters[log_scales + 3 * (i - first)..][..3];
            let largest = log_scales.iter().copied().fold(f32::MIN, f32::max);
            let fate = if key < end {
                let is_small = !constants.conserving && largest <= params.split_log_scale;
                if is_small { FATE_CLONE } else { FATE_SPLIT }
            } else if key == KEY_PRUNE {
                FATE_PRUNE
            } else {
                FATE_KEEP
            };
            slices.fates[i] = fate;
            slices.offspring_counts[i] = [0, 1, 2, 2][fate as usize];
            slices.tally[TALLY_CLONED as usize] += u32::from(fate == FATE_CLONE);
            slices.tally[TALLY_SPLIT as usize] += u32::from(fate == FATE_SPLIT);
        }
    }
}
