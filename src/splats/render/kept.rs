//! Sorted intersections that are kept from step to step, where no splat changes.

use glam::UVec2;

use super::lists::Lists;
use super::{RenderOptions, Renderer, TRAINED_DEPTH, Viewpoints};
use crate::Result;
use crate::gpu::Gpu;
use crate::splats::device::GaussianSlice;

impl Lists {
    fn bytes(&self) -> u64 {
        bytes(self.intersection_ranges.len(), self.tiles.len())
    }

    /// A copy without what is reserved beyond the intersections.
    fn fitted(&self, gpu: &Gpu, gaussians: usize, intersections: usize) -> Result<Self> {
        let mut fitted = Self::new(gpu, gaussians, intersections)?;
        gpu.run("keep_lists", |pass| {
            pass.copy(&self.counts, &mut fitted.counts);
            pass.copy(&self.tiles, &mut fitted.tiles);
            pass.copy(&self.intersection_ids, &mut fitted.intersection_ids);
            pass.copy(&self.gaussian_ids, &mut fitted.gaussian_ids);
            pass.copy(&self.intersection_ranges, &mut fitted.intersection_ranges);
            Ok(())
        })?;
        Ok(fitted)
    }
}

fn bytes(gaussians: usize, intersections: usize) -> u64 {
    (gaussians * size_of::<UVec2>() + intersections * Lists::BYTES_PER_INTERSECTION) as u64
}

impl Renderer {
    /// Keeps the sorted intersections of the next view, within `limit` bytes for those of all views; false if there is
    /// no next view, or no memory for it. Renders of the view no longer sort. Until [`Viewpoints::forget_lists`], the
    /// means, shapes and opacities of the Gaussians and the context must not change.
    ///
    /// # Errors
    /// Those of a render.
    pub(crate) fn keep_next_lists(
        &mut self,
        gaussians: GaussianSlice<'_>,
        viewpoints: &mut Viewpoints,
        limit: u64,
    ) -> Result<bool> {
        let Some(patch) = viewpoints.patches.get(viewpoints.lists.len()) else { return Ok(false) };
        if viewpoints.has_all_that_fit {
            return Ok(false);
        }
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        let depths = self.settings.keeps_depth().then_some(TRAINED_DEPTH);
        let halves = self.render_or_halve(gaussians, patch, &options, depths)?;
        let count = self.context_count() + gaussians.layout.count;
        // Kernels bind at least one.
        let intersections = self.intersections()?.max(1) as usize;
        let kept: u64 = viewpoints.lists.iter().map(Lists::bytes).sum();
        if halves.is_some() || kept + bytes(count, intersections) > limit {
            viewpoints.has_all_that_fit = true;
            return Ok(false);
        }
        viewpoints.lists.push(self.frame.lists.fitted(&self.gpu, count, intersections)?);
        Ok(true)
    }
}
