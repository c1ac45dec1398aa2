//! Models of a render of several.

use glam::{DAffine3, DVec3};
use nightsplat::gpu::Gpu;
use nightsplat::splats::render::Instance;

use super::camera::affine;
use super::error::Failure;
use super::model::{Appearance, LoadedModel, NspModel, appearance, check_device};
use super::structs::{Sized0, object};
use super::train::{NspTrainer, live};

/// The instance is not drawn.
pub const NSP_INSTANCE_HIDDEN: u32 = 1;
/// Splats whose centres are outside of `clip_min` to `clip_max` are not drawn.
pub const NSP_INSTANCE_CLIP: u32 = 2;

/// A model in a render of several. One model can have many instances; it is uploaded once. Experimental.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspInstance {
    /// `sizeof(NspInstance)`; in an array, the distance between elements.
    pub struct_size: usize,
    /// The model; NULL with a trainer.
    pub model: *const NspModel,
    /// A trainer whose Gaussians are drawn as they are, without a copy: the recording is submitted before the next call
    /// of `nsp_trainer_advance`, to the same queue. NULL: a model.
    pub trainer: *const NspTrainer,
    /// The rigid transform from the model's world to that of the cameras, three rows of four; all zeros: none.
    pub pose: [f64; 12],
    /// The factor on lengths of the model, before the pose; 0 stands for 1.
    pub scale: f64,
    /// Factors of display-referred red, green and blue, 0 or more, and of the opacity, 0 to 1; all zeros stand for
    /// ones.
    pub tint: [f32; 4],
    /// The least corner of the clip box, in the model's world.
    pub clip_min: [f64; 3],
    /// The greatest corner of the clip box.
    pub clip_max: [f64; 3],
    /// `NSP_INSTANCE_*`.
    pub flags: u32,
    /// Unused.
    pub reserved: u32,
    /// `pose` in the frame before, for motion vectors; all zeros: as in this frame, and `scale` too.
    pub pose_before: [f64; 12],
    /// `scale` in the frame before; 0 stands for 1.
    pub scale_before: f64,
}

// SAFETY: the size comes first; null pointers are zeros.
unsafe impl Sized0 for NspInstance {
    const NAME: &'static str = "NspInstance";
    const FIRST_SIZE: usize = std::mem::offset_of!(Self, pose_before);
}

/// # Safety
/// The model is NULL or valid.
pub(super) unsafe fn lent_instance<'a>(
    gpu: &Gpu,
    wanted: Appearance,
    at: usize,
    instance: &NspInstance,
) -> Result<Instance<'a>, Failure> {
    const FLAGS: u32 = NSP_INSTANCE_HIDDEN | NSP_INSTANCE_CLIP;
    if instance.flags & !FLAGS != 0 || instance.reserved != 0 {
        let text = format!("instance {at} has unknown flags, or reserved is not 0");
        return Err(Failure::usage(text));
    }
    // SAFETY: as the caller promises.
    let whole = match unsafe { instance.trainer.as_ref() } {
        Some(trainer) => live(trainer)?,
        None => {
            // SAFETY: as the caller promises.
            let model = unsafe { object(instance.model, &format!("the model of instance {at}")) }?;
            let LoadedModel { model, on_device } = model.0.get("a model")?;
            if appearance(model) != wanted {
                return Err(Failure::usage(format!(
                    "the model of instance {at} has other colours, alpha limit or antialiasing than the renderer's"
                )));
            }
            Instance::new(on_device)
        }
    };
    check_device(gpu, whole.gaussians)?;
    let corners = [instance.clip_min, instance.clip_max].map(DVec3::from);
    let placed = |pose: &[f64; 12], scale: f64| {
        let pose = if *pose == [0.0; 12] { DAffine3::IDENTITY } else { affine(pose) };
        let scale = if scale == 0.0 { 1.0 } else { scale };
        // That of a trainer takes its frame to the world first.
        let offset = DAffine3::from_translation(scale * whole.pose.translation);
        (pose * offset, scale * whole.scale)
    };
    let (pose, scale) = placed(&instance.pose, instance.scale);
    let has_moved = instance.pose_before != [0.0; 12];
    Ok(Instance {
        pose,
        scale,
        before: has_moved.then(|| placed(&instance.pose_before, instance.scale_before)),
        tint: if instance.tint == [0.0; 4] { [1.0; 4] } else { instance.tint },
        clip: (instance.flags & NSP_INSTANCE_CLIP != 0).then_some(corners),
        is_visible: instance.flags & NSP_INSTANCE_HIDDEN == 0,
        ..whole
    })
}
