//! The structure of a pseudo-GT: the strength of its colour edges, independent of illumination.
//!
//! ```text
//! pseudo-GT -> ciconv_rows -> ciconv_columns -> ciconv_moments -> ciconv_normalize -> structure
//! ```
//!
//! The invariant W of `CIConv` (Lengyel et al. 2021) at the fixed scale 0.8, its logarithm normalised over the view and
//! clamped to [0, 1]: 0 where edges are weaker than the mean, 1 from one standard deviation above it. It does not
//! change during training, so it is computed once per view.

use glam::{UVec2, Vec2, Vec3};

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{ciconv_columns, ciconv_moments, ciconv_normalize, ciconv_rows};
use crate::{Error, Result};

/// The kernels, and scratch memory for the largest view so far.
#[derive(Debug)]
pub struct StructureTarget {
    gpu: Gpu,
    subgroup_size: u32,
    rows: Pipeline<ciconv_rows::Kernel>,
    columns: Pipeline<ciconv_columns::Kernel>,
    moments: Pipeline<ciconv_moments::Kernel>,
    normalize: Pipeline<ciconv_normalize::Kernel>,
    /// (H, W, 3) each.
    smooth_rows: Buffer<Vec3>,
    slope_rows: Buffer<Vec3>,
    /// (H, W)
    logs: Buffer<f32>,
    partial_moments: Buffer<Vec2>,
    norm: Buffer<Vec2>,
}

impl StructureTarget {
    /// Builds the kernels.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            gpu: gpu.clone(),
            subgroup_size: gpu.properties().subgroup_size,
            rows: gpu.pipeline(&ciconv_rows::Constants {})?,
            columns: gpu.pipeline(&ciconv_columns::Constants {})?,
            moments: gpu.pipeline(&ciconv_moments::Constants {})?,
            normalize: gpu.pipeline(&ciconv_normalize::Constants {})?,
            smooth_rows: gpu.uninit("smooth_rows", 0)?,
            slope_rows: gpu.uninit("slope_rows", 0)?,
            logs: gpu.uninit("structure_logs", 0)?,
            partial_moments: gpu.uninit("structure_moments", 0)?,
            norm: gpu.uninit("structure_norm", 1)?,
        })
    }

    /// Records the structure of `target`, a pseudo-GT of shape (3, H, W), into `structure`, (H, W), in [0, 1].
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        target: &Buffer<f32>,
        size: UVec2,
        structure: &mut Buffer<f32>,
    ) -> Result<()> {
        let UVec2 { x: width, y: height } = size;
        let pixel_count = width.saturating_mul(height);
        let fits = pixel_count > 0
            && target.len() / 3 >= pixel_count as usize
            && structure.len() >= pixel_count as usize;
        if !fits {
            return Err(Error::Usage(format!(
                "a view of {width} x {height} pixels has no structure, or `{}` or `{}` is shorter",
                target.name(),
                structure.name()
            )));
        }
        self.reserve(pixel_count)?;
        let per_pixel = Threads::Exactly([pixel_count, 1, 1]);
        pass.dispatch(
            &self.rows,
            &ciconv_rows::Params { width, height },
            ciconv_rows::Buffers {
                image: target.slice(),
                smooth_rows: self.smooth_rows.slice_mut(),
                slope_rows: self.slope_rows.slice_mut(),
            },
            per_pixel,
        )?;
        pass.dispatch(
            &self.columns,
            &ciconv_columns::Params { width, height, pixels_per_moment: self.subgroup_size },
            ciconv_columns::Buffers {
                smooth_rows: self.smooth_rows.slice(),
                slope_rows: self.slope_rows.slice(),
                logs: self.logs.slice_mut(),
                moments: self.partial_moments.slice_mut(),
            },
            per_pixel,
        )?;
        pass.dispatch(
            &self.moments,
            &ciconv_moments::Params { pixel_count, pixels_per_moment: self.subgroup_size },
            ciconv_moments::Buffers {
                moments: self.partial_moments.slice(),
                norm: self.norm.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )?;
        pass.dispatch(
            &self.normalize,
            &ciconv_normalize::Params { pixel_count },
            ciconv_normalize::Buffers {
                logs: self.logs.slice(),
                norm: self.norm.slice(),
                structure: structure.slice_mut(),
            },
            per_pixel,
        )
    }

    fn reserve(&mut self, pixel_count: u32) -> Result<()> {
        let pixels = pixel_count as usize;
        if self.logs.len() < pixels {
            let moments = pixel_count.div_ceil(self.subgroup_size) as usize;
            self.smooth_rows = self.gpu.uninit("smooth_rows", pixels)?;
            self.slope_rows = self.gpu.uninit("slope_rows", pixels)?;
            self.partial_moments = self.gpu.uninit("structure_moments", moments)?;
            self.logs = self.gpu.uninit("structure_logs", pixels)?;
        }
        Ok(())
    }
}
