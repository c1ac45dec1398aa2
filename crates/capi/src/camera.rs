//! Cameras, also from the matrices of an engine.

use glam::{DAffine3, DMat3, DVec2, DVec3};
use nightsplat_core::camera::{Camera, CameraModel, KannalaBrandt, deviation_from_rigid};

use super::error::{Failure, NspResult, guard};
use super::structs::{Sized0, write};

/// The lens is a fisheye (Kannala and Brandt); otherwise the camera is a pinhole.
pub const NSP_CAMERA_FISHEYE: u32 = 1;
/// The camera is orthographic.
pub const NSP_CAMERA_ORTHOGRAPHIC: u32 = 2;

/// A camera, in axes x right, y down, z forward.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspCamera {
    /// `sizeof(NspCamera)`; in an array, the distance between elements.
    pub struct_size: usize,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Focal lengths along x and y in pixels; with `NSP_CAMERA_ORTHOGRAPHIC` pixels per world unit.
    pub focal: [f64; 2],
    /// The principal point in pixels, from the top left corner of the image.
    pub principal_point: [f64; 2],
    /// The rigid transform from world to view space, three rows of four.
    pub view_from_world: [f64; 12],
    /// `NSP_CAMERA_*`.
    pub flags: u32,
    /// Unused.
    pub reserved: u32,
    /// With `NSP_CAMERA_FISHEYE`: k1 to k4 of its model, as in `OpenCV`.
    pub distortion: [f64; 4],
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspCamera {
    const NAME: &'static str = "NspCamera";
    const FIRST_SIZE: usize = size_of::<Self>();
}

impl NspCamera {
    /// The camera, as the library has it.
    pub fn camera(&self) -> Result<Camera, String> {
        let Self { width, height, focal, principal_point, view_from_world: m, .. } = *self;
        let model = match self.flags {
            0 => CameraModel::Pinhole,
            NSP_CAMERA_FISHEYE => {
                CameraModel::Fisheye(KannalaBrandt { coefficients: self.distortion })
            }
            NSP_CAMERA_ORTHOGRAPHIC => CameraModel::Orthographic,
            _ => return Err("has unknown flags, or two that exclude each other".to_owned()),
        };
        if self.reserved != 0 {
            return Err("has a reserved member that is not 0".to_owned());
        }
        let (focal, principal_point) = (DVec2::from(focal), DVec2::from(principal_point));
        Ok(Camera { width, height, focal, principal_point, model, view_from_world: affine(&m) })
    }
}

/// A matrix of three rows of four.
pub(super) fn affine(m: &[f64; 12]) -> DAffine3 {
    let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
    DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) }
}

/// The camera of an engine's column-major view and projection matrices, for Vulkan's clip space (x right, y down,
/// depth 0 to 1, or reversed). The camera may look along z or -z, with y up or down. `width` and `height` are those of
/// the viewport in pixels. An orthographic projection gives an orthographic camera, which looks along the axis that makes
/// its image no mirror of the world.
///
/// Errors: `NSP_ERROR_USAGE` if the projection is sheared, or if the matrices scale or mirror the world.
///
/// # Safety
/// `view` and `projection` are NULL or hold 16 floats; `camera` is NULL or valid, with its `struct_size`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_camera_from_matrices(
    view: *const f32,
    projection: *const f32,
    width: u32,
    height: u32,
    camera: *mut NspCamera,
) -> NspResult {
    guard("nsp_camera_from_matrices", || {
        if view.is_null() || projection.is_null() {
            return Err(Failure::usage("view or projection is NULL"));
        }
        // SAFETY: as the caller promises.
        let [view, projection] =
            [view, projection].map(|m| unsafe { std::slice::from_raw_parts(m, 16) });
        let made = from_matrices(view, projection, [width, height])?;
        // SAFETY: as the caller promises.
        unsafe { write(camera, &made) }
    })
}

fn from_matrices(
    view: &[f32],
    projection: &[f32],
    [width, height]: [u32; 2],
) -> Result<NspCamera, Failure> {
    if let Some(at) = view.iter().chain(projection).position(|x| !x.is_finite()) {
        return Err(Failure::usage(format!("number {at} of view and projection is not finite")));
    }
    let p = |row: usize, column: usize| f64::from(projection[4 * column + row]);
    let is_orthographic = p(3, 2) == 0.0 && p(3, 3) > 0.0;
    let forward = match is_orthographic {
        true => p(3, 3) * axis_of_view(view, p(0, 0) * p(1, 1)),
        false => p(3, 2),
    };
    if forward == 0.0 || !is_orthographic && p(3, 3) != 0.0 || p(3, 0) != 0.0 || p(3, 1) != 0.0 {
        return Err(Failure::usage(
            "projection is neither perspective nor orthographic; take one whose last row is (0, 0, +-1, 0) or (0, 0, \
             0, 1)",
        ));
    }
    let scale = DVec2::new(p(0, 0), p(1, 1)) / forward.abs();
    let slack = 1e-6 * scale.abs().max_element();
    if scale.min_element().abs() == 0.0 || scale.y == 0.0 {
        return Err(Failure::usage("projection has a focal length of 0"));
    }
    // What makes no axis of the image, and where the image is shifted.
    let (other, shift) = if is_orthographic { (2, 3) } else { (3, 2) };
    let off = [p(0, 1), p(1, 0), p(0, other), p(1, other)];
    if off.iter().any(|x| x.abs() > slack * forward.abs()) {
        return Err(Failure::usage("projection is sheared or shifted; take one without"));
    }
    // The view's axes to x right, y down, z forward.
    let axes = DVec3::new(scale.x.signum(), scale.y.signum(), forward.signum());
    let v = |row: usize, column: usize| f64::from(view[4 * column + row]) * axes[row];
    let half = DVec2::new(f64::from(width), f64::from(height)) / 2.0;
    let middle = DVec2::new(p(0, shift), p(1, shift))
        / if is_orthographic { forward.abs() } else { forward };
    let mut view_from_world = [0.0; 12];
    for (at, value) in view_from_world.iter_mut().enumerate() {
        *value = v(at / 4, at % 4);
    }
    check_pose(&affine(&view_from_world))?;
    Ok(NspCamera {
        struct_size: size_of::<NspCamera>(),
        width,
        height,
        focal: (scale.abs() * half).to_array(),
        principal_point: ((middle + 1.0) * half).to_array(),
        view_from_world,
        flags: if is_orthographic { NSP_CAMERA_ORTHOGRAPHIC } else { 0 },
        reserved: 0,
        distortion: [0.0; 4],
    })
}

/// The sign of z along which a view looks whose image has axes of these signs: its projection does not say.
fn axis_of_view(view: &[f32], image: f64) -> f64 {
    let column = |c: usize| glam::Vec3::from_slice(&view[4 * c..]).as_dvec3();
    let rotation = DMat3::from_cols(column(0), column(1), column(2));
    (rotation.determinant() * image).signum()
}

/// Refuses a view that mirrors or scales, with what to do about it.
fn check_pose(view_from_world: &DAffine3) -> Result<(), Failure> {
    let determinant = view_from_world.matrix3.determinant();
    if determinant < 0.0 {
        return Err(Failure::usage(
            "view and projection mirror the world; negate projection[5] for a clip space with y down, or column 2 of \
             the view for a left-handed engine",
        ));
    }
    match deviation_from_rigid(view_from_world) {
        None => Ok(()),
        Some(_) => Err(Failure::usage(format!(
            "view is no rigid transform, its determinant is {determinant:.4}; divide its scale out"
        ))),
    }
}
