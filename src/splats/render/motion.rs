//! Motion vectors of a draw: where each pixel's point was seen in the frame before.

use glam::{DAffine3, DVec2};
use nightsplat_core::camera::{Camera, CameraModel};

use super::draw::Drawing;
use super::instances::FirstSplat;
use super::target::Target;
use super::{DepthKind, Renderer};
use crate::Result;
use crate::gpu::{Buffer, Gpu, HostImage, ImageFormat, Pipeline, Recorder, Threads};
use crate::kernels::pixels::{STORED_FLOATS, STORED_HALVES};
use crate::kernels::{MovingPoints, motion_vectors};

/// The kernel of motion vectors and its memory.
#[derive(Debug)]
pub(super) struct MotionVectors {
    kernel: Pipeline<motion_vectors::Kernel>,
    movers: Buffer<MovingPoints>,
    pixels: Buffer<u32>,
}

impl Renderer {
    /// Builds what motion vectors need, with memory for `pixels` pixels of an image, and for this many instances.
    pub(super) fn prepare_motion(
        &mut self,
        image: &HostImage,
        pixels: usize,
        instances: usize,
    ) -> Result<()> {
        if self.motion.is_none() {
            self.motion = Some(MotionVectors::new(&self.gpu)?);
        }
        let Some(motion) = &mut self.motion else { return Ok(()) };
        motion.movers.grow(&self.gpu, 1 + instances)?;
        motion.pixels.grow(&self.gpu, pixels * image.format.bytes() / 4)
    }

    /// Records the motion vectors of the view that was recorded last, of a camera that was another in the frame before.
    /// Its instances begin with these splats.
    pub(super) fn record_motion(
        &mut self,
        pass: &mut Recorder<'_>,
        drawing: Drawing<'_>,
        [camera, before]: [&Camera; 2],
        target: &Target<'_>,
        image: &HostImage,
        firsts: &[FirstSplat],
    ) -> Result<()> {
        let world = before.view_from_world * camera.view_from_world.inverse();
        let mut movers = vec![moving(world, 0)];
        if let Drawing::Instances(instances) = drawing {
            self.dispatch_picks(pass, camera, None, target.scene.is_some())?;
            movers.extend(firsts.iter().map(|first| {
                let instance = &instances[first.instance];
                moving(instance.before_from_now(camera, before), first.splat)
            }));
        }
        let channels = self.settings.channels() as u32;
        let Self { frame, motion, picks, .. } = self;
        let Some(motion) = motion else { return Ok(()) };
        pass.update(&mut motion.movers, &movers)?;
        let size = [camera.width, camera.height];
        let as_vec2 = |at: DVec2| at.as_vec2();
        pass.dispatch(
            &motion.kernel,
            &motion_vectors::Params {
                size: size.into(),
                depth_plane: channels,
                is_mean: (target.depth_kind == DepthKind::Expected).into(),
                is_orthographic: (camera.model == CameraModel::Orthographic).into(),
                mover_count: movers.len() as u32,
                storage: match image.format {
                    ImageFormat::Rg16Float => STORED_HALVES,
                    _ => STORED_FLOATS,
                },
                focal: as_vec2(camera.focal),
                principal_point: as_vec2(camera.principal_point),
                focal_before: as_vec2(before.focal),
                principal_point_before: as_vec2(before.principal_point),
            },
            motion_vectors::Buffers {
                render: frame.render.slice(),
                transmittances: frame.transmittances.slice(),
                picks: match picks {
                    Some(picks) => picks.of_pixels.slice(),
                    None => frame.lists.counts.slice(),
                },
                movers: motion.movers.slice(),
                pixels: motion.pixels.slice_mut(),
            },
            Threads::Exactly([size[0] * size[1], 1, 1]),
        )?;
        pass.give_image(&motion.pixels, image, size);
        Ok(())
    }
}

impl MotionVectors {
    fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            kernel: gpu.pipeline(&motion_vectors::Constants {})?,
            movers: gpu.zeros("movers", 1)?,
            pixels: gpu.uninit("motion", 0)?,
        })
    }
}

fn moving(before_from_now: DAffine3, first: u32) -> MovingPoints {
    let DAffine3 { matrix3: turned, translation } = before_from_now;
    let columns = [turned.x_axis, turned.y_axis, turned.z_axis, translation];
    let before_from_now = columns.map(|column| column.as_vec3().to_array());
    MovingPoints { before_from_now, first }
}
