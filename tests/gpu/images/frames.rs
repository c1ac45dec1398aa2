//! Frames in flight, and what is refused.

use super::*;

#[test]
fn a_view_beyond_the_memory_is_never_blank_and_soon_exact() {
    with_host(|host, gpu| {
        let picture = host.picture(ImageFormat::Rgba8Unorm, SIZE).unwrap();
        let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
        let target = Target { color: Some(&image), exposure: 1.5, ..Target::default() };
        let mut shown = Shown::new(host, gpu);
        let layout = shown.on_device.layout;
        shown.renderer.prepare_draw(&layout, &cameras(), &target).unwrap();
        shown.renderer.set_intersection_capacity(200).unwrap();
        let (render, transmittances) = planes(&cameras()[0]);
        let stored = COLOR_FORMATS.into_iter().find(|stored| stored.format == picture.format);
        let exact = packed((&render, &transmittances), stored.unwrap(), None);
        assert!(shown.renderer.drawn().is_none());
        for frame in 1..=3 {
            draw(&mut shown, frame, &target);
            let drawn = shown.renderer.drawn().unwrap();
            let [pixels, _] = host.read_picture(&picture, PIXELS);
            assert_eq!(drawn.frame, frame);
            if frame == 1 {
                assert!(drawn.left_out() > 0 && drawn.capacity == 200, "{drawn:?}");
                assert!(pixels.iter().any(|pixel| pixel >> 24 > 100), "blank");
            } else {
                assert_eq!(drawn.left_out(), 0, "{drawn:?}");
                assert!(levels(&pixels, &exact, pixels::STORED_BYTES) <= 1);
            }
        }
        // A budget leaves out the farthest whatever the memory.
        draw(&mut shown, 4, &Target { budget: 150, ..target });
        assert_eq!(shown.renderer.drawn().unwrap().capacity, 150);
        host.free_picture(picture);
    });
}

#[test]
fn with_frames_in_flight_everything_may_grow_and_go() {
    with_host(|host, gpu| {
        let pictures = [0, 1, 2].map(|_| host.picture(ImageFormat::Bgra8Srgb, SIZE).unwrap());
        let mut random = Random::new(9);
        let mut on_device = gaussians().upload(gpu).unwrap();
        let mut renderer = Renderer::new(gpu, show_settings()).unwrap();
        let mut used = vec![];
        for frame in 1..=24 {
            if frame > 3 {
                host.wait_frame(frame - 3);
            }
            let picture = &pictures[frame as usize % 3];
            let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
            let target = Target { color: Some(&image), ..Target::default() };
            let commands = host.begin();
            record(gpu, commands.as_raw(), frame, &mut renderer, &on_device, &target);
            host.submit_frame(commands, frame);
            // Each of these frees what the frame uses.
            match random.between(0.0, 4.0) as u32 {
                0 => renderer = Renderer::new(gpu, show_settings()).unwrap(),
                1 => on_device = gaussians().upload(gpu).unwrap(),
                2 => renderer.set_intersection_capacity(100 + 40 * frame as u32).unwrap(),
                _ => (),
            }
            used.push(gpu.memory_in_use());
        }
        drop((renderer, on_device));
        host.wait_frame(24);
        gpu.frames_done(24);
        assert_eq!(gpu.memory_in_use(), 0, "of {used:?}");
        pictures.into_iter().for_each(|picture| host.free_picture(picture));
    });
}

#[test]
fn a_device_that_only_records_submits_nothing_and_says_so() {
    with_host(|_, gpu| {
        let on_device = gaussians().upload(gpu).unwrap();
        let message = gpu.read(&on_device.parameters).unwrap_err().to_string();
        assert!(message.contains("record-only"), "{message}");
    });
}

#[test]
fn frame_numbers_that_fall_are_refused() {
    with_host(|host, gpu| {
        let commands = host.begin();
        for (number, is_refused) in [(5, false), (5, false), (4, true)] {
            let frame = HostFrame { commands: commands.as_raw(), number, readers: 0 };
            // SAFETY: the command buffer is recording.
            let recorded = unsafe { gpu.record_into(&frame, |_| Ok(())) };
            assert_eq!(recorded.is_err(), is_refused);
        }
        host.submit_frame(commands, 5);
        host.wait_frame(5);
    });
}

#[test]
fn what_does_not_fit_is_refused_by_name_before_anything_is_recorded() {
    with_host(|host, gpu| {
        let picture = host.picture(ImageFormat::Rgba8Unorm, SIZE).unwrap();
        let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
        let on_device = gaussians().upload(gpu).unwrap();
        let mut renderer = Renderer::new(gpu, show_settings()).unwrap();
        let good = Target { color: Some(&image), ..Target::default() };
        let mut refused = |cameras: &[Camera], target: &Target<'_>, named: &[&str]| {
            let error = renderer.prepare_draw(&on_device.layout, cameras, target).unwrap_err();
            let message = error.to_string();
            assert_eq!(error.exit_code(), 2, "{message}");
            assert!(!message.contains('\n'), "{message}");
            named.iter().for_each(|name| assert!(message.contains(name), "{message}"));
        };
        let [camera, _] = cameras();
        refused(&[], &good, &["no camera"]);
        refused(&[camera], &Target::default(), &["no target"]);
        refused(&[Camera { width: 0, ..camera }], &good, &["camera 0", "0x40"]);
        refused(&[camera, Camera { width: 49, ..camera }], &good, &["color", "48x40", "49x40"]);
        let focal = DVec2::new(-1.0, 40.0);
        refused(&[Camera { focal, ..camera }], &good, &["focal length", "-1"]);
        let principal_point = DVec2::NAN;
        refused(&[Camera { principal_point, ..camera }], &good, &["not finite"]);
        let scaled = DAffine3::from_scale(DVec3::splat(1.01));
        refused(&[Camera { view_from_world: scaled, ..camera }], &good, &["not rigid"]);
        let mirrored = DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        refused(&[Camera { view_from_world: mirrored, ..camera }], &good, &["not rigid"]);
        let exposure = f32::NAN;
        refused(&[camera], &Target { exposure, ..good }, &["exposure"]);
        let null = HostImage { handle: 0, ..image };
        refused(&[camera], &Target { color: Some(&null), ..good }, &["color", "null"]);
        let float = HostImage { format: ImageFormat::R32Float, ..image };
        refused(&[camera], &Target { color: Some(&float), ..good }, &["R32Float", "Rgba16Float"]);
        refused(&[camera], &Target { depth: Some(&image), ..good }, &["depth", "R32Float"]);
        let convention = DepthConvention::Linear;
        let scene = |image, convention| Some(SceneDepth { image, convention });
        let scene_of = |image, convention| Target { scene: scene(image, convention), ..good };
        refused(&[camera], &scene_of(&image, convention), &["scene depth", "D32Float"]);
        let coarse = HostImage { format: ImageFormat::D16Unorm, ..image };
        refused(&[camera], &scene_of(&coarse, convention), &["linear", "D16Unorm"]);
        let near = DepthConvention::Forward { near: 0.0, far: None };
        refused(&[camera], &scene_of(&coarse, near), &["near plane is 0"]);
        let far = DepthConvention::Forward { near: 1.0, far: Some(0.5) };
        refused(&[camera], &scene_of(&coarse, far), &["far plane"]);
        let other = Gaussians::zeros(3, 2).upload(gpu).unwrap();
        let error = renderer.prepare_draw(&other.layout, &[camera], &good).unwrap_err();
        assert!(error.to_string().contains("cannot be rendered"), "{error}");
        host.free_picture(picture);
    });
}

#[test]
fn no_gaussians_are_drawn_as_background() {
    with_host(|host, gpu| {
        let picture = host.picture(ImageFormat::Rgba8Unorm, SIZE).unwrap();
        let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
        let target = Target { color: Some(&image), ..Target::default() };
        let on_device = Gaussians::zeros(0, 0).upload(gpu).unwrap();
        draw(&mut Shown { on_device, ..Shown::new(host, gpu) }, 1, &target);
        let [pixels, _] = host.read_picture(&picture, PIXELS);
        let [r, g, b] = OPTIONS.background.map(|c| (c * 255.0).round() as u8);
        let background = u32::from_le_bytes([r, g, b, 0]);
        assert!(
            pixels.iter().all(|&pixel| levels(&[pixel], &[background], pixels::STORED_BYTES) <= 1)
        );
        host.free_picture(picture);
    });
}
