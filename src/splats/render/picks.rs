//! What is under a pixel: the splat at which half of the light is blocked, of which model, and how far away.

use std::collections::VecDeque;

use nightsplat_core::camera::{Camera, Patch};

use super::Renderer;
use super::instances::FirstSplat;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Ring, Threads};
use crate::kernels::pick_splats::{self, NO_SPLAT};

/// The outcome of the newest pick that is done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pick {
    /// The number of its frame; 0 for a submission of our own.
    pub frame: u64,
    /// `None`: less than half of the light is blocked.
    pub hit: Option<PickedSplat>,
}

/// The Gaussian at which the transmittance of a pixel falls to 1/2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PickedSplat {
    /// The index among the instances of the draw; 0 where a model is drawn.
    pub instance: usize,
    /// The index in its model.
    pub gaussian: u32,
    /// The depth in the view, world units.
    pub depth: f32,
}

/// Picks in flight, and those of every pixel.
#[derive(Debug)]
pub(super) struct Picks {
    kernel: Pipeline<pick_splats::Kernel>,
    /// (H, W, 2), where motion vectors need them.
    pub(super) of_pixels: Buffer<u32>,
    /// (2)
    one: Buffer<u32>,
    ring: Ring,
    /// The first splats of the instances of the last picks, by the number of the pick.
    drawn: VecDeque<(u64, Vec<FirstSplat>)>,
}

/// Picks whose instances are kept: as many as the ring has, and more.
const KEPT: usize = 8;

impl Renderer {
    /// Builds what picks need, with memory for those of `pixels` pixels.
    pub(super) fn prepare_picks(&mut self, pixels: usize) -> Result<()> {
        if self.picks.is_none() {
            let [tile_width, tile_height] = self.tile.size;
            let constants = pick_splats::Constants {
                alpha_max: self.settings.max_alpha,
                channels: self.settings.channels() as u32 + 1,
                tile_width,
                tile_height,
            };
            self.picks = Some(Picks::new(&self.gpu, &constants)?);
        }
        match &mut self.picks {
            Some(picks) => picks.of_pixels.grow(&self.gpu, 2 * pixels),
            None => Ok(()),
        }
    }

    /// Records the pick of a pixel of the view that was recorded last, whose instances begin with these splats.
    pub(super) fn record_pick(
        &mut self,
        pass: &mut Recorder<'_>,
        camera: &Camera,
        [x, y]: [u32; 2],
        has_limits: bool,
        firsts: Vec<FirstSplat>,
    ) -> Result<()> {
        self.dispatch_picks(pass, camera, Some(y * camera.width + x), has_limits)?;
        let Some(picks) = &mut self.picks else { return Ok(()) };
        if picks.drawn.len() == KEPT {
            picks.drawn.pop_front();
        }
        picks.drawn.push_back((picks.ring.number(), firsts));
        pass.copy_to_ring(&picks.one, &mut picks.ring, 0);
        Ok(())
    }

    /// Records the picks of every pixel, or of one, counted row by row.
    pub(super) fn dispatch_picks(
        &mut self,
        pass: &mut Recorder<'_>,
        camera: &Camera,
        pixel: Option<u32>,
        has_limits: bool,
    ) -> Result<()> {
        let size = Patch::from(camera).size;
        let tile_columns = self.tiles(size).x;
        let Self { frame, limits, picks, .. } = self;
        let Some(picks) = picks else { return Ok(()) };
        let pixel_count = pixel.map_or(Patch::from(camera).pixel_count() as u32, |_| 1);
        let target = if pixel.is_some() { &mut picks.one } else { &mut picks.of_pixels };
        pass.dispatch(
            &picks.kernel,
            &pick_splats::Params {
                size,
                tile_columns,
                first_pixel: pixel.unwrap_or_default(),
                pixel_count,
                has_limits: has_limits.into(),
            },
            pick_splats::Buffers {
                tile_ranges: frame.tile_ranges.slice(),
                sorted_intersections: frame.lists.intersection_ids.slice(),
                gaussian_ids: frame.lists.gaussian_ids.slice(),
                splats: frame.splats.slice(),
                colors: frame.colors.slice(),
                limits: limits.slice(),
                picks: target.slice_mut(),
            },
            Threads::Exactly([pixel_count, 1, 1]),
        )
    }

    /// The outcome of the newest pick that is done; `None` before there is one. Waits for nothing.
    pub fn picked(&self) -> Option<Pick> {
        let picks = self.picks.as_ref()?;
        let newest = picks.ring.newest()?;
        let (_, firsts) = picks.drawn.iter().find(|(number, _)| *number == newest.number)?;
        let hit = match newest.words[..] {
            [splat, depth] if splat != NO_SPLAT => {
                let at = firsts.partition_point(|first| first.splat <= splat).checked_sub(1)?;
                let FirstSplat { splat: first, instance } = firsts[at];
                Some(PickedSplat {
                    instance,
                    gaussian: splat - first,
                    depth: f32::from_bits(depth),
                })
            }
            _ => None,
        };
        Some(Pick { frame: newest.frame, hit })
    }
}

impl Picks {
    fn new(gpu: &Gpu, constants: &pick_splats::Constants) -> Result<Self> {
        Ok(Self {
            kernel: gpu.pipeline(constants)?,
            of_pixels: gpu.uninit("picks", 0)?,
            one: gpu.zeros("pick", 2)?,
            ring: gpu.ring("picked", 2)?,
            drawn: VecDeque::new(),
        })
    }
}
