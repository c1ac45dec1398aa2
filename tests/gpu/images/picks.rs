//! What is under a pixel, where it was in the frame before, and cameras without perspective.

use glam::DQuat;
use nightsplat::splats::device::Upload;
use nightsplat::splats::render::{Instance, Motion, Pick, PickedSplat};

use super::*;

/// A host that submits, its device, and two layers of images of these formats.
fn with_device(test: impl FnOnce(&Host, &Gpu)) {
    let host = Host::new(usual_extensions());
    {
        // SAFETY: the handles are the host's own and outlive `gpu`; nothing else uses the queue meanwhile.
        let gpu = unsafe { Gpu::from_host(host.lend()) }.unwrap();
        test(&host, &gpu);
    }
    host.destroy();
}

/// The test's cameras, or orthographic ones of about the same view.
fn views(is_orthographic: bool) -> [Camera; 2] {
    cameras().map(|camera| match is_orthographic {
        true => Camera { focal: DVec2::splat(16.0), model: CameraModel::Orthographic, ..camera },
        false => camera,
    })
}

/// The image of the first layer as floats, with this many a pixel.
fn floats(host: &Host, picture: &Picture, each: usize) -> Vec<f32> {
    host.read_layer(picture, 0, each * PIXELS).into_iter().map(f32::from_bits).collect()
}

/// Two instances of a model, the second nearer and to the right, in this frame and the one before.
fn instances(on_device: &DeviceGaussians) -> [Instance<'_>; 2] {
    let placed = |x: f64, z: f64, angle: f64| {
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(angle), DVec3::new(x, 0.1, z))
    };
    let whole = Instance::new(on_device);
    let first = Instance { pose: placed(-0.5, 1.0, 0.3), scale: 1.25, ..whole };
    let moved = Some((placed(0.7, -0.2, 0.1), 0.5));
    [first, Instance { pose: placed(0.5, -0.5, 0.2), scale: 0.5, before: moved, ..whole }]
}

/// Every pass agrees with its reference, every pixel moves as its own depth and instance say, and the picked splat is
/// one of them.
#[test]
fn picks_and_motion_of_instances_agree_with_their_references_and_with_the_depth_image() {
    with_device(|host, gpu| {
        let mut solid = gaussians();
        solid.raw_opacities_mut().fill(2.0);
        let on_device = solid.upload(gpu).unwrap();
        let instances = instances(&on_device);
        let mut renderer = Renderer::new(gpu, show_settings()).unwrap();
        let picture = scene(host, ImageFormat::D32Float, |_| 0).unwrap();
        let lent = picture.lent(ImageState::DEPTH_ATTACHMENT, ImageState::DEPTH_ATTACHMENT);
        let convention = DepthConvention::Reversed { near: 0.1, far: Some(50.0) };
        let wall = SceneDepth { image: &lent, convention };
        for (is_orthographic, format, scene) in [
            (false, ImageFormat::Rg16Float, None),
            (false, ImageFormat::Rg32Float, Some(wall)),
            (true, ImageFormat::Rg32Float, Some(wall)),
        ] {
            let cameras = views(is_orthographic);
            let turn = DAffine3::from_rotation_y(0.02);
            let step = DAffine3::from_translation(DVec3::new(0.05, -0.02, 0.04));
            let before = cameras.map(|camera| Camera {
                view_from_world: turn * step * camera.view_from_world,
                ..camera
            });
            let motion = host.picture(format, SIZE).unwrap();
            let depth = host.picture(ImageFormat::R32Float, SIZE).unwrap();
            let [motion_image, depth_image]: [HostImage; 2] = [&motion, &depth]
                .map(|picture| picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE));
            let pixel = [30, 22];
            let target = Target {
                depth: Some(&depth_image),
                scene,
                motion: Some(Motion { image: &motion_image, before: &before }),
                pick: Some(pixel),
                ..Target::default()
            };
            let (done, report) = gpu.checked(|| {
                gpu.run("draw", |pass| {
                    renderer.draw_instances(pass, &instances, &cameras, &OPTIONS, &target)
                })
            });
            done.unwrap();
            report.agree().unwrap();
            let passes = report.kernels();
            for (kernel, count) in [("pick_splats", 3), ("motion_vectors", 2)] {
                let found = passes.iter().find(|(name, ..)| *name == kernel).unwrap();
                assert_eq!(found.1, count, "{kernel}");
            }
            let depths = floats(host, &depth, 1);
            let at = (pixel[1] * SIZE[0] + pixel[0]) as usize;
            let Pick { hit, .. } = renderer.picked().unwrap();
            let hit = hit.unwrap();
            assert_eq!(hit.depth, depths[at], "{hit:?}");
            assert!((hit.gaussian as usize) < solid.count, "{hit:?}");
            if format == ImageFormat::Rg32Float {
                let vectors = floats(host, &motion, 2);
                let vectors: Vec<DVec2> =
                    vectors.chunks(2).map(|v| DVec2::new(v[0].into(), v[1].into())).collect();
                check_motion(&cameras[0], &before[0], &instances, &depths, &vectors);
            }
            [motion, depth].into_iter().for_each(|picture| host.free_picture(picture));
        }
        host.free_picture(picture);
    });
}

/// Each pixel with a depth moved as one of the instances does, and both do; others as what is infinitely far.
fn check_motion(
    camera: &Camera,
    before: &Camera,
    instances: &[Instance<'_>],
    depths: &[f32],
    vectors: &[DVec2],
) {
    let mut seen = vec![0; instances.len()];
    for (at, (depth, vector)) in depths.iter().zip(vectors).enumerate() {
        let pixel = DVec2::new((at as u32 % SIZE[0]).into(), (at as u32 / SIZE[0]).into()) + 0.5;
        let is_seen = depth.is_finite();
        let far = if camera.model == CameraModel::Orthographic { 0.0 } else { 1e9 };
        let point = camera.in_view(pixel, if is_seen { (*depth).into() } else { far }).unwrap();
        let world = camera.view_from_world.inverse().transform_point3(point);
        let moved = |instance: &Instance<'_>| {
            let (pose, scale) = instance.before.unwrap_or((instance.pose, instance.scale));
            let in_model = instance.pose.inverse().transform_point3(world) / instance.scale;
            before.view_from_world.transform_point3(pose.transform_point3(scale * in_model))
        };
        let motion_of = |view: DVec3| {
            let slope = match camera.model {
                CameraModel::Orthographic => view.truncate(),
                _ => view.truncate() / view.z,
            };
            before.focal * slope + before.principal_point - pixel
        };
        let of_world = motion_of(before.view_from_world.transform_point3(world));
        if !is_seen {
            assert!(vector.distance(of_world) < 2e-3, "{at}: {vector} {of_world}");
            continue;
        }
        let found = instances
            .iter()
            .position(|instance| motion_of(moved(instance)).distance(*vector) < 2e-3);
        seen[found.unwrap_or_else(|| panic!("pixel {at} moved by {vector}"))] += 1;
    }
    assert!(seen.iter().all(|&pixels| pixels > 20), "{seen:?}");
    assert!(depths.iter().any(|depth| depth.is_infinite()));
}

#[test]
fn a_pick_names_the_instance_and_the_gaussian_once_its_frame_is_done() {
    with_host(|host, gpu| {
        // One Gaussian in the middle, of each of two models.
        let one = |count: usize, at: usize| {
            let mut gaussians = Gaussians::zeros(count, 0);
            gaussians.quats_mut().fill([1.0, 0.0, 0.0, 0.0]);
            gaussians.means_mut().fill(Vec3::new(0.0, 0.0, -9.0));
            gaussians.log_scales_mut().fill(Vec3::splat(-2.0));
            gaussians.raw_opacities_mut().fill(4.0);
            gaussians.means_mut()[at] = Vec3::new(0.0, 0.0, 2.0);
            gaussians.upload(gpu).unwrap()
        };
        let models = [one(5, 3), one(70, 66)];
        let mut renderer = Renderer::new(gpu, show_settings()).unwrap();
        let [camera, _] = cameras();
        let away = DAffine3::from_translation(DVec3::new(0.0, 0.0, 1.0));
        let far = Instance { pose: away, ..Instance::new(&models[0]) };
        let near = Instance::new(&models[1]);
        let hidden = Instance { is_visible: false, ..near };
        let mut frame = 0;
        let mut picked = |instances: &[Instance<'_>], pick| {
            frame += 1;
            let target = Target { pick: Some(pick), ..Target::default() };
            let commands = host.begin();
            let recorded = HostFrame { commands: commands.as_raw(), number: frame, readers: 0 };
            let mut before = None;
            // SAFETY: the command buffer is recording, outside a render pass.
            unsafe {
                gpu.record_into(&recorded, |pass| {
                    renderer.draw_instances(pass, instances, &[camera], &OPTIONS, &target)?;
                    before = renderer.picked();
                    Ok(())
                })
            }
            .unwrap();
            assert!(before.is_none_or(|pick| pick.frame < frame), "the frame is not submitted");
            host.submit_frame(commands, frame);
            host.wait_frame(frame);
            let Pick { frame: done, hit } = renderer.picked().unwrap();
            assert_eq!(done, frame);
            hit
        };
        let hit = |instance, gaussian, depth| Some(PickedSplat { instance, gaussian, depth });
        assert_eq!(picked(&[far, near], [24, 20]), hit(1, 66, 2.0));
        assert_eq!(picked(&[hidden, far, near], [24, 20]), hit(2, 66, 2.0));
        assert_eq!(picked(&[far, hidden], [24, 20]), hit(0, 3, 3.0));
        assert_eq!(picked(&[far, near], [0, 0]), None);
        assert_eq!(picked(&[], [24, 20]), None);
    });
}

fn motion<'a>(image: &'a HostImage, before: &'a [Camera]) -> Target<'a> {
    Target { motion: Some(Motion { image, before }), ..Target::default() }
}

#[test]
fn motion_and_picks_that_make_no_sense_are_refused() {
    let gpu = gpu();
    let on_device = gaussians().upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, show_settings()).unwrap();
    let state = ImageState::SAMPLED;
    let image = HostImage {
        handle: 1,
        format: ImageFormat::Rg16Float,
        size: SIZE,
        layer: 0,
        before: state,
        after: state,
    };
    let [camera, other] = cameras();
    let mut refuse = |camera: Camera, target: &Target<'_>, words: &str| {
        let refused = renderer.prepare_draw(&on_device.layout, &[camera], target).unwrap_err();
        assert!(refused.to_string().contains(words), "{refused}");
    };
    refuse(camera, &Target { pick: Some([48, 0]), ..Target::default() }, "[48, 0]");
    refuse(camera, &motion(&image, &[]), "1 cameras, and 0");
    refuse(camera, &motion(&image, &[Camera { width: 9, ..other }]), "one size");
    let fisheye = CameraModel::Fisheye(Default::default());
    let fisheye = Camera { model: fisheye, ..camera };
    refuse(fisheye, &motion(&image, &[fisheye]), "pinholes or orthographic");
    let wide = HostImage { format: ImageFormat::Rgba16Float, ..image };
    refuse(camera, &motion(&wide, &[other]), "Rg16Float");
    let scene = HostImage { format: ImageFormat::D32Float, ..image };
    let convention = DepthConvention::Reversed { near: 0.1, far: None };
    let orthographic = Camera { model: CameraModel::Orthographic, ..camera };
    let target = Target { depth: Some(&scene), depth_convention: convention, ..Target::default() };
    refuse(orthographic, &target, "orthographic");
    refuse(camera, &Target { depth: Some(&scene), ..Target::default() }, "state your projection");
    let ten = HostImage { format: ImageFormat::A2B10G10R10Unorm, ..image };
    let half = HostImage { format: ImageFormat::Rgba16Float, ..image };
    let hdr10 =
        |color, nits| Target { color: Some(color), hdr10_nits: Some(nits), ..Target::default() };
    refuse(camera, &hdr10(&ten, 0.0), "hdr10_nits is 0");
    refuse(camera, &hdr10(&half, 203.0), "A2B10G10R10Unorm");
}

/// A Gaussian that projects to the same place at any depth, and whose colour is that of the axis.
#[test]
fn an_orthographic_camera_sees_along_parallel_rays() {
    let gpu = gpu();
    let drawn = |depth: f32, camera: &Camera| {
        let mut one = Gaussians::zeros(1, 1);
        one.means_mut()[0] = Vec3::new(0.5, -0.25, depth);
        one.quats_mut()[0] = [1.0, 0.0, 0.0, 0.0];
        one.log_scales_mut()[0] = Vec3::splat(-2.0);
        one.raw_opacities_mut()[0] = 4.0;
        one.rest_mut()[1] = Vec3::new(0.5, 0.1, -0.2);
        let settings = RenderSettings { shape: 1.into(), ..show_settings() };
        let mut renderer = Renderer::new(&gpu, settings).unwrap();
        renderer.reserve(1, [camera]).unwrap();
        let options = RenderOptions { sh_degree: 1, background: [0.0; 3] };
        let on_device = one.upload(&gpu).unwrap();
        let image = renderer.render_image(&on_device, camera, &options).unwrap();
        let lit = |at: &usize| image.data[*at] > 0.05;
        let places: Vec<usize> = (0..PIXELS).filter(lit).collect();
        (image.data, places)
    };
    let [camera, _] = views(true);
    let ((near, places), (far, _)) = (drawn(1.0, &camera), drawn(40.0, &camera));
    assert_eq!(near, far);
    // Centre 24 + 16 / 2, 20 - 16 / 4; a radius of 3.33 deviations of 16 e^-2 pixels and the dilation at most.
    let center = DVec2::new(32.0, 16.0);
    let mut mean = DVec2::ZERO;
    for at in &places {
        let pixel = DVec2::new((at % 48) as f64, (at / 48) as f64) + 0.5;
        assert!(pixel.distance(center) < 7.6, "{pixel}");
        mean += pixel / places.len() as f64;
    }
    assert!(mean.distance(center) < 0.05 && places.len() > 40, "{mean} of {}", places.len());
    // From the other side it has the harmonics of the other direction.
    let turned = DAffine3::from_rotation_translation(
        DQuat::from_rotation_y(std::f64::consts::PI),
        DVec3::new(0.0, 0.0, 9.0),
    );
    let (opposite, _) = drawn(1.0, &Camera { view_from_world: turned, ..camera });
    let middle = |data: &[f32]| data.iter().take(PIXELS).fold(0.0f32, |a, b| a.max(*b));
    let [front, back] = [middle(&near), middle(&opposite)];
    let share = (front - back) / (front + back);
    assert!((share - 0.4886025).abs() < 0.01, "{front} {back}");
}

#[test]
fn the_splats_depth_goes_into_the_hosts_own_depth_buffer() {
    with_host(|host, gpu| {
        let mut shown = Shown::new(host, gpu);
        let (near, far) = (0.1f32, 40.0f32);
        let mut frame = 0;
        for format in [ImageFormat::D32Float, ImageFormat::D32FloatS8] {
            for is_reversed in [false, true] {
                let convention = match is_reversed {
                    true => DepthConvention::Reversed { near, far: Some(far) },
                    false => DepthConvention::Forward { near, far: Some(far) },
                };
                let stored = |z: f32| {
                    let e = near * (far - z) / (z * (far - near));
                    if is_reversed { e } else { 1.0 - e }
                };
                let of = |format, word: f32| scene(host, format, move |_| word.to_bits());
                let Some(wall) = of(format, stored(2.5)) else { continue };
                let linear = host.picture(ImageFormat::R32Float, SIZE).unwrap();
                let color = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
                let target_state = ImageState::TRANSFER_SOURCE;
                let attached = ImageState::DEPTH_ATTACHMENT;
                let [alone, color_image]: [HostImage; 2] = [&linear, &color]
                    .map(|picture| picture.lent(ImageState::UNDEFINED, target_state));
                let before = wall.lent(attached, attached);
                let scene = Some(SceneDepth { image: &before, convention });
                frame += 2;
                let plain = Target { depth: Some(&alone), scene, ..Target::default() };
                draw(&mut shown, frame, &plain);
                let depths = floats(host, &linear, 1);
                let merged = wall.lent(attached, target_state);
                let target = Target {
                    color: Some(&color_image),
                    depth: Some(&merged),
                    depth_convention: convention,
                    scene,
                    ..Target::default()
                };
                draw(&mut shown, frame + 1, &target);
                let (mut seen, mut kept) = (0, 0);
                for (buffer, depth) in floats(host, &wall, 1).iter().zip(&depths) {
                    if depth.is_infinite() {
                        kept += 1;
                        assert_eq!(*buffer, stored(2.5), "the host's own");
                    } else {
                        seen += 1;
                        assert!((buffer - stored(*depth)).abs() < 1e-6, "{buffer} {depth}");
                    }
                }
                assert!(seen > 20 && kept > 20, "{seen} {kept}");
                [wall, linear, color].into_iter().for_each(|picture| host.free_picture(picture));
            }
        }
    });
}
