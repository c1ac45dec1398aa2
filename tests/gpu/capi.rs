//! The C interface, called as C calls it.

#![expect(unsafe_code, reason = "calls what C calls")]

use std::ffi::{CStr, CString, c_char, c_void};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock};

use ash::vk;
use ash::vk::Handle as _;
use glam::{DAffine3, DQuat, DVec3, Mat4, Vec3};
use nightsplat::base::random::Stream;
use nightsplat::camera::Camera;
use nightsplat::capi::camera::{NspCamera, nsp_camera_from_matrices};
use nightsplat::capi::device::*;
use nightsplat::capi::error::panics::panic_in;
use nightsplat::capi::error::*;
use nightsplat::capi::model::*;
use nightsplat::capi::render::*;
use nightsplat::capi::train::*;
use nightsplat::gpu::ImageFormat;
use nightsplat::gpu::testing::{allocations, fail_allocation, gpu};
use nightsplat::photographs::dataset::synthetic::{SyntheticOptions, write};
use nightsplat::splats::model::Model;
use nightsplat::splats::render::{RenderOptions, Renderer};
use nightsplat::splats::scene::Gaussians;

use crate::host::{Host, Picture, usual_extensions};

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
        width: SIZE[0],
        height: SIZE[1],
        focal: [300.0; 2],
        principal_point: [160.0, 120.0],
        view_from_world: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0],
    }
}

/// The bytes of our own render before black, RGB.
fn own_render(model: &Model) -> Vec<u8> {
    let gpu = gpu();
    let on_device = model.gaussians.upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, model.render_settings()).unwrap();
    let camera = Camera::from(&c_camera());
    renderer.reserve(on_device.layout.count, [&camera]).unwrap();
    let sh_degree = model.gaussians.shape.sh_degree;
    let options = RenderOptions { sh_degree, background: [0.0; 3] };
    let image = renderer.render_image(&on_device, &camera, &options).unwrap();
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    (0..PIXELS).flat_map(|at| [0, 1, 2].map(|c| byte(image.data[c * PIXELS + at]))).collect()
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
    let state = |layout, stages, access| NspImageState {
        layout,
        family: vk::QUEUE_FAMILY_IGNORED,
        stages,
        access,
    };
    NspImage {
        image: picture.image,
        format: vk::Format::R8G8B8A8_UNORM,
        extent: vk::Extent2D { width: picture.size[0], height: picture.size[1] },
        layer: 0,
        before: state(
            vk::ImageLayout::UNDEFINED,
            vk::PipelineStageFlags2::NONE,
            vk::AccessFlags2::NONE,
        ),
        after: state(
            vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
            vk::PipelineStageFlags2::COPY,
            vk::AccessFlags2::TRANSFER_READ,
        ),
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
        reserved: 0,
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
        let [pixels, _] = self.host.read_first_layer(self.picture.as_ref().unwrap(), PIXELS);
        pixels.iter().flat_map(|pixel| pixel.to_le_bytes()[..3].to_vec()).collect()
    }

    fn end(mut self) {
        // SAFETY: every frame is done; NULL is taken too.
        unsafe {
            nsp_renderer_destroy(self.renderer);
            nsp_model_destroy(self.model);
            nsp_device_destroy(self.device);
        }
        if let Some(picture) = self.picture.take() {
            self.host.free_picture(picture);
        }
        let messages = self.host.destroy();
        assert!(messages.is_empty(), "validation: {messages:#?}");
    }
}

fn c_path(path: &Path) -> CString {
    CString::new(path.to_str().unwrap()).unwrap()
}

// ---------------------------------------------------------------------------
// As C calls it

#[test]
fn a_record_only_host_gets_our_own_render_without_a_submission_or_a_wait() {
    let mut session = Session::new(|_| {});
    ok(session.load());
    ok(session.create());
    ok(session.frame(1));
    assert_close(&session.pixels(), &own_render(&Model::from(gaussians(2))));
    // SAFETY: the renderer is valid, the struct is ours.
    let mut status: NspStatus = unsafe { std::mem::zeroed() };
    status.struct_size = size_of::<NspStatus>();
    // SAFETY: as above.
    ok(unsafe { nsp_renderer_status(session.renderer, &mut status) });
    assert!(status.frame == 1 && status.intersections > 0 && status.left_out == 0, "{status:?}");
    assert!(status.device_bytes > 0);
    // SAFETY: the model is valid.
    assert_eq!(unsafe { nsp_model_count(session.model) }, 400);
    // SAFETY: as above.
    let mut info: NspModelInfo = unsafe { std::mem::zeroed() };
    info.struct_size = size_of::<NspModelInfo>();
    // SAFETY: as above.
    ok(unsafe { nsp_model_info(session.model, &mut info) });
    assert_eq!((info.count, info.sh_degree, info.raw_colors), (400, 2, 0));
    session.end();
}

#[test]
fn a_model_of_arrays_is_that_of_the_file_and_joined_models_are_sorted_together() {
    let mut session = Session::new(|_| {});
    let (own, device) = (gaussians(2), session.device);
    let planes: [*const f32; 6] = [
        own.means().as_ptr().cast(),
        own.quats().as_ptr().cast(),
        own.log_scales().as_ptr().cast(),
        own.raw_opacities().as_ptr(),
        own.dc().as_ptr().cast(),
        own.rest().as_ptr().cast(),
    ];
    // SAFETY: six arrays of the right lengths.
    ok(unsafe { nsp_model_create(device, 400, 2, planes.as_ptr(), &mut session.model) });
    ok(session.create());
    ok(session.frame(1));
    assert_close(&session.pixels(), &own_render(&Model::from(own.clone())));

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
    ok(session.frame(2));
    assert_close(&session.pixels(), &own_render(&Model::from(own.clone())));

    // Two of them are as many Gaussians, and pass for one behind the other.
    let mut both = null_mut();
    let models = [session.model.cast_const(); 2];
    let poses = [rows(DAffine3::IDENTITY), rows(DAffine3::from_translation(DVec3::Z))];
    // SAFETY: two models and two poses.
    ok(unsafe { nsp_model_join(device, models.as_ptr(), poses.as_ptr(), 2, &mut both) });
    // SAFETY: valid.
    assert_eq!(unsafe { nsp_model_count(both) }, 800);
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
    for (view, projection) in cases {
        // SAFETY: a valid struct of numbers.
        let mut camera: NspCamera = unsafe { std::mem::zeroed() };
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
        let own = Camera::from(&camera);
        let focal = f64::from(height) / 2.0 / f64::from(vertical / 2.0).tan();
        assert!((own.focal - focal).abs().max_element() < 1e-2, "{own:?}");
        assert!((own.principal_point - glam::DVec2::new(320.0, 240.0)).length() < 1e-3);
        assert!(own.view_from_world.abs_diff_eq(pose, 1e-6), "{own:?}");
    }
    let refuse = |view: &Mat4, projection: &Mat4, word: &str| {
        // SAFETY: as above.
        let mut camera: NspCamera = unsafe { std::mem::zeroed() };
        // SAFETY: as above.
        let result = unsafe {
            let (view, projection) = (view.as_ref().as_ptr(), projection.as_ref().as_ptr());
            nsp_camera_from_matrices(view, projection, width, height, &mut camera)
        };
        refused(result, NSP_ERROR_USAGE, &["nsp_camera_from_matrices", word]);
    };
    let orthographic = Mat4::orthographic_rh(-1.0, 1.0, -1.0, 1.0, 0.1, 10.0);
    refuse(&Mat4::IDENTITY, &orthographic, "perspective");
    let mut sheared = left_handed;
    sheared.y_axis.x = 0.5;
    refuse(&Mat4::IDENTITY, &sheared, "sheared");
    let mut broken = left_handed;
    broken.x_axis.x = f32::NAN;
    refuse(&Mat4::IDENTITY, &broken, "finite");
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

// ---------------------------------------------------------------------------
// Threads

static HELD: AtomicBool = AtomicBool::new(false);
static LOCKED: AtomicU64 = AtomicU64::new(0);
static QUEUE: Mutex<()> = Mutex::new(());
thread_local!(static GUARD: std::cell::RefCell<Option<std::sync::MutexGuard<'static, ()>>> =
    const { std::cell::RefCell::new(None) });

unsafe extern "C" fn lock_queue(_: *mut c_void, _: vk::Queue) {
    let guard = QUEUE.lock().unwrap();
    assert!(!HELD.swap(true, Ordering::AcqRel), "the lock is held twice");
    LOCKED.fetch_add(1, Ordering::AcqRel);
    GUARD.with_borrow_mut(|own| *own = Some(guard));
}

unsafe extern "C" fn unlock_queue(_: *mut c_void, _: vk::Queue) {
    HELD.store(false, Ordering::Release);
    GUARD.with_borrow_mut(|own| *own = None);
}

#[test]
fn a_trainer_and_its_host_submit_from_two_threads_under_the_hosts_lock() {
    let session = Session::with_flags(0, |lent| {
        lent.lock_queue = Some(lock_queue);
        lent.unlock_queue = Some(unlock_queue);
    });
    let dataset = session.folder.path().join("dataset");
    let options = SyntheticOptions { width: 24, height: 20, ..SyntheticOptions::default() };
    write(&dataset, &options).unwrap();
    let (dataset, config) =
        (c_path(&dataset), CString::new("steps = 40\nmax_gaussians = 300\n").unwrap());
    let is_done = AtomicBool::new(false);
    let submitted = AtomicU64::new(0);
    let device = Shared(session.device);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_done.load(Ordering::Acquire) {
                session.host.submit_empty(|submit| {
                    // SAFETY: both are this test's.
                    unsafe { lock_queue(null_mut(), session.host.queue) };
                    submit();
                    // SAFETY: as above.
                    unsafe { unlock_queue(null_mut(), session.host.queue) };
                });
                submitted.fetch_add(1, Ordering::AcqRel);
            }
        });
        let device = device.get();
        let mut trainer = null_mut();
        // SAFETY: everything is valid, on this thread alone but for the device.
        unsafe {
            ok(nsp_trainer_create(device, dataset.as_ptr(), config.as_ptr(), &mut trainer));
            let (mut last, mut steps) =
                (0, [NspStep { step: 0, loss: 0.0, gaussians: 0, reserved: 0 }; 64]);
            while last < 40 {
                let mut count = 64;
                ok(nsp_trainer_advance(trainer, 40, steps.as_mut_ptr(), &mut count));
                assert!(count > 0, "the training ended at step {last}");
                last = steps[count as usize - 1].step;
                assert!(steps[..count as usize].iter().all(|step| step.loss.is_finite()));
            }
            let mut model = null_mut();
            ok(nsp_trainer_model(trainer, &mut model));
            assert!(nsp_model_count(model) > 0);
            nsp_model_destroy(model);
            let saved = c_path(&session.folder.path().join("trained.spz"));
            ok(nsp_trainer_save(trainer, saved.as_ptr()));
            nsp_trainer_destroy(trainer);
        }
        is_done.store(true, Ordering::Release);
    });
    assert!(session.folder.path().join("trained.spz").exists());
    let (locked, submitted) = (LOCKED.load(Ordering::Acquire), submitted.load(Ordering::Acquire));
    assert!(submitted > 0 && locked > submitted, "{locked} locks, {submitted} of the host's");
    session.end();
}

/// A pointer that another thread may use.
struct Shared(*mut NspDevice);
// SAFETY: any thread may use a device.
unsafe impl Sync for Shared {}
impl Shared {
    fn get(&self) -> *mut NspDevice {
        self.0
    }
}

#[test]
fn two_devices_and_two_renderers_on_one_draw_from_threads_of_their_own() {
    let run = || {
        let mut session = Session::new(|_| {});
        ok(session.load());
        ok(session.create());
        for frame in 1..=3 {
            ok(session.frame(frame));
        }
        let pixels = session.pixels();
        session.end();
        pixels
    };
    let expected = own_render(&Model::from(gaussians(2)));
    std::thread::scope(|scope| {
        let both = [scope.spawn(run), scope.spawn(run)];
        both.into_iter().for_each(|thread| assert_close(&thread.join().unwrap(), &expected));
    });

    // Each with a renderer of its own on one device: they record, and the host orders what it submits.
    let mut session = Session::new(|_| {});
    ok(session.load());
    let picture = session.host.picture(ImageFormat::Rgba8Unorm, SIZE).unwrap();
    let (color, model, device) =
        (image(&picture), SharedModel(session.model), Shared(session.device));
    let turn = Mutex::new(0u64);
    let host = &session.host;
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                let mut renderer = null_mut();
                let model = model.get();
                // SAFETY: valid; the renderer is this thread's.
                ok(unsafe { nsp_renderer_create(device.get(), model, &mut renderer) });
                for _ in 0..4 {
                    let mut frame = turn.lock().unwrap();
                    *frame += 1;
                    let (camera, commands) = (c_camera(), host.begin());
                    let render = render(commands, *frame, &camera, &color);
                    // SAFETY: as above.
                    ok(unsafe { nsp_record_render(renderer, model, &render) });
                    host.submit_frame(commands, *frame);
                    host.wait_frame(*frame);
                }
                // SAFETY: its frames are done.
                unsafe { nsp_renderer_destroy(renderer) };
            });
        }
    });
    let [pixels, _] = host.read_first_layer(&picture, PIXELS);
    let pixels: Vec<u8> = pixels.iter().flat_map(|p| p.to_le_bytes()[..3].to_vec()).collect();
    assert_close(&pixels, &expected);
    session.host.free_picture(picture);
    session.end();
}

struct SharedModel(*mut NspModel);
// SAFETY: the threads only read it, one at a time.
unsafe impl Sync for SharedModel {}
impl SharedModel {
    fn get(&self) -> *mut NspModel {
        self.0
    }
}

// ---------------------------------------------------------------------------
// What is refused

#[test]
fn every_bad_device_is_refused_by_code_and_name() {
    let host = Host::new(usual_extensions());
    let good = lend(&host, NSP_DEVICE_RECORD_ONLY);
    let mut device = null_mut();
    let mut refuse = |change: &dyn Fn(&mut NspHostDevice), code, words: &[&str]| {
        let mut lent = good;
        change(&mut lent);
        // SAFETY: what is wrong is refused before it is used.
        refused(unsafe { nsp_device_from_host(&lent, &mut device) }, code, words);
        assert!(device.is_null());
    };
    refuse(&|lent| lent.struct_size = 0, NSP_ERROR_USAGE, &["NspHostDevice::struct_size", "0"]);
    refuse(&|lent| lent.struct_size = 8, NSP_ERROR_VERSION, &["NspHostDevice::struct_size", "8"]);
    refuse(
        &|lent| lent.get_instance_proc_addr = None,
        NSP_ERROR_USAGE,
        &["nsp_device_from_host", "NspHostDevice::get_instance_proc_addr"],
    );
    refuse(&|lent| lent.instance = vk::Instance::null(), NSP_ERROR_USAGE, &["::instance"]);
    refuse(
        &|lent| lent.physical_device = vk::PhysicalDevice::null(),
        NSP_ERROR_USAGE,
        &["::physical_device"],
    );
    refuse(&|lent| lent.device = vk::Device::null(), NSP_ERROR_USAGE, &["::device"]);
    refuse(&|lent| lent.flags &= !NSP_DEVICE_RECORD_ONLY, NSP_ERROR_USAGE, &["::queue"]);
    refuse(&|lent| lent.lock_queue = Some(lock_queue), NSP_ERROR_USAGE, &["lock_queue", "both"]);
    refuse(&|lent| lent.extension_count = 1, NSP_ERROR_USAGE, &["::extensions"]);
    let functions = NspMemoryFunctions { allocate: None, free: None, user: null_mut() };
    refuse(&|lent| lent.device_memory = &functions, NSP_ERROR_USAGE, &["device_memory"]);
    refuse(&|lent| lent.queue_family = 7, NSP_ERROR_USAGE, &["queue_family", "7"]);
    // A chain of features without one that is needed.
    let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default().synchronization2(true);
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
    // SAFETY: valid structs.
    unsafe { nsp_require_features(&mut vulkan12, null_mut()) };
    let chain =
        vk::PhysicalDeviceFeatures2::default().push_next(&mut vulkan12).push_next(&mut vulkan13);
    let features = (&raw const chain).cast();
    refuse(&|lent| lent.features = features, NSP_ERROR_DEVICE, &["subgroupSizeControl"]);
    // SAFETY: NULL is refused.
    unsafe {
        refused(nsp_device_from_host(null(), &mut null_mut()), NSP_ERROR_USAGE, &["NspHostDevice"]);
        refused(nsp_device_from_host(&good, null_mut()), NSP_ERROR_USAGE, &["device"]);
        let check = nsp_check_device(None, good.instance, good.physical_device);
        refused(check, NSP_ERROR_USAGE, &["get_instance_proc_addr"]);
        ok(nsp_check_device(good.get_instance_proc_addr, good.instance, good.physical_device));
    }
    let messages = host.destroy();
    assert!(messages.is_empty(), "validation: {messages:#?}");
}

#[test]
fn structs_grow_by_zeros() {
    let host = Host::new(usual_extensions());
    let good = lend(&host, NSP_DEVICE_RECORD_ONLY);
    #[repr(C)]
    #[derive(Clone, Copy)]
    struct Later {
        own: NspHostDevice,
        more: [u64; 2],
    }
    let mut later = Later { own: good, more: [0; 2] };
    later.own.struct_size = size_of::<Later>();
    let mut device = null_mut();
    // SAFETY: the struct is as long as it says.
    unsafe {
        ok(nsp_device_from_host((&raw const later).cast(), &mut device));
        nsp_device_destroy(device);
        later.more[1] = 1;
        let result = nsp_device_from_host((&raw const later).cast(), &mut device);
        refused(result, NSP_ERROR_VERSION, &["NspHostDevice", "not 0"]);
    }
    let messages = host.destroy();
    assert!(messages.is_empty(), "validation: {messages:#?}");
}

#[test]
fn every_bad_render_is_refused_by_code_and_name_and_nothing_is_recorded() {
    let mut session = Session::new(|_| {});
    ok(session.load());
    ok(session.create());
    let (camera, color) = (c_camera(), session.image());
    let commands = session.host.begin();
    let good = render(commands, 5, &camera, &color);
    let (renderer, model) = (session.renderer, session.model);
    let refuse = |change: &dyn Fn(&mut NspRender), code, words: &[&str]| {
        let mut render = good;
        change(&mut render);
        // SAFETY: what is wrong is refused before it is used.
        refused(unsafe { nsp_record_render(renderer, model, &render) }, code, words);
    };
    // SAFETY: NULL is refused.
    unsafe {
        let null_renderer = nsp_record_render(null_mut(), model, &good);
        refused(null_renderer, NSP_ERROR_USAGE, &["nsp_record_render", "renderer is NULL"]);
        refused(nsp_record_render(renderer, null(), &good), NSP_ERROR_USAGE, &["model is NULL"]);
        refused(
            nsp_record_render(renderer, model, null()),
            NSP_ERROR_USAGE,
            &["NspRender is NULL"],
        );
    }
    refuse(&|own| own.struct_size = 0, NSP_ERROR_USAGE, &["NspRender::struct_size"]);
    refuse(&|own| own.commands = vk::CommandBuffer::null(), NSP_ERROR_USAGE, &["::commands"]);
    refuse(&|own| own.cameras = null(), NSP_ERROR_USAGE, &["::cameras"]);
    refuse(&|own| own.camera_count = 0, NSP_ERROR_USAGE, &["::cameras"]);
    refuse(&|own| own.flags = 1 << 20, NSP_ERROR_USAGE, &["::flags", "0x100000"]);
    refuse(&|own| own.color = null(), NSP_ERROR_USAGE, &["no target"]);
    refuse(&|own| own.exposure = f32::INFINITY, NSP_ERROR_USAGE, &["exposure"]);
    let with = |change: &dyn Fn(&mut NspImage), code, words: &[&str]| {
        let mut image = color;
        change(&mut image);
        refuse(&|own| own.color = &image, code, words);
    };
    with(&|own| own.image = vk::Image::null(), NSP_ERROR_USAGE, &["color", "null"]);
    with(&|own| own.format = vk::Format::R8_UNORM, NSP_ERROR_USAGE, &["::color", "RGBA16F"]);
    with(&|own| own.extent.width = 10, NSP_ERROR_USAGE, &["color", "10x240", "320x240"]);
    refuse(&|own| own.depth_out = &color, NSP_ERROR_USAGE, &["depth", "R32Float"]);
    refuse(&|own| own.scene_depth = &color, NSP_ERROR_USAGE, &["scene depth"]);
    let with = |change: &dyn Fn(&mut NspCamera), words: &[&str]| {
        let mut other = camera;
        change(&mut other);
        refuse(&|own| own.cameras = &other, NSP_ERROR_USAGE, words);
    };
    with(&|own| own.width = 0, &["camera 0", "0x240"]);
    with(&|own| own.focal[1] = 0.0, &["focal"]);
    with(&|own| own.view_from_world[3] = f64::NAN, &["not finite"]);
    with(&|own| own.view_from_world[0] = 1.1, &["not rigid"]);
    // A view beyond what the device follows names the longest side it takes.
    with(&|own| (own.width, own.height) = (1 << 20, 1 << 20), &["color"]);

    // Nothing was recorded: the frame's number has not moved either.
    // SAFETY: everything is valid.
    ok(unsafe { nsp_record_render(renderer, model, &NspRender { frame: 4, ..good }) });
    refuse(&|own| own.frame = 3, NSP_ERROR_USAGE, &["frame 3", "frame 4"]);
    session.host.submit_frame(commands, 4);
    session.host.wait_frame(4);
    assert_close(&session.pixels(), &own_render(&Model::from(gaussians(2))));
    session.end();
}

#[test]
fn every_bad_model_is_refused_by_code_and_name() {
    let mut session = Session::new(|_| {});
    let (device, folder) = (session.device, session.folder.path().to_owned());
    let mut model = null_mut();
    let mut load = |path: &Path, code, words: &[&str]| {
        // SAFETY: valid.
        let result = unsafe { nsp_model_load(device, c_path(path).as_ptr(), &mut model) };
        refused(result, code, words);
        assert!(model.is_null());
    };
    load(&folder.join("absent.ply"), NSP_ERROR_INPUT, &["absent.ply"]);
    let bytes = std::fs::read(folder.join("model.ply")).unwrap();
    std::fs::write(folder.join("cut.ply"), &bytes[..bytes.len() - 100]).unwrap();
    load(&folder.join("cut.ply"), NSP_ERROR_INPUT, &["cut.ply"]);
    let mut broken = gaussians(0);
    broken.means_mut()[7] = Vec3::NAN;
    broken.save(folder.join("nan.ply")).unwrap();
    load(&folder.join("nan.ply"), NSP_ERROR_INPUT, &["nan.ply", "finite"]);
    // SAFETY: NULL and the rest are refused.
    unsafe {
        let result = nsp_model_load(device, null(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["nsp_model_load", "path is NULL"]);
        let latin = [0xe9u8, 0];
        let result = nsp_model_load(device, latin.as_ptr().cast::<c_char>(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["path is not UTF-8"]);
        refused(nsp_model_load(null_mut(), null(), &mut model), NSP_ERROR_USAGE, &["device"]);
        let planes = [null(); 6];
        let result = nsp_model_create(device, 3, 4, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["sh_degree is 4"]);
        let result = nsp_model_create(device, 3, 0, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["plane 0", "means"]);
        let nan = [f32::NAN; 16];
        let planes = [nan.as_ptr(); 6];
        let result = nsp_model_create(device, 3, 0, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_NOT_FINITE, &["plane 0", "means"]);
        let result = nsp_model_join(device, null(), null(), 0, &mut model);
        refused(result, NSP_ERROR_USAGE, &["no models"]);
        assert_eq!(nsp_model_count(null()), 0);
    }
    // A model of another device.
    let mut other = Session::new(|_| {});
    ok(other.load());
    session.model = other.model;
    refused(session.create(), NSP_ERROR_USAGE, &["nsp_renderer_create", "another device"]);
    session.model = null_mut();
    // Training where nothing may be submitted.
    let mut trainer = null_mut();
    // SAFETY: valid.
    unsafe {
        let result = nsp_trainer_create(device, c".".as_ptr(), null(), &mut trainer);
        refused(result, NSP_ERROR_USAGE, &["nsp_trainer_create", "record-only"]);
    }
    other.end();
    session.end();
}

#[test]
fn a_panic_becomes_a_code_and_leaves_the_object_to_be_destroyed() {
    let mut session = Session::new(|_| {});
    ok(session.load());
    ok(session.create());
    ok(session.frame(1));
    panic_in("the renderer");
    refused(session.frame(2), NSP_ERROR_INTERNAL, &["nsp_record_render", "a bug of nightsplat"]);
    refused(session.frame(3), NSP_ERROR_INTERNAL, &["the renderer", "destroy it"]);
    // The device and the model are as they were.
    // SAFETY: valid, and its frames are done.
    unsafe { nsp_renderer_destroy(session.renderer) };
    ok(session.create());
    ok(session.frame(4));
    panic_in("nsp_model_load");
    let mut model = null_mut();
    // SAFETY: valid.
    let result = unsafe { nsp_model_load(session.device, session.path().as_ptr(), &mut model) };
    refused(result, NSP_ERROR_INTERNAL, &["nsp_model_load"]);
    session.end();
}

#[test]
fn memory_that_runs_out_anywhere_is_a_code_and_the_next_try_draws() {
    let mut session = Session::new(|_| {});
    // SAFETY: valid.
    let gpu = unsafe { &*session.device }.gpu();
    fail_allocation(&gpu, 0);
    ok(session.load());
    ok(session.create());
    ok(session.frame(1));
    let sites = allocations(&gpu);
    assert!(sites.len() > 20, "{sites:?}");
    let expected = session.pixels();
    for number in 1..=sites.len() as u64 {
        let frame = 2 * number;
        // SAFETY: every frame is done; both are replaced.
        unsafe {
            nsp_renderer_destroy(std::mem::replace(&mut session.renderer, null_mut()));
            nsp_model_destroy(std::mem::replace(&mut session.model, null_mut()));
        }
        fail_allocation(&gpu, number);
        let mut result = session.load();
        if result == NSP_OK {
            result = session.create();
        }
        if result == NSP_OK {
            result = session.frame(frame);
        }
        let site = &sites[number as usize - 1];
        assert_eq!(result, NSP_ERROR_MEMORY, "{site} ({number}): {}", last_error());
        fail_allocation(&gpu, 0);
        if session.model.is_null() {
            ok(session.load());
        }
        if session.renderer.is_null() {
            ok(session.create());
        }
        ok(session.frame(frame + 1));
        assert_eq!(session.pixels(), expected, "{site}");
    }
    // A device of the host's goes last.
    drop(gpu);
    session.end();
}

/// The host's allocator: counts what is out, fails on demand, or misaligns.
struct HostMemory {
    device: ash::Device,
    out: AtomicU64,
    wrong: AtomicU64,
}

unsafe extern "C" fn allocate(
    user: *mut c_void,
    requirements: *const vk::MemoryRequirements,
    _: vk::MemoryPropertyFlags,
    _: vk::MemoryPropertyFlags,
    name: *const c_char,
    out: *mut NspMemory,
) -> vk::Result {
    // SAFETY: as the library promises.
    unsafe {
        let own = &*user.cast::<HostMemory>();
        assert!(!CStr::from_ptr(name).to_bytes().is_empty());
        match own.wrong.load(Ordering::Acquire) {
            1 => return vk::Result::ERROR_OUT_OF_DEVICE_MEMORY,
            2 => {
                own.out.fetch_add(1, Ordering::AcqRel);
                (*out).offset = 3;
                return vk::Result::SUCCESS;
            }
            _ => (),
        }
        let needed = &*requirements;
        // lavapipe's one type has every property; other devices take part in the other tests.
        let info = vk::MemoryAllocateInfo::default()
            .allocation_size(needed.size)
            .memory_type_index(needed.memory_type_bits.trailing_zeros());
        let memory = own.device.allocate_memory(&info, None).unwrap();
        let mapped = own.device.map_memory(memory, 0, vk::WHOLE_SIZE, Default::default());
        *out = NspMemory { memory, offset: 0, mapped: mapped.unwrap(), cookie: null_mut() };
        own.out.fetch_add(1, Ordering::AcqRel);
        vk::Result::SUCCESS
    }
}

unsafe extern "C" fn free(user: *mut c_void, memory: *const NspMemory) {
    // SAFETY: as the library promises.
    unsafe {
        let own = &*user.cast::<HostMemory>();
        if (*memory).memory != vk::DeviceMemory::null() {
            own.device.free_memory((*memory).memory, None);
            own.out.fetch_sub(1, Ordering::AcqRel);
        } else if own.wrong.load(Ordering::Acquire) == 2 {
            own.out.fetch_sub(1, Ordering::AcqRel);
        }
    }
}

#[test]
fn the_hosts_allocator_gives_all_memory_and_gets_it_back() {
    if !gpu().properties().is_cpu {
        eprintln!(
            "not run: this host's allocator is for a device whose memory types are all mapped"
        );
        return;
    }
    let own = OnceLock::new();
    let mut functions =
        NspMemoryFunctions { allocate: Some(allocate), free: Some(free), user: null_mut() };
    let mut session = Session::new(|lent| {
        // SAFETY: the handles are live.
        let device = unsafe {
            let get =
                ash::StaticFn { get_instance_proc_addr: lent.get_instance_proc_addr.unwrap() };
            let instance = ash::Instance::load(&get, lent.instance);
            ash::Device::load(instance.fp_v1_0(), lent.device)
        };
        let memory = HostMemory { device, out: AtomicU64::new(0), wrong: AtomicU64::new(0) };
        functions.user = (&raw const *own.get_or_init(|| memory)).cast_mut().cast();
        lent.device_memory = &functions;
    });
    let own = own.get().unwrap();
    ok(session.load());
    ok(session.create());
    ok(session.frame(1));
    assert_close(&session.pixels(), &own_render(&Model::from(gaussians(2))));
    let out = own.out.load(Ordering::Acquire);
    assert!(out > 20, "{out}");
    let mut model = null_mut();
    for (wrong, code, words) in
        [(1, NSP_ERROR_MEMORY, "ERROR_OUT_OF_DEVICE_MEMORY"), (2, NSP_ERROR_INTERNAL, "offset 3")]
    {
        own.wrong.store(wrong, Ordering::Release);
        let device = session.device;
        // SAFETY: valid.
        let result = unsafe { nsp_model_load(device, session.path().as_ptr(), &mut model) };
        refused(result, code, &["nsp_model_load", words]);
        assert_eq!(own.out.load(Ordering::Acquire), out);
    }
    own.wrong.store(0, Ordering::Release);
    // SAFETY: every frame is done.
    unsafe {
        nsp_renderer_destroy(std::mem::replace(&mut session.renderer, null_mut()));
        nsp_model_destroy(std::mem::replace(&mut session.model, null_mut()));
        ok(nsp_frames_done(session.device, u64::MAX));
    }
    assert_eq!(own.out.load(Ordering::Acquire), 0);
    session.end();
}

// ---------------------------------------------------------------------------
// The library as C sees it

/// The library and its header, laid out by `scripts/build-capi.sh`, once.
fn library() -> &'static Path {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("capi");
        let mut command = Command::new(root.join("scripts/build-capi.sh"));
        command.arg(&out).env("NIGHTSPLAT_PROFILE", "dev").args(["--offline", "--quiet"]);
        let built = command.output().unwrap();
        assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
        out
    })
}

/// Compiles a source file with every warning an error.
fn compile(compiler: &str, standard: &str, source: &Path, more: &[&str]) -> PathBuf {
    let library = library();
    let out = library.join(source.file_stem().unwrap());
    let mut command = Command::new(compiler);
    command.arg(standard).args(["-Wall", "-Wextra", "-pedantic", "-Werror"]).arg(source);
    command.arg("-I").arg(library.join("include")).args(more).arg("-o").arg(&out);
    let compiled = command.output().unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    out
}

fn linked() -> Vec<String> {
    let lib = library().join("lib");
    let lib = lib.to_str().unwrap();
    vec![
        format!("-L{lib}"),
        "-lnightsplat".to_owned(),
        "-lvulkan".to_owned(),
        format!("-Wl,-rpath,{lib}"),
    ]
}

/// The Vulkan headers and the loader to link with; hosts have them.
fn has_vulkan_headers() -> bool {
    let found = Command::new("pkg-config").args(["--exists", "vulkan"]).status();
    let is_there = found.is_ok_and(|status| status.success());
    assert!(is_there || std::env::var_os("CI").is_none(), "install libvulkan-dev");
    if !is_there {
        eprintln!("not run: the Vulkan headers are not installed (libvulkan-dev)");
    }
    is_there
}

#[test]
fn the_c_host_draws_our_own_render_without_a_message() {
    if !has_vulkan_headers() {
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let linked = linked();
    let linked: Vec<&str> = linked.iter().map(String::as_str).collect();
    let program = compile("cc", "-std=c99", &root.join("examples/c/embed.c"), &linked);
    let folder = tempfile::tempdir().unwrap();
    let model = Model::from(gaussians(2));
    model.save(folder.path().join("model.ply")).unwrap();
    let run = |model: &str| {
        let mut command = Command::new(&program);
        command.current_dir(folder.path()).args([model, "out.ppm"]);
        // The layer writes its messages to standard output.
        command.env("VK_INSTANCE_LAYERS", "VK_LAYER_KHRONOS_validation");
        command
            .env("VK_LAYER_ENABLES", "VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT");
        command.output().unwrap()
    };
    let done = run("model.ply");
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success(), "{said} {}", String::from_utf8_lossy(&done.stderr));
    assert!(!said.contains("Validation"), "{said}");
    let file = std::fs::read(folder.path().join("out.ppm")).unwrap();
    let pixels = &file[file.len() - 3 * PIXELS..];
    assert_close(pixels, &own_render(&model));

    let failed = run("absent.ply");
    let said = String::from_utf8_lossy(&failed.stdout).into_owned();
    assert!(!failed.status.success() && !said.contains("Validation"), "{said}");
    let error = String::from_utf8_lossy(&failed.stderr);
    assert!(error.contains("nsp_model_load: absent.ply") && error.contains("(-3)"), "{error}");
}

#[test]
fn the_header_is_c_and_cpp_and_names_what_the_library_exports() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("header.c");
    std::fs::write(&source, "#include <nightsplat.h>\nint main(void) { return 0; }\n").unwrap();
    compile("cc", "-std=c99", &source, &[]);
    compile("c++", "-std=c++11", &source, &["-x", "c++"]);
    let header = std::fs::read_to_string(library().join("include/nightsplat.h")).unwrap();
    let declared = header.lines().filter_map(|line| {
        let name = line.split('(').next()?.rsplit([' ', '*']).next()?;
        (line.contains('(') && !line.starts_with(['/', '#', ' ', '*']) && name.starts_with("nsp_"))
            .then(|| name.to_owned())
    });
    let declared: std::collections::BTreeSet<String> = declared.collect();
    let shared = library().join("lib/libnightsplat.so");
    let exported = Command::new("nm").args(["-D", "--defined-only"]).arg(shared).output().unwrap();
    let exported = String::from_utf8(exported.stdout).unwrap();
    let exported: std::collections::BTreeSet<String> = exported
        .lines()
        .filter_map(|line| line.split_whitespace().nth(2))
        .map(str::to_owned)
        .collect();
    assert_eq!(exported, declared);
    assert_eq!(nsp_version(), NSP_HEADER_VERSION);
}

/// Offsets in Rust, and the C that prints its own.
macro_rules! layouts {
    ($($name:ident { $($member:ident),* $(,)? })*) => {{
        let rust = vec![$(
            format!("{} {}", stringify!($name), size_of::<$name>()),
            $(format!(
                "{}.{} {}",
                stringify!($name), stringify!($member), std::mem::offset_of!($name, $member)
            ),)*
        )*];
        let c = vec![$(
            format!("printf(\"{0} %zu\\n\", sizeof({0}));", stringify!($name)),
            $(format!(
                "printf(\"{0}.{1} %zu\\n\", offsetof({0}, {1}));",
                stringify!($name), stringify!($member)
            ),)*
        )*];
        (rust, c)
    }};
}

#[test]
fn every_member_is_where_c_has_it() {
    if !has_vulkan_headers() {
        return;
    }
    let (rust, c) = layouts! {
        NspMemory { memory, offset, mapped, cookie }
        NspMemoryFunctions { allocate, free, user }
        NspHostDevice {
            struct_size, get_instance_proc_addr, instance, physical_device, device, queue, queue_family, flags,
            extensions, extension_count, features, lock_queue, unlock_queue, user, pipeline_cache, host_memory,
            device_memory, frames,
        }
        NspCamera { width, height, focal, principal_point, view_from_world }
        NspModelInfo { struct_size, count, sh_degree, near_plane, max_alpha, raw_colors, reserved, origin }
        NspImageState { layout, family, stages, access }
        NspImage { image, format, extent, layer, before, after }
        NspRender {
            struct_size, commands, frame, cameras, camera_count, flags, color, depth_out, scene_depth, scene_near,
            scene_far, exposure, background, budget, reserved,
        }
        NspStatus { struct_size, frame, intersections, capacity, left_out, splats_per_tile, device_bytes }
        NspStep { step, loss, gaussians, reserved }
    };
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("offsets.c");
    let body = c.join("\n    ");
    let text = format!(
        "#include <nightsplat.h>\n#include <stdio.h>\nint main(void) {{\n    {body}\n    return 0;\n}}\n"
    );
    std::fs::write(&source, text).unwrap();
    let program = compile("cc", "-std=c99", &source, &[]);
    let printed = String::from_utf8(Command::new(program).output().unwrap().stdout).unwrap();
    assert_eq!(printed.lines().collect::<Vec<_>>(), rust);
}
