//! The C interface, called as C calls it.

#![expect(unsafe_code, reason = "calls what C calls")]
#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

mod eyes;
#[path = "../../../../tests/gpu/host.rs"]
#[allow(dead_code, reason = "tests of the Rust host use more")]
mod host;
mod library;
mod refused;
mod threads;

use std::ffi::{CStr, CString, c_char, c_void};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock};

use ash::vk;
use ash::vk::Handle as _;
use glam::{DAffine3, DQuat, DVec3, Mat4, Vec3};
use half::f16;
use nightsplat::gpu::testing::{faults, gpu, not_run};
use nightsplat::gpu::{ImageFormat, ImageState};
use nightsplat::splats::device::Upload;
use nightsplat::splats::model::Model;
use nightsplat::splats::render::{RenderOptions, Renderer};
use nightsplat_capi::camera::{NspCamera, nsp_camera_from_matrices};
use nightsplat_capi::device::*;
use nightsplat_capi::error::panics::panic_in;
use nightsplat_capi::error::*;
use nightsplat_capi::{image::*, instance::*, model::*, render::*, renderer::*, train::*};
use nightsplat_core::camera::CameraModel;
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::Gaussians;
use nightsplat_photographs::image::linear_from_srgb;
use nightsplat_photographs::tone::{
    InverseTone, SceneLaw, Tone, ToneParameters, ToneSettings, scene_law,
};
use nightsplat_synth::{SyntheticOptions, write};

use crate::host::{Host, Picture, usual_extensions, vulkan};

/// The law of dark photographs.
fn law() -> SceneLaw {
    let mut parameters =
        ToneParameters { white: 0.15, offset: 0.075, gain: 1.0, ..Default::default() };
    (parameters.weight, parameters.constants[0]) = (1.0, 1.0 / 3.0);
    scene_law(&ToneSettings::new(Tone::Auto), &parameters).unwrap()
}

const SIZE: [u32; 2] = [320, 240];
const PIXELS: usize = 320 * 240;

// ---------------------------------------------------------------------------
// Helpers

fn last_error() -> String {
    // SAFETY: never NULL, and ends with NUL.
    unsafe { CStr::from_ptr(nsp_last_error()) }.to_str().unwrap().to_owned()
}

#[track_caller]
fn ok(result: NspResult) {
    assert_eq!(result, NSP_OK, "{}", last_error());
}

/// The call is refused with this code, in one line that has these words.
#[track_caller]
fn refused(result: NspResult, code: NspResult, words: &[&str]) {
    let text = last_error();
    assert_eq!(result, code, "{text}");
    assert!(!text.contains('\n') && text.starts_with("nsp_"), "{text}");
    words.iter().for_each(|word| assert!(text.contains(word), "`{word}` is not in: {text}"));
}

/// Some four hundred around the origin.
fn gaussians(sh_degree: u32) -> Gaussians {
    let mut gaussians = Gaussians::zeros(400, sh_degree);
    let uniform = |i: usize, row: u32| Stream::new(row.into(), 0).uniform(i as u64) as f32;
    for i in 0..gaussians.count {
        let [x, y, z] = [0, 1, 2].map(|row| 2.0 * uniform(i, row) - 1.0);
        gaussians.means_mut()[i] = Vec3::new(x, y, z);
        gaussians.quats_mut()[i] = [3, 4, 5, 6].map(|row| uniform(i, row) + 0.1);
        gaussians.log_scales_mut()[i] = Vec3::from([7, 8, 9].map(|row| uniform(i, row) - 3.0));
        gaussians.raw_opacities_mut()[i] = 3.0 * uniform(i, 10) - 1.0;
        gaussians.dc_mut()[i] = Vec3::from([11, 12, 13].map(|row| 2.0 * uniform(i, row) - 0.5));
    }
    let rest = gaussians.rest_mut();
    for (i, coefficient) in rest.iter_mut().enumerate() {
        *coefficient = Vec3::from([14, 15, 16].map(|row| 0.4 * uniform(i, row) - 0.2));
    }
    gaussians
}

/// The camera of `examples/c/embed.c`.
fn c_camera() -> NspCamera {
    NspCamera {
        struct_size: size_of::<NspCamera>(),
        width: SIZE[0],
        height: SIZE[1],
        focal: [300.0; 2],
        principal_point: [160.0, 120.0],
        view_from_world: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0],
        flags: 0,
        reserved: 0,
        distortion: [0.0; 4],
    }
}

/// The bytes of our own render before black, RGB.
fn own_render(model: &Model) -> Vec<u8> {
    let planes = own_planes(model);
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    (0..PIXELS).flat_map(|at| [0, 1, 2].map(|c| byte(planes[c * PIXELS + at]))).collect()
}

/// The planes of our own render before black, and its transmittances.
fn own_planes(model: &Model) -> Vec<f32> {
    let gpu = gpu();
    let on_device = model.gaussians.upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, model.render_settings()).unwrap();
    let camera = c_camera().camera().unwrap();
    renderer.reserve(on_device.layout.count, [&camera]).unwrap();
    let sh_degree = model.gaussians.shape.sh_degree;
    let options = RenderOptions { sh_degree, background: [0.0; 3] };
    renderer.render_planes(&on_device, &camera, &options).unwrap()
}

#[track_caller]
fn assert_close(actual: &[u8], expected: &[u8]) {
    assert_eq!(actual.len(), expected.len());
    let off = actual.iter().zip(expected).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    let differing = actual.iter().zip(expected).filter(|(a, b)| a != b).count();
    assert!(off <= 1 && differing < actual.len() / 1000, "{off} levels, {differing} values");
    assert!(expected.iter().any(|&byte| byte > 100), "nothing is seen");
}

/// What a host lends, with everything that is not set left out.
fn lend(host: &Host, flags: u32) -> NspHostDevice {
    let lent = host.lend();
    NspHostDevice {
        struct_size: size_of::<NspHostDevice>(),
        get_instance_proc_addr: Some(host.loader_function()),
        instance: vk::Instance::from_raw(lent.instance),
        physical_device: vk::PhysicalDevice::from_raw(lent.physical_device),
        device: vk::Device::from_raw(lent.device),
        queue: if flags & NSP_DEVICE_RECORD_ONLY == 0 { host.queue } else { vk::Queue::null() },
        queue_family: host.family,
        flags: flags | NSP_DEVICE_NAMES_OBJECTS,
        extensions: null(),
        extension_count: 0,
        features: null(),
        lock_queue: None,
        unlock_queue: None,
        user: null_mut(),
        pipeline_cache: vk::PipelineCache::null(),
        host_memory: null(),
        device_memory: null(),
        frames: vk::Semaphore::from_raw(lent.frames),
    }
}

fn image(picture: &Picture) -> NspImage {
    let state = |given: ImageState| NspImageState {
        layout: vk::ImageLayout::from_raw(given.layout),
        family: 0,
        stages: vk::PipelineStageFlags2::from_raw(given.stages),
        access: vk::AccessFlags2::from_raw(given.access),
        is_owned: 0,
        reserved: 0,
    };
    NspImage {
        struct_size: size_of::<NspImage>(),
        image: picture.image,
        format: vk::Format::R8G8B8A8_UNORM,
        extent: vk::Extent2D { width: picture.size[0], height: picture.size[1] },
        layer: 0,
        layers: 0,
        before: state(ImageState::UNDEFINED),
        after: state(ImageState::TRANSFER_SOURCE),
    }
}

fn render(
    commands: vk::CommandBuffer,
    frame: u64,
    camera: &NspCamera,
    color: &NspImage,
) -> NspRender {
    NspRender {
        struct_size: size_of::<NspRender>(),
        commands,
        frame,
        cameras: camera,
        camera_count: 1,
        flags: 0,
        color,
        depth_out: null(),
        scene_depth: null(),
        scene_near: 0.0,
        scene_far: 0.0,
        exposure: 0.0,
        background: [0.0; 3],
        budget: 0,
        instance_count: 0,
        instances: null(),
        hdr10_nits: 0.0,
        pick: [0; 2],
        reserved: 0,
        motion_out: null(),
        cameras_before: null(),
    }
}

/// A model as it is.
fn whole(model: *const NspModel) -> NspInstance {
    NspInstance {
        struct_size: size_of::<NspInstance>(),
        model,
        trainer: null(),
        pose: [0.0; 12],
        scale: 0.0,
        tint: [0.0; 4],
        clip_min: [0.0; 3],
        clip_max: [0.0; 3],
        flags: 0,
        reserved: 0,
        pose_before: [0.0; 12],
        scale_before: 0.0,
    }
}

/// A host with its device lent, and a model and a renderer on it.
struct Session {
    host: Host,
    device: *mut NspDevice,
    model: *mut NspModel,
    renderer: *mut NspRenderer,
    picture: Option<Picture>,
    folder: tempfile::TempDir,
}

impl Session {
    fn new(change: impl FnOnce(&mut NspHostDevice)) -> Self {
        Self::with_flags(NSP_DEVICE_RECORD_ONLY, change)
    }

    fn with_flags(flags: u32, change: impl FnOnce(&mut NspHostDevice)) -> Self {
        let host = Host::new(usual_extensions());
        let mut lent = lend(&host, flags);
        change(&mut lent);
        let folder = tempfile::tempdir().unwrap();
        Model::from(gaussians(2)).save(folder.path().join("model.ply")).unwrap();
        let picture = host.picture(ImageFormat::Rgba8Unorm, SIZE);
        let mut session = Self {
            host,
            device: null_mut(),
            model: null_mut(),
            renderer: null_mut(),
            picture,
            folder,
        };
        // SAFETY: the handles are the host's, and outlive the session's objects.
        ok(unsafe { nsp_device_from_host(&lent, &mut session.device) });
        session
    }

    /// With its model and a renderer.
    fn ready(change: impl FnOnce(&mut NspHostDevice)) -> Self {
        let mut session = Self::new(change);
        session.prepare();
        session
    }

    fn prepare(&mut self) {
        ok(self.load());
        ok(self.create());
    }

    /// Draws a frame, which must be our own render of the model.
    #[track_caller]
    fn assert_draws(&mut self, number: u64, model: &Model) {
        ok(self.frame(number));
        assert_close(&self.pixels(), &own_render(model));
    }

    fn info(&self) -> NspModelInfo {
        // SAFETY: a struct of numbers.
        let mut info: NspModelInfo = unsafe { std::mem::zeroed() };
        info.struct_size = size_of::<NspModelInfo>();
        // SAFETY: the model is valid, the struct is ours.
        ok(unsafe { nsp_model_info(self.model, &mut info) });
        info
    }

    /// Destroys renderer and model, whose frames are done.
    fn clear(&mut self) {
        // SAFETY: every frame is done; NULL is taken too.
        unsafe {
            nsp_renderer_destroy(std::mem::replace(&mut self.renderer, null_mut()));
            nsp_model_destroy(std::mem::replace(&mut self.model, null_mut()));
        }
    }

    fn path(&self) -> CString {
        c_path(&self.folder.path().join("model.ply"))
    }

    fn load(&mut self) -> NspResult {
        // SAFETY: device and path are valid.
        unsafe { nsp_model_load(self.device, self.path().as_ptr(), &mut self.model) }
    }

    fn create(&mut self) -> NspResult {
        // SAFETY: device and model are valid.
        unsafe { nsp_renderer_create(self.device, self.model, &mut self.renderer) }
    }

    fn image(&self) -> NspImage {
        image(self.picture.as_ref().unwrap())
    }

    /// Records and runs a frame.
    fn frame(&mut self, number: u64) -> NspResult {
        let (camera, color, commands) = (c_camera(), self.image(), self.host.begin());
        let render = render(commands, number, &camera, &color);
        // SAFETY: everything is valid, and the command buffer is recording.
        let recorded = unsafe { nsp_record_render(self.renderer, self.model, &render) };
        self.host.submit_frame(commands, number);
        self.host.wait_frame(number);
        recorded
    }

    /// The bytes of the image, RGB.
    fn pixels(&self) -> Vec<u8> {
        let pixels = self.host.read_layer(self.picture.as_ref().unwrap(), 0, PIXELS);
        pixels.iter().flat_map(|pixel| pixel.to_le_bytes()[..3].to_vec()).collect()
    }

    fn end(mut self) {
        self.clear();
        // SAFETY: what it made is destroyed; NULL is taken too.
        unsafe { nsp_device_destroy(self.device) };
        if let Some(picture) = self.picture.take() {
            self.host.free_picture(picture);
        }
        self.host.destroy();
    }
}

fn c_path(path: &Path) -> CString {
    CString::new(path.to_str().unwrap()).unwrap()
}

// ---------------------------------------------------------------------------
// As C calls it

#[test]
fn a_record_only_host_gets_our_own_render_without_a_submission_or_a_wait() {
    let mut session = Session::ready(|_| {});
    session.assert_draws(1, &Model::from(gaussians(2)));
    // SAFETY: the renderer is valid, the struct is ours.
    let mut status: NspStatus = unsafe { std::mem::zeroed() };
    status.struct_size = size_of::<NspStatus>();
    // SAFETY: as above.
    ok(unsafe { nsp_renderer_status(session.renderer, &mut status) });
    assert!(status.frame == 1 && status.intersections > 0 && status.left_out == 0, "{status:?}");
    assert!(status.device_bytes > 0);
    // SAFETY: the model is valid.
    assert_eq!(unsafe { nsp_model_count(session.model) }, 400);
    let info = session.info();
    assert_eq!((info.count, info.sh_degree, info.raw_colors), (400, 2, 0));
    session.end();
}

#[test]
fn a_model_of_arrays_is_that_of_the_file_and_joined_models_are_sorted_together() {
    let mut session = Session::new(|_| {});
    let (arrays, device) = (gaussians(2), session.device);
    let planes: [*const f32; 6] = [
        arrays.means().as_ptr().cast(),
        arrays.quats().as_ptr().cast(),
        arrays.log_scales().as_ptr().cast(),
        arrays.raw_opacities().as_ptr(),
        arrays.dc().as_ptr().cast(),
        arrays.rest().as_ptr().cast(),
    ];
    // SAFETY: six arrays of the right lengths.
    ok(unsafe { nsp_model_create(device, 400, 2, planes.as_ptr(), &mut session.model) });
    ok(session.create());
    session.assert_draws(1, &Model::from(arrays.clone()));

    // Turned and moved, and turned and moved back.
    let pose = DAffine3::from_rotation_translation(
        DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1),
        DVec3::new(0.5, -0.2, 0.3),
    );
    let rows = |pose: DAffine3| {
        let columns = pose.to_cols_array_2d();
        let mut rows = [0.0; 12];
        (0..12).for_each(|at| rows[at] = columns[at % 4][at / 4]);
        rows
    };
    let (mut there, mut back) = (null_mut(), null_mut());
    let models = [session.model.cast_const()];
    // SAFETY: one model and one pose each.
    unsafe {
        ok(nsp_model_join(device, models.as_ptr(), [rows(pose)].as_ptr(), 1, &mut there));
        let models = [there.cast_const()];
        let inverse = [rows(pose.inverse())];
        ok(nsp_model_join(device, models.as_ptr(), inverse.as_ptr(), 1, &mut back));
        nsp_model_destroy(there);
        nsp_model_destroy(std::mem::replace(&mut session.model, back));
    }
    session.assert_draws(2, &Model::from(arrays.clone()));

    // Two copies, one farther away.
    let mut both = null_mut();
    let models = [session.model.cast_const(); 2];
    let poses = [rows(DAffine3::IDENTITY), rows(DAffine3::from_translation(DVec3::Z))];
    // SAFETY: two models and two poses.
    ok(unsafe { nsp_model_join(device, models.as_ptr(), poses.as_ptr(), 2, &mut both) });
    // SAFETY: valid.
    assert_eq!(unsafe { nsp_model_count(both) }, 800);
    // The same as instances, of one upload and in any frame anew.
    let instances = poses.map(|pose| NspInstance { pose, ..whole(session.model) });
    let (camera, color) = (c_camera(), session.image());
    let draw = |number, model: *const NspModel, instances: &[NspInstance]| {
        let commands = session.host.begin();
        let render = NspRender {
            instance_count: instances.len() as u32,
            instances: if instances.is_empty() { null() } else { instances.as_ptr() },
            ..render(commands, number, &camera, &color)
        };
        // SAFETY: everything is valid, and the command buffer is recording.
        ok(unsafe { nsp_record_render(session.renderer, model, &render) });
        session.host.submit_frame(commands, number);
        session.host.wait_frame(number);
        session.pixels()
    };
    let joined = draw(3, both, &[]);
    assert_close(&draw(4, null(), &instances), &joined);
    let hidden = NspInstance { flags: NSP_INSTANCE_HIDDEN, ..instances[1] };
    assert_eq!(draw(5, null(), &[instances[0], hidden]), draw(6, null(), &instances[..1]));
    let scaled = [rows(DAffine3::from_scale(DVec3::splat(2.0)))];
    let mut none = null_mut();
    // SAFETY: as above.
    unsafe {
        let result = nsp_model_join(device, models.as_ptr(), scaled.as_ptr(), 1, &mut none);
        refused(result, NSP_ERROR_USAGE, &["nsp_model_join", "model 0", "not rigid"]);
        assert!(none.is_null());
        nsp_model_destroy(both);
    }
    session.end();
}

#[test]
fn a_model_that_states_its_law_is_drawn_as_its_dark_photographs_or_in_their_linear_light() {
    let mut session = Session::new(|_| {});
    let law = law();
    let model = Model { law: Some(law), ..gaussians(2).into() };
    model.save(session.folder.path().join("model.ply")).unwrap();
    session.prepare();
    assert_eq!(session.info().law_stops, law.stops());
    let inverse = InverseTone::of_law(&law);
    let planes = own_planes(&model);
    let drawn = |number, exposure, format: ImageFormat| {
        let picture = session.host.picture(format, SIZE).unwrap();
        let (camera, commands) = (c_camera(), session.host.begin());
        let color = NspImage { format: vulkan(format), ..image(&picture) };
        let flags = NSP_RENDER_PHOTOGRAPH;
        let render = NspRender { flags, exposure, ..render(commands, number, &camera, &color) };
        // SAFETY: everything is valid, and the command buffer is recording.
        ok(unsafe { nsp_record_render(session.renderer, session.model, &render) });
        session.host.submit_frame(commands, number);
        session.host.wait_frame(number);
        let words = if format == ImageFormat::Rgba16Float { 2 * PIXELS } else { PIXELS };
        let pixels = session.host.read_layer(&picture, 0, words);
        session.host.free_picture(picture);
        pixels
    };
    let dark = drawn(1, 0.0, ImageFormat::Rgba8Unorm);
    let linear = drawn(2, law.stops().exp2(), ImageFormat::Rgba16Float);
    let mut bright = 0;
    for at in 0..PIXELS {
        let alpha = 1.0 - f64::from(planes[3 * PIXELS + at]);
        let target = [0, 1, 2].map(|c| f64::from(planes[c * PIXELS + at]) / alpha.max(1e-9));
        let bytes = dark[at].to_le_bytes();
        let halves = [linear[2 * at], linear[2 * at] >> 16, linear[2 * at + 1]];
        for (c, x) in inverse.invert(inverse.shown(target)).into_iter().enumerate() {
            let byte = (255.0 * (x * alpha).clamp(0.0, 1.0)).round();
            assert!((f64::from(bytes[c]) - byte).abs() <= 1.0, "{at}: {bytes:?} {byte}");
            let light =
                f64::from(law.stops().exp2()) * f64::from(linear_from_srgb(x as f32)) * alpha;
            let half = f16::from_bits(halves[c] as u16).to_f64();
            assert!((half - light).abs() <= 2e-3 * light + 1e-6, "{at}: {half} {light}");
            bright += u32::from(light > 0.2);
        }
    }
    assert!(bright > 1000, "{bright} values are bright");
    session.end();
}

#[test]
fn an_engines_matrices_give_the_camera_whatever_its_axes() {
    let eye = DVec3::new(1.0, 2.0, -5.0);
    let rotation = DQuat::from_euler(glam::EulerRot::YXZ, 0.3, 0.2, 0.1);
    let pose = DAffine3::from_rotation_translation(rotation, eye).inverse();
    let (width, height) = (640u32, 480u32);
    // OpenGL's axes are x right, y up, z backward; the projection looks along -z and turns y over, or does not.
    let flips = |v: Vec3| Mat4::from_scale(v) * pose.as_mat4_of();
    let vertical = 0.9f32;
    let aspect = width as f32 / height as f32;
    let near = 0.1;
    let right_handed = Mat4::perspective_infinite_reverse_rh(vertical, aspect, near);
    let left_handed = Mat4::perspective_lh(vertical, aspect, near, 50.0);
    let turned = Mat4::from_scale(Vec3::new(1.0, -1.0, 1.0));
    let cases = [
        // y up in the view: Vulkan's clip space needs the projection to turn it over.
        (flips(Vec3::new(1.0, -1.0, -1.0)), turned * right_handed),
        // y down, z forward: OpenCV's axes.
        (flips(Vec3::ONE), left_handed),
        // y up, z forward: Unity's axes.
        (flips(Vec3::new(1.0, -1.0, 1.0)), turned * left_handed),
    ];
    let of_matrices = |view: &Mat4, projection: &Mat4| {
        // SAFETY: a valid struct of numbers.
        let mut camera: NspCamera = unsafe { std::mem::zeroed() };
        camera.struct_size = size_of::<NspCamera>();
        // SAFETY: sixteen floats each.
        ok(unsafe {
            nsp_camera_from_matrices(
                view.as_ref().as_ptr(),
                projection.as_ref().as_ptr(),
                width,
                height,
                &mut camera,
            )
        });
        camera.camera().unwrap()
    };
    for (view, projection) in cases {
        let converted = of_matrices(&view, &projection);
        let focal = f64::from(height) / 2.0 / f64::from(vertical / 2.0).tan();
        assert!((converted.focal - focal).abs().max_element() < 1e-2, "{converted:?}");
        assert!((converted.principal_point - glam::DVec2::new(320.0, 240.0)).length() < 1e-3);
        assert!(converted.view_from_world.abs_diff_eq(pose, 1e-6), "{converted:?}");
    }
    // Eight world units wide and off the axis, with the depth reversed or not.
    let backward = Mat4::orthographic_rh(-3.0, 5.0, -3.0, 3.0, near, 50.0);
    let forward = Mat4::orthographic_lh(-3.0, 5.0, -3.0, 3.0, 50.0, near);
    let parallel = [
        (flips(Vec3::new(1.0, -1.0, -1.0)), turned * backward),
        (flips(Vec3::ONE), forward),
        (flips(Vec3::new(1.0, -1.0, 1.0)), turned * forward),
    ];
    for (view, projection) in parallel {
        let converted = of_matrices(&view, &projection);
        assert_eq!(converted.model, CameraModel::Orthographic);
        assert!((converted.focal - 80.0).abs().max_element() < 1e-3, "{converted:?}");
        assert!((converted.principal_point - glam::DVec2::new(240.0, 240.0)).length() < 1e-3);
        assert!(converted.view_from_world.abs_diff_eq(pose, 1e-6), "{converted:?}");
    }
    let refuse = |view: &Mat4, projection: &Mat4, word: &str| {
        // SAFETY: as above.
        let mut camera: NspCamera = unsafe { std::mem::zeroed() };
        camera.struct_size = size_of::<NspCamera>();
        // SAFETY: as above.
        let result = unsafe {
            let (view, projection) = (view.as_ref().as_ptr(), projection.as_ref().as_ptr());
            nsp_camera_from_matrices(view, projection, width, height, &mut camera)
        };
        refused(result, NSP_ERROR_USAGE, &["nsp_camera_from_matrices", word]);
    };
    refuse(&Mat4::IDENTITY, &Mat4::ZERO, "neither perspective nor orthographic");
    let mut sheared = left_handed;
    sheared.y_axis.x = 0.5;
    refuse(&Mat4::IDENTITY, &sheared, "sheared");
    let mut broken = left_handed;
    broken.x_axis.x = f32::NAN;
    refuse(&Mat4::IDENTITY, &broken, "finite");
    // A projection with y up for a viewport of negative height, and a view that scales.
    refuse(&Mat4::IDENTITY, &right_handed, "projection[5]");
    refuse(&Mat4::from_scale(Vec3::splat(2.0)), &left_handed, "divide its scale out");
}

/// glam has no conversion of this kind.
trait AsMat4 {
    fn as_mat4_of(&self) -> Mat4;
}

impl AsMat4 for DAffine3 {
    fn as_mat4_of(&self) -> Mat4 {
        Mat4::from_cols_array(&glam::DMat4::from(*self).to_cols_array().map(|x| x as f32))
    }
}
