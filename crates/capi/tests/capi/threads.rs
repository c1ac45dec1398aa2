//! Two threads, two devices.

use super::*;

static HELD: AtomicBool = AtomicBool::new(false);
static LOCKED: AtomicU64 = AtomicU64::new(0);
static QUEUE: Mutex<()> = Mutex::new(());
thread_local!(static GUARD: std::cell::RefCell<Option<std::sync::MutexGuard<'static, ()>>> =
    const { std::cell::RefCell::new(None) });

pub(super) unsafe extern "C" fn lock_queue(_: *mut c_void, _: vk::Queue) {
    let guard = QUEUE.lock().unwrap();
    assert!(!HELD.swap(true, Ordering::AcqRel), "the lock is held twice");
    LOCKED.fetch_add(1, Ordering::AcqRel);
    GUARD.with_borrow_mut(|held| *held = Some(guard));
}

unsafe extern "C" fn unlock_queue(_: *mut c_void, _: vk::Queue) {
    HELD.store(false, Ordering::Release);
    GUARD.with_borrow_mut(|held| *held = None);
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
            let (mut last, mut steps) = (
                0,
                [NspStep {
                    struct_size: size_of::<NspStep>(),
                    step: 0,
                    loss: 0.0,
                    gaussians: 0,
                    reserved: 0,
                }; 64],
            );
            while last < 40 {
                let mut count = 64;
                ok(nsp_trainer_advance(trainer, 40, 20, steps.as_mut_ptr(), &mut count));
                assert!(count > 0, "the training ended at step {last}");
                last = steps[count as usize - 1].step;
                assert!(steps[..count as usize].iter().all(|step| step.loss.is_finite()));
            }
            let mut model = null_mut();
            ok(nsp_trainer_model(trainer, &mut model));
            assert!(nsp_model_count(model) > 0);
            // The trainer's Gaussians as they are, and the copy.
            let mut renderer = null_mut();
            ok(nsp_renderer_create(device, model, &mut renderer));
            let (camera, color) = (c_camera(), session.image());
            let live = NspInstance { trainer, ..whole(null()) };
            let pictures = [(model.cast_const(), null(), 0), (null(), &raw const live, 1)].map(
                |(model, instances, instance_count)| {
                    let number = 1 + u64::from(instance_count);
                    let commands = session.host.begin();
                    let drawn = NspRender {
                        instances,
                        instance_count,
                        ..render(commands, number, &camera, &color)
                    };
                    ok(nsp_record_render(renderer, model, &drawn));
                    lock_queue(null_mut(), session.host.queue);
                    session.host.submit_frame(commands, number);
                    unlock_queue(null_mut(), session.host.queue);
                    session.host.wait_frame(number);
                    lock_queue(null_mut(), session.host.queue);
                    let pixels = session.pixels();
                    unlock_queue(null_mut(), session.host.queue);
                    pixels
                },
            );
            let off = pictures[0].iter().zip(&pictures[1]).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(off <= Some(2), "{off:?} levels");
            assert!(pictures[1].iter().any(|byte| *byte > 20), "nothing is seen");
            nsp_renderer_destroy(renderer);
            nsp_model_destroy(model);
            let checkpoint = c_path(&session.folder.path().join("checkpoint.safetensors"));
            ok(nsp_trainer_checkpoint(trainer, checkpoint.as_ptr()));
            assert!(session.folder.path().join("checkpoint.safetensors").exists());
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
struct Shared<T>(*mut T);
// SAFETY: any thread may use a device; they only read a model, one at a time.
unsafe impl<T> Sync for Shared<T> {}
impl<T> Shared<T> {
    fn get(&self) -> *mut T {
        self.0
    }
}

#[test]
fn two_devices_and_two_renderers_on_one_draw_from_threads_of_their_own() {
    let run = || {
        let mut session = Session::ready(|_| {});
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
    let (color, model, device) = (image(&picture), Shared(session.model), Shared(session.device));
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
    let pixels = host.read_layer(&picture, 0, PIXELS);
    let pixels: Vec<u8> = pixels.iter().flat_map(|p| p.to_le_bytes()[..3].to_vec()).collect();
    assert_close(&pixels, &expected);
    session.host.free_picture(picture);
    session.end();
}
