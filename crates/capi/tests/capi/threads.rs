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

/// What a watch told: stages, and the last of `training`.
#[derive(Default)]
struct Told {
    stages: Vec<String>,
    steps: u64,
    /// The stage at which it stops.
    stops_at: Option<&'static str>,
    watch: *mut NspWatch,
}

/// # Safety
/// `user` is a [`Told`] in a lock.
unsafe extern "C" fn tell(user: *mut c_void, stage: *const c_char, done: u64, all: u64) {
    // SAFETY: as above; the stage ends with NUL.
    let (told, stage) = unsafe { (&*user.cast::<Mutex<Told>>(), CStr::from_ptr(stage)) };
    let (mut told, stage) = (told.lock().unwrap(), stage.to_str().unwrap().to_owned());
    assert!(done <= all, "{stage}: {done} of {all}");
    if stage == "training" {
        told.steps = done;
    }
    if told.stops_at == Some(stage.as_str()) {
        // SAFETY: the watch lives as long as what it follows.
        ok(unsafe { nsp_watch_stop(told.watch) });
    }
    if !told.stages.contains(&stage) {
        told.stages.push(stage);
    }
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
        let told = Mutex::new(Told::default());
        // SAFETY: everything is valid, on this thread alone but for the device.
        unsafe {
            let mut watch = null_mut();
            let user = (&raw const told).cast_mut().cast();
            ok(nsp_watch_create(Some(tell), user, &mut watch));
            told.lock().unwrap().watch = watch;
            for stage in ["decoding photographs", "uploading photographs"] {
                told.lock().unwrap().stops_at = Some(stage);
                let (dataset, config) = (dataset.as_ptr(), config.as_ptr());
                let stopped = nsp_trainer_create(device, dataset, config, watch, &mut trainer);
                refused(stopped, NSP_ERROR_STOPPED, &["nsp_trainer_create", "stopped on request"]);
                assert!(trainer.is_null());
            }
            told.lock().unwrap().stops_at = None;
            ok(nsp_trainer_create(device, dataset.as_ptr(), config.as_ptr(), watch, &mut trainer));
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
            let mut stops = 0;
            while nsp_trainer_has_ended(trainer) == 0 {
                let mut count = 64;
                if last >= 20 && stops == 0 {
                    ok(nsp_watch_stop(watch));
                }
                let done = nsp_trainer_advance(trainer, 40, 20, steps.as_mut_ptr(), &mut count);
                if done == NSP_ERROR_STOPPED {
                    stops += 1;
                    continue;
                }
                ok(done);
                assert!(steps[..count as usize].iter().all(|step| step.loss.is_finite()));
                last = steps[..count as usize].last().map_or(last, |step| step.step);
            }
            assert_eq!((last, stops), (40, 1));
            let mut scores =
                [NspScore { struct_size: size_of::<NspScore>(), step: 0, psnr: 0.0 }; 4];
            let mut count = 4;
            ok(nsp_trainer_scores(trainer, scores.as_mut_ptr(), &mut count));
            assert!(count > 0 && scores[count as usize - 1].step == 40, "{scores:?}");
            assert!(scores[..count as usize].iter().all(|score| score.psnr > 3.0), "{scores:?}");
            let stages = std::mem::take(&mut told.lock().unwrap().stages);
            for stage in ["compiling kernels", "training", "scoring views"] {
                assert!(stages.iter().any(|told| told == stage), "{stage}: {stages:?}");
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
            nsp_watch_destroy(watch);
        }
        is_done.store(true, Ordering::Release);
    });
    assert!(session.folder.path().join("trained.spz").exists());
    let (locked, submitted) = (LOCKED.load(Ordering::Acquire), submitted.load(Ordering::Acquire));
    assert!(submitted > 0 && locked > submitted, "{locked} locks, {submitted} of the host's");
    session.end();
}

/// Scores and rounds of density control are divided among calls, and no bit depends on how. Prints how long the calls
/// of a budget take.
#[test]
fn calls_keep_to_their_time_and_train_the_same_bits() {
    let session = Session::with_flags(0, |_| {});
    let dataset = session.folder.path().join("dataset");
    let options =
        SyntheticOptions { width: 96, height: 72, views: 16, ..SyntheticOptions::default() };
    write(&dataset, &options).unwrap();
    let dataset = c_path(&dataset);
    let config = CString::new("steps = 120\n[schedule]\ndensify_interval = 20\n").unwrap();
    let none = NspStep {
        struct_size: size_of::<NspStep>(),
        step: 0,
        loss: 0.0,
        gaussians: 0,
        reserved: 0,
    };
    let train = |milliseconds: u32| {
        let mut trainer = null_mut();
        let (mut last, mut calls, mut steps) = (none, vec![], [none; 64]);
        let mut scores = [NspScore { struct_size: size_of::<NspScore>(), step: 0, psnr: 0.0 }; 8];
        let mut scored = 8;
        // SAFETY: everything is valid, on this thread alone.
        unsafe {
            let device = session.device;
            ok(nsp_trainer_create(device, dataset.as_ptr(), config.as_ptr(), null(), &mut trainer));
            while nsp_trainer_has_ended(trainer) == 0 {
                let (begin, mut count) = (std::time::Instant::now(), 64);
                let steps = steps.as_mut_ptr();
                ok(nsp_trainer_advance(trainer, u64::MAX, milliseconds, steps, &mut count));
                calls.push(begin.elapsed());
                if count > 0 {
                    last = *steps.add(count as usize - 1);
                }
            }
            ok(nsp_trainer_scores(trainer, scores.as_mut_ptr(), &mut scored));
            nsp_trainer_destroy(trainer);
        }
        calls.sort_unstable();
        let [median, most] = [calls[calls.len() / 2], calls[calls.len() - 1]];
        println!("{milliseconds} ms: {} calls, median {median:?}, at most {most:?}", calls.len());
        let scores =
            scores[..scored as usize].iter().map(|score| (score.step, score.psnr.to_bits()));
        (last.step, last.loss.to_bits(), last.gaussians, scores.collect::<Vec<_>>(), calls.len())
    };
    let (step, loss, gaussians, scores, least) = train(60_000);
    assert_eq!(step, 120);
    assert!(!scores.is_empty());
    for milliseconds in [50, 10, 1] {
        let (other_step, other_loss, others, other_scores, many) = train(milliseconds);
        assert_eq!((other_step, other_loss, others), (step, loss, gaussians));
        assert_eq!(other_scores, scores);
        assert!(many > least, "{many} calls");
    }
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
