//! Limits of kernels on a device that ends loops after a number of iterations.

use glam::UVec2;

use super::buffers::color_floats;
use super::{Purpose, RenderSettings};
use crate::gpu::{BackwardForm, Gpu, Properties, RecordSums, Tile};
use crate::kernels::ProjectedSplat;
use crate::{Error, Result};

/// The splats that the blending kernels process per iteration of their inner loop. With two, a device with an iteration
/// limit can process a hundred thousand splats on a tile; one and four were measured to be slower there.
pub(super) fn splats_per_turn(gpu: &Gpu) -> u32 {
    if gpu.properties().max_loop_iterations < u32::MAX { 2 } else { 1 }
}

/// Where the backward pass sums gradient records over the lanes.
///
/// A record of three channels takes 12 shuffles. On NVIDIA each is an instruction of the units for loads, and a lane
/// that sums a value of its own takes a third fewer instructions. AMD and Intel read another lane's register within an
/// addition, and on AMD the memory would leave room for a third of the subgroups. A CPU has its splats in registers.
fn record_sums(device: &Properties) -> RecordSums {
    const NVIDIA: u32 = 0x10de;
    match device.vendor {
        NVIDIA if !device.is_cpu => RecordSums::SharedMemory,
        _ => RecordSums::Shuffles,
    }
}

/// The splats of a segment of a tile's run on a GPU, where the last splats of a long run would wait for all before them
/// while the device has nothing else to do; shorter where subgroups share the tiles of small views. The states between
/// segments take memory. A processor is busy with other tiles.
const SEGMENT: u32 = 1024;
const SEGMENT_OF_SHARED_TILE: u32 = 128;

/// The form of the backward pass; a draw without one has no states between segments.
pub(super) fn backward_form(device: &Properties, purpose: Purpose, tile: Tile) -> BackwardForm {
    let segment = match tile.subgroups {
        _ if device.is_cpu => 0,
        1 => SEGMENT,
        _ => SEGMENT_OF_SHARED_TILE,
    };
    let form = tile.backward.unwrap_or(BackwardForm { segment, sums: record_sums(device) });
    match purpose {
        Purpose::Train => form,
        Purpose::Show => BackwardForm { segment: 0, ..form },
    }
}

impl RenderSettings {
    /// Whether a view of this size is rendered and trained on at once: the device can, and the settings ask for no
    /// less.
    pub(crate) fn takes_at_once(&self, gpu: &Gpu, size: UVec2) -> bool {
        let pixels = u64::from(size.x) * u64::from(size.y);
        self.patch_pixels.is_none_or(|most| pixels <= most) && self.suits(gpu, size)
    }

    /// The most Gaussians that this device can render and train: some passes read splat and colour of any Gaussian,
    /// which one binding has to hold. Other planes are bound in [`Batches`](crate::splats::batches::Batches).
    #[doc(hidden)]
    pub fn peak_gaussians(&self, gpu: &Gpu) -> usize {
        let color = color_floats(self.trained_channels()) * size_of::<f32>();
        let bytes = size_of::<ProjectedSplat>().max(color) as u64;
        (gpu.properties().max_storage_buffer_range / bytes).min(u32::MAX.into()) as usize
    }

    /// The tile for views of these sizes: that of `RenderSettings::tile_up_to` the largest, or a multiple of its
    /// height where the settings name none and a view would have too many tiles.
    #[doc(hidden)]
    pub fn tile_for(
        &self,
        gpu: &Gpu,
        sizes: impl Iterator<Item = [u32; 2]> + Clone,
    ) -> Result<Tile> {
        let pixels = |[width, height]: [u32; 2]| u64::from(width) * u64::from(height);
        let mut tile = self.tile_up_to(gpu, sizes.clone().map(pixels).max())?;
        let count = |[width, height]: [u32; 2], tile: Tile| {
            width.div_ceil(tile.size[0]) as usize * height.div_ceil(tile.size[1]) as usize
        };
        let most = max_tiles(gpu);
        while self.tile.is_none() && sizes.clone().any(|size| count(size, tile) > most) {
            let higher = Tile { size: [tile.size[0], 2 * tile.size[1]], ..tile };
            if !gpu.properties().suits_tile(higher) {
                break;
            }
            tile = higher;
        }
        Ok(tile)
    }

    /// Whether this device can render and train on a view of this size.
    pub(crate) fn suits(&self, gpu: &Gpu, size: UVec2) -> bool {
        self.check_size(gpu, "", size.to_array()).is_ok()
    }

    /// Refuses a view that this device cannot render and train on, from its size alone.
    #[doc(hidden)]
    pub fn check_size(&self, gpu: &Gpu, view: &str, [width, height]: [u32; 2]) -> Result<()> {
        let Properties { name: device, max_storage_buffer_range: bindable, .. } = gpu.properties();
        let [tile_width, tile_height] = self.tile_for(gpu, std::iter::once([width, height]))?.size;
        let bytes_per_pixel = (self.trained_channels() * size_of::<f32>()) as u64;
        let bytes = u64::from(width) * u64::from(height) * bytes_per_pixel;
        let tiles = u64::from(width.div_ceil(tile_width)) * u64::from(height.div_ceil(tile_height));
        let most = max_tiles(gpu) as u64;
        let (excess, what) = if bytes > *bindable {
            let what = format!("its render takes {bytes} bytes, {device} binds {bindable} at most");
            (bytes as f64 / *bindable as f64, what)
        } else if tiles > most {
            let what = format!(
                "it has {tiles} tiles of {tile_width}x{tile_height} pixels, {device} allows {most}"
            );
            (tiles as f64 / most as f64, what)
        } else {
            return Ok(());
        };
        // A side is rounded, and so are tiles.
        let longest = 0.99 * f64::from(width.max(height)) / excess.sqrt();
        Err(Error::Usage(format!(
            "view {view} is {width}x{height}: {what}; lower max_resolution to {longest:.0}"
        )))
    }
}

/// Iterations of a kernel's loops beside those that are counted.
const SOME_TURNS: u32 = 64;

/// The most tiles of a view: where every Gaussian of a subgroup covers all of them, `project_backward` makes as many
/// iterations as there are tiles, its lanes taking turns at each; `emit` makes fewer.
pub(super) fn max_tiles(gpu: &Gpu) -> usize {
    let Properties { max_loop_iterations, subgroup_size, .. } = *gpu.properties();
    let turns_of_owners = 2 * subgroup_size;
    (max_loop_iterations - SOME_TURNS - turns_of_owners) as usize
}

/// The most splats of a tile that the blending kernels can process: for a subgroup of splats they make one iteration of
/// the outer loop and the iterations of the inner one; some more find the run and end a loop.
pub(super) fn longest_run(gpu: &Gpu) -> u32 {
    let properties = gpu.properties();
    let lanes = properties.subgroup_size;
    let turns_per_batch = 1 + lanes.div_ceil(splats_per_turn(gpu));
    ((properties.max_loop_iterations - SOME_TURNS) / turns_per_batch).saturating_mul(lanes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_summed_in_shared_memory_on_nvidia_alone() {
        let sums =
            |vendor, is_cpu| record_sums(&Properties { vendor, is_cpu, ..Properties::of_a_test() });
        assert_eq!(sums(0x10de, false), RecordSums::SharedMemory);
        for (vendor, is_cpu) in [(0x1002, false), (0x8086, false), (0x10de, true)] {
            assert_eq!(sums(vendor, is_cpu), RecordSums::Shuffles, "{vendor:x} {is_cpu}");
        }
    }
}
