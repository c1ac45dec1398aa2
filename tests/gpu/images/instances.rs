//! Several models in one draw.

use std::time::{Duration, Instant};

use glam::{DQuat, Vec4};
use nightsplat::kernels::InstanceView;
use nightsplat::splats::device::Upload;
use nightsplat::splats::model::Model;
use nightsplat::splats::render::Instance;

use super::*;

/// A model of this SH degree, whose harmonics matter.
fn model(sh_degree: u32, seed: u64) -> Model {
    let mut gaussians = gaussians().with_sh_degree(sh_degree);
    for (i, coefficient) in gaussians.rest_mut().iter_mut().enumerate() {
        let uniform = |row| Stream::new(seed, row).uniform(i as u64) as f32 - 0.5;
        *coefficient = Vec3::new(uniform(0), uniform(1), uniform(2));
    }
    gaussians.origin = DVec3::new(0.25, -0.5, 0.125);
    gaussians.into()
}

fn poses() -> [DAffine3; 3] {
    let turn = |angle: f64, at: [f64; 3]| {
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(angle), at.into())
    };
    [turn(0.0, [0.0; 3]), turn(1.2, [-1.5, 0.25, 1.0]), turn(-2.0, [1.0, 0.5, 3.0])]
}

/// The model as an instance with this scale has it.
fn scaled(model: &Model, scale: f64) -> Model {
    let mut scaled = model.clone();
    scaled.gaussians.origin *= scale;
    for mean in scaled.gaussians.means_mut() {
        *mean = (mean.as_dvec3() * scale).as_vec3();
    }
    for log_scale in scaled.gaussians.log_scales_mut() {
        *log_scale += scale.ln() as f32;
    }
    scaled
}

/// The linear light of the first view.
fn drawn(
    host: &Host,
    gpu: &Gpu,
    frame: u64,
    draw: impl FnOnce(&mut nightsplat::gpu::Recorder<'_>, &Target<'_>) -> nightsplat::Result<()>,
) -> Vec<Vec4> {
    let picture = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
    let color = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
    let target = Target { color: Some(&color), is_display_referred: true, ..Target::default() };
    let commands = host.begin();
    let recorded = HostFrame { commands: commands.as_raw(), number: frame, readers: 0 };
    // SAFETY: the command buffer is recording, outside a render pass.
    unsafe { gpu.record_into(&recorded, |pass| draw(pass, &target)) }.unwrap();
    host.submit_frame(commands, frame);
    host.wait_frame(frame);
    let words = host.read_layer(&picture, 0, 2 * PIXELS);
    host.free_picture(picture);
    let half = |word: u32, shift: u32| f16::from_bits((word >> shift) as u16).to_f32();
    let pixel = |w: &[u32]| Vec4::new(half(w[0], 0), half(w[0], 16), half(w[1], 0), half(w[1], 16));
    words.chunks(2).map(pixel).collect()
}

fn furthest(a: &[Vec4], b: &[Vec4]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max)
}

fn settings(sh_degree: u32) -> RenderSettings {
    RenderSettings { shape: sh_degree.into(), ..show_settings() }
}

const BLACK: RenderOptions = RenderOptions { sh_degree: 3, background: [0.0; 3] };

#[test]
fn moved_instances_are_the_joined_model() {
    with_host(|host, gpu| {
        let models = [model(2, 1), model(1, 2)];
        let on_device = models.each_ref().map(|model| model.gaussians.upload(gpu).unwrap());
        // One model twice, and another between.
        let uses = [(0, 1.0), (1, 0.5), (0, 1.75)];
        let parts: Vec<Model> =
            uses.iter().map(|&(at, scale)| scaled(&models[at], scale)).collect();
        let posed: Vec<_> = parts.iter().zip(poses()).collect();
        let joined = Model::join(&posed).unwrap();
        let instances: Vec<_> = uses
            .iter()
            .zip(poses())
            .map(|(&(at, scale), pose)| Instance { pose, scale, ..Instance::new(&on_device[at]) })
            .collect();
        let camera = &cameras()[..1];
        let expected = {
            let on_device = joined.gaussians.upload(gpu).unwrap();
            let mut renderer = Renderer::new(gpu, settings(2)).unwrap();
            drawn(host, gpu, 1, |pass, target| {
                renderer.draw(pass, &on_device, camera, &BLACK, target)
            })
        };
        let mut renderer = Renderer::new(gpu, settings(0)).unwrap();
        let actual = drawn(host, gpu, 2, |pass, target| {
            renderer.draw_instances(pass, &instances, camera, &BLACK, target)
        });
        let lit = expected.iter().filter(|pixel| pixel.w > 0.1).count();
        assert!(lit > PIXELS / 10, "{lit} pixels are seen");
        // Of halves, and of means that are rounded where they are moved.
        assert!(furthest(&actual, &expected) < 4e-3, "{}", furthest(&actual, &expected));
        // In any order of the list the same, and again the same bits.
        let again = drawn(host, gpu, 3, |pass, target| {
            renderer.draw_instances(pass, &instances, camera, &BLACK, target)
        });
        assert_eq!(actual, again);
    });
}

#[test]
fn an_instance_is_tinted_clipped_hidden_and_culled() {
    with_host(|host, gpu| {
        let model = model(1, 3);
        let on_device = model.gaussians.upload(gpu).unwrap();
        let whole = Instance::new(&on_device);
        let mut renderer = Renderer::new(gpu, settings(1)).unwrap();
        let mut frame = 0;
        let mut show = |instances: &[Instance<'_>]| {
            frame += 1;
            drawn(host, gpu, frame, |pass, target| {
                renderer.draw_instances(pass, instances, &cameras()[..1], &BLACK, target)
            })
        };
        let plain = show(&[whole]);
        let coverage = |pixels: &[Vec4]| pixels.iter().map(|pixel| pixel.w).sum::<f32>();
        assert!(coverage(&plain) > 50.0);

        let tinted = show(&[Instance { tint: [0.5, 2.0, 0.0, 1.0], ..whole }]);
        let expected: Vec<Vec4> =
            plain.iter().map(|pixel| *pixel * Vec4::new(0.5, 2.0, 0.0, 1.0)).collect();
        assert!(furthest(&tinted, &expected) < 4e-3, "{}", furthest(&tinted, &expected));
        assert_eq!(coverage(&show(&[Instance { tint: [1.0, 1.0, 1.0, 0.0], ..whole }])), 0.0);
        assert_eq!(coverage(&show(&[Instance { is_visible: false, ..whole }])), 0.0);
        assert_eq!(coverage(&show(&[])), 0.0);

        // The two halves of a clipped model have no Gaussian in common, and all of them together.
        let middle = model.gaussians.origin.x;
        let [least, most] = [DVec3::splat(-100.0), DVec3::splat(100.0)];
        let halves = [[least, DVec3 { x: middle, ..most }], [DVec3 { x: middle, ..least }, most]]
            .map(|clip| Instance { clip: Some(clip), ..whole });
        assert!(furthest(&show(&halves), &plain) < 2e-3);
        assert!(halves.iter().all(|half| furthest(&show(&[*half]), &plain) > 0.1));

        // Behind the camera and beside the view: nothing is projected.
        for at in [DVec3::Z * -9.0, DVec3::X * 40.0, DVec3::X * -40.0, DVec3::Y * 40.0] {
            let away = Instance { pose: DAffine3::from_translation(at), ..whole };
            assert_eq!(show(&[whole, away]), plain);
        }
    });
}

/// Beside and across each side of a view, an instance that is culled changes no pixel: its bounds are those of what the
/// kernel computes.
#[test]
fn what_is_culled_would_not_have_been_seen() {
    with_host(|host, gpu| {
        let model = model(0, 4);
        let bounded = model.gaussians.upload(gpu).unwrap();
        // Without bounds nothing is culled.
        let mut unbounded = DeviceGaussians::uninit(gpu, bounded.layout).unwrap();
        unbounded.origin = bounded.origin;
        unbounded.write(gpu, &model.gaussians.parameters).unwrap();
        let mut renderer = Renderer::new(gpu, settings(0)).unwrap();
        let mut frame = 0;
        let mut random = Random::new(9);
        for _ in 0..40 {
            let at = DVec3::new(
                random.between(-7.0, 7.0),
                random.between(-7.0, 7.0),
                random.between(-4.0, 6.0),
            );
            let scale = random.between(0.1, 3.0);
            let mut show = |gaussians| {
                frame += 1;
                let pose = DAffine3::from_translation(at);
                let instance = Instance { pose, scale, ..Instance::new(gaussians) };
                drawn(host, gpu, frame, |pass, target| {
                    renderer.draw_instances(pass, &[instance], &cameras()[..1], &BLACK, target)
                })
            };
            assert_eq!(show(&bounded), show(&unbounded), "{at} {scale}");
        }
    });
}

#[test]
fn every_pass_of_a_draw_of_instances_agrees_with_its_reference() {
    let host = Host::new(usual_extensions());
    {
        // SAFETY: the handles are the host's own and outlive `gpu`; nothing else uses the queue meanwhile.
        let gpu = unsafe { Gpu::from_host(host.lend()) }.unwrap();
        let models = [model(3, 5), model(1, 6)];
        let on_device = models.each_ref().map(|model| model.gaussians.upload(&gpu).unwrap());
        let instances: Vec<_> = [0, 1, 0]
            .iter()
            .zip(poses())
            .map(|(&at, pose)| Instance {
                pose,
                scale: 1.25,
                tint: [0.5, 1.5, 1.0, 0.75],
                clip: Some([DVec3::splat(-0.75), DVec3::splat(3.0)]),
                ..Instance::new(&on_device[at])
            })
            .collect();
        let color = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
        let depth = host.picture(ImageFormat::R32Float, SIZE).unwrap();
        let [color_image, depth_image]: [HostImage; 2] = [&color, &depth]
            .map(|picture| picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE));
        let target =
            Target { color: Some(&color_image), depth: Some(&depth_image), ..Target::default() };
        let mut renderer = Renderer::new(&gpu, settings(0)).unwrap();
        let (done, report) = gpu.checked(|| {
            gpu.run("draw", |pass| {
                renderer.draw_instances(pass, &instances, &cameras(), &BLACK, &target)
            })
        });
        done.unwrap();
        report.agree().unwrap();
        let projected = report.kernels().into_iter().filter(|(name, ..)| *name == "project");
        assert_eq!(projected.map(|(_, passes, _)| passes).sum::<usize>(), 4);
        [color, depth].into_iter().for_each(|picture| host.free_picture(picture));
    }
    host.destroy();
}

#[test]
fn an_instance_that_makes_no_sense_is_refused() {
    let gpu = gpu();
    let model = model(1, 7);
    let on_device = model.gaussians.upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, settings(1)).unwrap();
    let image = HostImage {
        handle: 1,
        format: ImageFormat::Rgba8Unorm,
        size: SIZE,
        layer: 0,
        before: ImageState::UNDEFINED,
        after: ImageState::SAMPLED,
    };
    let target = Target { color: Some(&image), ..Target::default() };
    let whole = Instance::new(&on_device);
    let mut refuse = |instance: Instance<'_>, words: &str| {
        let refused = renderer.prepare_instances(&[whole, instance], &cameras(), &target);
        let message = refused.unwrap_err().to_string();
        assert!(message.contains("instance 1") && message.contains(words), "{message}");
    };
    let mirrored = DAffine3::from_scale(DVec3::new(1.0, -1.0, 1.0));
    refuse(Instance { pose: mirrored, ..whole }, "not rigid");
    refuse(Instance { pose: DAffine3::from_scale(DVec3::splat(2.0)), ..whole }, "scale");
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        refuse(Instance { scale, ..whole }, "it is positive");
    }
    for (at, factor) in [(0, f32::NAN), (1, -1.0), (3, 1.5), (3, f32::NAN)] {
        let mut tint = [1.0; 4];
        tint[at] = factor;
        refuse(Instance { tint, ..whole }, "has tint");
    }
    let clip = Some([DVec3::NAN, DVec3::ONE]);
    refuse(Instance { clip, ..whole }, "NaN");
}

/// A hundred instances, which all move, of one model and of a hundred: the processor's time of a recording.
#[test]
fn a_recording_of_a_hundred_moving_instances_takes_little() {
    with_host(|host, gpu| {
        let mut frame = 0;
        for (models, count) in [(1, 10_000), (100, 100)] {
            let mut gaussians = Gaussians::zeros(count, 1);
            for (i, mean) in gaussians.means_mut().iter_mut().enumerate() {
                let uniform = |row| Stream::new(8, row).uniform(i as u64) as f32 - 0.5;
                *mean = Vec3::new(uniform(0), uniform(1), uniform(2));
            }
            gaussians.log_scales_mut().fill(Vec3::splat(-5.0));
            gaussians.quats_mut().fill([1.0, 0.0, 0.0, 0.0]);
            let on_device: Vec<_> = (0..models).map(|_| gaussians.upload(gpu).unwrap()).collect();
            let mut renderer = Renderer::new(gpu, settings(1)).unwrap();
            let mut record = || {
                frame += 1;
                let instances: Vec<_> = (0..100)
                    .map(|at| {
                        let angle = f64::from(at) + 0.1 * frame as f64;
                        let pose = DAffine3::from_rotation_translation(
                            DQuat::from_rotation_z(angle),
                            DVec3::new(f64::from(at % 10) - 4.5, f64::from(at / 10) - 4.5, 9.0),
                        );
                        Instance { pose, ..Instance::new(&on_device[at as usize % models]) }
                    })
                    .collect();
                let mut took = Duration::ZERO;
                drawn(host, gpu, frame, |pass, target| {
                    let began = Instant::now();
                    let camera = &cameras()[..1];
                    let done = renderer.draw_instances(pass, &instances, camera, &BLACK, target);
                    took = began.elapsed();
                    done
                });
                took
            };
            record();
            let fastest = (0..20).map(|_| record()).min().unwrap();
            println!("{models} models: {fastest:?}");
            // Without optimisation and with validation; the documentation has the figure that is promised.
            assert!(fastest < Duration::from_millis(200), "{fastest:?}");
        }
        assert!(size_of::<InstanceView>() <= 128);
    });
}
