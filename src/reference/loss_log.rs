use crate::gpu::Reference;
use crate::kernels::StepLoss;
use crate::kernels::loss_log::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { l1_partials, ssim_partials, log, status }: Slices<'_>,
    ) {
        let mean = |partials: &[f32], count: u32| {
            let sum: f64 = partials[..count as usize].iter().map(|&x| f64::from(x)).sum();
            (sum * f64::from(params.mean_scale)) as f32
        };
        let mut loss = StepLoss {
            l1: mean(l1_partials, params.l1_partial_count),
            ssim: mean(ssim_partials, params.ssim_partial_count),
            status: status[0],
        };
        if !loss.l1.is_finite() || !loss.ssim.is_finite() {
            loss.status |= params.not_finite_flag;
        }
        status[0] = loss.status;
        log[params.slot as usize] = loss;
    }
}
