//! The kernels of SSIM: one on a CPU, two on a GPU.

use std::num::NonZeroU32;

use glam::UVec2;

use super::super::Term;
use super::super::log::{LogRow, LogSlot};
use super::LossInputs;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::ssim_window::RADIUS;
use crate::kernels::{ssim, ssim_backward, ssim_forward};

/// The gradient of L1 + SSIM, and their partial sums or, where the last kernel writes it, their row of the log.
#[derive(Debug)]
pub(super) struct SsimLoss {
    /// w, above 0.
    weight: f64,
    lanes: u32,
    kernels: SsimKernels,
}

/// The kernels for the device. On a CPU, loads and stores cost most, and the state of both blurs fits the L1 cache. On
/// a GPU it would take most registers of a processor, so that too few subgroups would be left to hide latencies.
#[derive(Debug)]
enum SsimKernels {
    One(StripKernels),
    Two {
        /// The strips of a view, as far as the limits of their rows allow.
        strips: u32,
        forward: Pipeline<ssim_forward::Kernel>,
        backward: Pipeline<ssim_backward::Kernel>,
        /// (3, H, W) each: the derivatives with respect to E\[a\], E\[aa\] and E\[ab\].
        derivatives: [Buffer<f32>; 3],
        /// Workgroups of `backward` that are done; 0 between steps.
        arrivals: Buffer<u32>,
    },
}

/// The one kernel in each of `LAYOUTS`, compiled for the first view that needs it: a software device takes longer for
/// that than for a step.
#[derive(Debug)]
struct StripKernels {
    gpu: Gpu,
    /// Whether the gradient is added to that of earlier terms.
    adds: bool,
    compiled: [Option<Pipeline<ssim::Kernel>>; LAYOUTS.len()],
}

/// The layout of the one kernel: columns per lane, rows per subgroup, and the alignment of its loads and stores in
/// floats. A subgroup is as wide as its state fits the cache, and has many rows.
#[derive(Clone, Copy, Debug)]
struct SsimLayout {
    columns: u32,
    rows: u32,
    alignment: u32,
}

/// The first layout that fits a view is used; the last one fits every view.
const LAYOUTS: [SsimLayout; 2] = [
    SsimLayout { columns: 12, rows: 192, alignment: 4 },
    SsimLayout { columns: 6, rows: 192, alignment: 1 },
];

/// The strips that occupy the largest GPUs where `bench --tune` did not find a number: 24 on each of some 130
/// multiprocessors. With more, each would have fewer rows, and the rows above and below that it loads would be a larger
/// share.
const STRIPS: u32 = 3072;
/// The fewest and the most rows of a strip.
const ROWS: [u64; 2] = [8, 128];

impl SsimLayout {
    fn fits(self, size: UVec2) -> bool {
        size.x.is_multiple_of(self.alignment)
    }

    /// The number of subgroups for a channel of a view of `size`, with this number of lanes each.
    fn subgroups(self, size: UVec2, lanes: u32) -> u32 {
        let halo = (2 * RADIUS as u32).next_multiple_of(self.alignment);
        let outputs = lanes * self.columns - 2 * halo;
        size.x.div_ceil(outputs) * size.y.div_ceil(self.rows)
    }
}

/// The rows of a strip, one column of pixels a lane, for about this number of strips.
fn rows(size: UVec2, lanes: u32, strips: u32) -> u32 {
    let columns = u64::from(3 * size.x.div_ceil(lanes));
    (columns * u64::from(size.y) / u64::from(strips)).clamp(ROWS[0], ROWS[1]) as u32
}

fn layout_of(size: UVec2) -> usize {
    LAYOUTS.iter().position(|layout| layout.fits(size)).unwrap_or(LAYOUTS.len() - 1)
}

impl StripKernels {
    fn kernel(&mut self, layout: usize) -> Result<&Pipeline<ssim::Kernel>> {
        match &mut self.compiled[layout] {
            Some(kernel) => Ok(kernel),
            missing => {
                let SsimLayout { columns, rows, alignment } = LAYOUTS[layout];
                let constants = ssim::Constants { columns, rows, alignment, adds: self.adds };
                Ok(missing.insert(self.gpu.pipeline(&constants)?))
            }
        }
    }
}

impl SsimLoss {
    /// Builds the kernels; `adds`: the gradient is added to that of earlier terms.
    pub(super) fn new(gpu: &Gpu, weight: f64, adds: bool) -> Result<Self> {
        let kernels = match gpu.properties().is_cpu {
            true => {
                SsimKernels::One(StripKernels { gpu: gpu.clone(), adds, compiled: [None, None] })
            }
            false => SsimKernels::Two {
                strips: gpu.tuned_ssim_strips().map_or(STRIPS, NonZeroU32::get),
                forward: gpu.pipeline(&ssim_forward::Constants::default())?,
                backward: gpu.pipeline(&ssim_backward::Constants { adds })?,
                derivatives: [
                    gpu.uninit("d_mean", 0)?,
                    gpu.uninit("d_square", 0)?,
                    gpu.uninit("d_product", 0)?,
                ],
                arrivals: gpu.zeros("ssim_arrivals", 1)?,
            },
        };
        Ok(Self { weight, lanes: gpu.properties().subgroup_size, kernels })
    }

    /// Divides views into about this number of strips on a GPU.
    pub(super) fn set_strips(&mut self, count: NonZeroU32) {
        if let SsimKernels::Two { strips, .. } = &mut self.kernels {
            *strips = count.get();
        }
    }

    /// Compiles the kernels of views of any size.
    pub(super) fn compile(&mut self) -> Result<()> {
        match &mut self.kernels {
            SsimKernels::One(kernels) => {
                (0..LAYOUTS.len()).try_for_each(|layout| kernels.kernel(layout).map(drop))
            }
            SsimKernels::Two { .. } => Ok(()),
        }
    }

    /// Allocates scratch memory for views of up to `values` values, which never shrinks, and compiles what a view of
    /// `size` needs.
    pub(super) fn reserve(&mut self, gpu: &Gpu, size: UVec2, values: u32) -> Result<()> {
        match &mut self.kernels {
            SsimKernels::One(kernels) => kernels.kernel(layout_of(size)).map(drop),
            SsimKernels::Two { derivatives, .. } => {
                derivatives.iter_mut().try_for_each(|buffer| buffer.grow(gpu, values as usize))
            }
        }
    }

    /// Subgroups, one per workgroup, and so the partial sums of a view.
    pub(super) fn workgroups(&self, size: UVec2) -> u32 {
        3 * match &self.kernels {
            SsimKernels::One(_) => LAYOUTS[layout_of(size)].subgroups(size, self.lanes),
            SsimKernels::Two { strips, .. } => {
                size.x.div_ceil(self.lanes) * size.y.div_ceil(rows(size, self.lanes, *strips))
            }
        }
    }

    /// At least as many as any view up to `size` has: a smaller one may have narrower or shorter strips.
    pub(super) fn most_workgroups(&self, size: UVec2) -> u32 {
        3 * match &self.kernels {
            SsimKernels::One(_) => {
                let of_layouts = LAYOUTS.map(|layout| layout.subgroups(size, self.lanes));
                of_layouts.into_iter().fold(0, u32::max)
            }
            SsimKernels::Two { .. } => {
                size.x.div_ceil(self.lanes) * size.y.div_ceil(ROWS[0] as u32)
            }
        }
    }

    /// Returns whether both terms are in the log already.
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        LossInputs { size, loss_region, render, target }: LossInputs<'_>,
        d_render: &mut Buffer<f32>,
        [l1_partials, ssim_partials]: [&mut Buffer<f32>; 2],
        terms: [Term; 2],
        log: &mut LogSlot<'_>,
    ) -> Result<bool> {
        let workgroups = self.workgroups(size);
        let threads = Threads::Workgroups([workgroups, 1, 1]);
        let mean_scale = 1.0 / f64::from(loss_region.value_count());
        let l1_scale = ((1.0 - self.weight) * mean_scale) as f32;
        let ssim_scale = (self.weight * mean_scale) as f32;
        let UVec2 { x: width, y: height } = size;
        let (loss_begin, loss_end) = (loss_region.origin, loss_region.end());
        let (strips, forward, backward, derivatives, arrivals) = match &mut self.kernels {
            SsimKernels::One(kernels) => {
                pass.dispatch(
                    kernels.kernel(layout_of(size))?,
                    &ssim::Params { width, height, loss_begin, loss_end, l1_scale, ssim_scale },
                    ssim::Buffers {
                        render: render.slice(),
                        target: target.slice(),
                        d_render: d_render.slice_mut(),
                        l1_partials: l1_partials.slice_mut(),
                        ssim_partials: ssim_partials.slice_mut(),
                    },
                    threads,
                )?;
                return Ok(false);
            }
            SsimKernels::Two { strips, forward, backward, derivatives, arrivals } => {
                (*strips, forward, backward, derivatives, arrivals)
            }
        };
        let rows = rows(size, self.lanes, strips);
        let [d_mean, d_square, d_product] = derivatives;
        pass.dispatch(
            forward,
            &ssim_forward::Params { width, height, rows, loss_begin, loss_end },
            ssim_forward::Buffers {
                render: render.slice(),
                target: target.slice(),
                d_mean: d_mean.slice_mut(),
                d_square: d_square.slice_mut(),
                d_product: d_product.slice_mut(),
                partials: ssim_partials.slice_mut(),
            },
            threads,
        )?;
        let LogRow { slot, term_count, log, statuses, status } = log.row();
        pass.dispatch(
            backward,
            &ssim_backward::Params {
                width,
                height,
                rows,
                loss_begin,
                loss_end,
                l1_scale,
                ssim_scale,
                mean_scale: mean_scale as f32,
                strips: workgroups,
                slot,
                term_count,
                terms: terms.map(|term| term.index() as u32).into(),
            },
            ssim_backward::Buffers {
                render: render.slice(),
                target: target.slice(),
                d_mean: d_mean.slice(),
                d_square: d_square.slice(),
                d_product: d_product.slice(),
                d_render: d_render.slice_mut(),
                l1_partials: l1_partials.slice_mut(),
                ssim_partials: ssim_partials.slice(),
                log,
                statuses,
                status,
                arrivals: arrivals.slice_mut(),
            },
            threads,
        )?;
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{gpu_that_sorts_tiles, gpu_with};

    #[test]
    fn a_gpu_divides_views_into_the_strips_that_were_found_fastest() {
        let workgroups = |gpu: &Gpu| {
            let loss = SsimLoss::new(gpu, 0.2, false).unwrap();
            // Columns of strips, with rows for the kernel.
            let [size, lanes] = [UVec2::new(64, 1200), UVec2::splat(loss.lanes)];
            loss.workgroups(size) / (3 * size.x.div_ceil(lanes.x))
        };
        let columns = 3 * 64 / gpu_with(|_| ()).properties().subgroup_size;
        let expected = |strips: u32| 1200_u32.div_ceil((columns * 1200 / strips).clamp(8, 128));
        assert_eq!(workgroups(&gpu_that_sorts_tiles()), expected(1536));
        assert_eq!(workgroups(&gpu_with(|gpu| gpu.is_cpu = false)), expected(STRIPS));
        assert_ne!(expected(1536), expected(STRIPS));
    }

    #[test]
    fn no_smaller_view_has_more_strips_than_the_most() {
        for is_cpu in [true, false] {
            let gpu = gpu_with(|properties| properties.is_cpu = is_cpu);
            let loss = SsimLoss::new(&gpu, 0.2, false).unwrap();
            for size in [UVec2::new(72, 40), UVec2::new(500, 375), UVec2::new(4000, 3000)] {
                let most = loss.most_workgroups(size);
                let sides = (0..100).map(|i| (size * (100 - i) / 100).max(UVec2::ONE) - i % 2);
                let smaller = sides.flat_map(|side| [side, UVec2::new(size.x, side.y)]);
                for view in smaller.filter(|view| view.min_element() > 0) {
                    assert!(loss.workgroups(view) <= most, "CPU {is_cpu}: {view} in {size}");
                }
            }
        }
    }

    #[test]
    fn a_larger_view_has_longer_strips_on_a_gpu() {
        let rows = |width, height, strips| rows(UVec2::new(width, height), 32, strips);
        let by_default = |width, height| rows(width, height, STRIPS);
        let of_views = [
            by_default(1, 1),
            by_default(500, 375),
            by_default(1920, 1080),
            by_default(8000, 6000),
        ];
        assert_eq!(of_views, [8, 8, 63, 128]);
        assert_eq!([rows(500, 375, 768), rows(1920, 1080, 6144)], [23, 31]);
    }
}
