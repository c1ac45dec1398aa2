//! One sort for the eyes of a headset, against a sort for each.

use glam::DQuat;
use nightsplat::splats::device::Upload;
use nightsplat::splats::render::Instance;
use nightsplat_core::camera::KannalaBrandt;

use super::*;

/// Two eyes this far apart, each turned inwards by this many degrees, of a head that is turned as well.
fn eyes(distance: f64, degrees: f64) -> [Camera; 2] {
    let head = DAffine3::from_rotation_translation(
        DQuat::from_rotation_z(0.3) * DQuat::from_rotation_y(0.1),
        DVec3::new(0.1, -0.05, 0.0),
    );
    [-1.0, 1.0].map(|side| {
        let eye = DAffine3::from_rotation_translation(
            DQuat::from_rotation_y(-side * degrees.to_radians()),
            DVec3::new(side * distance / 2.0, 0.0, 0.0),
        );
        Camera { view_from_world: (head * eye).inverse(), ..cameras()[0] }
    })
}

/// Gaussians that overlap in view of eyes a metre apart: of three centimetres to eight, 1.5 to 4 away.
fn overlapping() -> Gaussians {
    let mut gaussians = Gaussians::zeros(1500, 0);
    let uniform = |row, i| Stream::new(5, row).uniform(i as u64) as f32;
    for (i, mean) in gaussians.means_mut().iter_mut().enumerate() {
        *mean = Vec3::new(
            4.0 * uniform(0, i) - 2.0,
            4.0 * uniform(1, i) - 2.0,
            1.5 + 2.5 * uniform(2, i),
        );
    }
    for (i, log_scale) in gaussians.log_scales_mut().iter_mut().enumerate() {
        *log_scale = Vec3::splat((0.03 + 0.05 * uniform(3, i)).ln());
    }
    gaussians.quats_mut().fill([1.0, 0.0, 0.0, 0.0]);
    let count = gaussians.count;
    for (i, value) in gaussians.parameters[10 * count..].iter_mut().enumerate() {
        // Opacities, then colours.
        *value = if i < count { 1.5 } else { 3.0 * uniform(4, i) - 1.5 };
    }
    gaussians
}

/// The bytes of both eyes, and the depths, with a sort for each or one for both.
struct Drawn {
    pixels: [Vec<u32>; 2],
    depths: [Vec<u32>; 2],
}

struct Eyes<'a> {
    host: &'a Host,
    gpu: &'a Gpu,
    renderer: Renderer,
    frame: u64,
}

impl<'a> Eyes<'a> {
    fn new(host: &'a Host, gpu: &'a Gpu) -> Self {
        Self { host, gpu, renderer: Renderer::new(gpu, show_settings()).unwrap(), frame: 0 }
    }

    fn draw(
        &mut self,
        instances: &[Instance<'_>],
        cameras: &[Camera; 2],
        shares_sort: bool,
    ) -> Drawn {
        let Self { host, gpu, renderer, frame } = self;
        *frame += 1;
        let [color, depth] = [ImageFormat::Rgba8Unorm, ImageFormat::R32Float]
            .map(|format| host.picture(format, SIZE).unwrap());
        let [color_image, depth_image]: [HostImage; 2] = [&color, &depth]
            .map(|picture| picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE));
        let target = Target {
            color: Some(&color_image),
            depth: Some(&depth_image),
            shares_sort,
            ..Target::default()
        };
        let commands = host.begin();
        let recorded = HostFrame { commands: commands.as_raw(), number: *frame, readers: 0 };
        // SAFETY: the command buffer is recording, outside a render pass.
        unsafe {
            gpu.record_into(&recorded, |pass| match instances {
                // A model without transform has kernels of its own.
                [one] => renderer.draw(pass, one.gaussians, cameras, &OPTIONS, &target),
                _ => renderer.draw_instances(pass, instances, cameras, &OPTIONS, &target),
            })
        }
        .unwrap();
        host.submit_frame(commands, *frame);
        host.wait_frame(*frame);
        let pixels = host.read_picture(&color, PIXELS);
        let depths = host.read_picture(&depth, PIXELS);
        [color, depth].into_iter().for_each(|picture| host.free_picture(picture));
        Drawn { pixels, depths }
    }
}

fn bytes(pixels: &[Vec<u32>; 2]) -> impl Iterator<Item = f64> {
    pixels.iter().flatten().flat_map(|word| word.to_le_bytes().map(f64::from))
}

/// The largest difference in levels of 255, and the PSNR.
fn error(a: &Drawn, b: &Drawn) -> (f64, f64) {
    let off: Vec<f64> =
        bytes(&a.pixels).zip(bytes(&b.pixels)).map(|(a, b)| (a - b).abs()).collect();
    let mean_square = off.iter().map(|off| off * off).sum::<f64>() / off.len() as f64;
    (off.iter().copied().fold(0.0, f64::max), 10.0 * (255.0 * 255.0 / mean_square).log10())
}

#[test]
fn eyes_that_look_the_same_way_share_a_sort_to_the_bit() {
    with_host(|host, gpu| {
        let on_device = overlapping().upload(gpu).unwrap();
        let whole = Instance::new(&on_device);
        // One of them is in view of one eye alone.
        let aside = Instance { pose: DAffine3::from_translation(DVec3::X * 4.0), ..whole };
        let mut draws = Eyes::new(host, gpu);
        for distance in [0.0, 0.065, 0.25, 1.0] {
            let cameras = eyes(distance, 0.0);
            for instances in [&[whole][..], &[whole, aside]] {
                let [apart, together] =
                    [false, true].map(|shares_sort| draws.draw(instances, &cameras, shares_sort));
                assert!(bytes(&apart.pixels).any(|byte| byte > 200.0), "nothing is seen");
                assert_eq!(apart.pixels, together.pixels, "{distance}");
                assert_eq!(apart.depths, together.depths, "{distance}");
                assert_eq!(apart.pixels[0] == apart.pixels[1], distance == 0.0);
            }
        }
    });
}

/// The error of eyes that look at a point two metres ahead, by their distance: stated in docs/embedding.md.
#[test]
fn eyes_that_squint_differ_by_little_where_splats_intersect() {
    with_host(|host, gpu| {
        let on_device = overlapping().upload(gpu).unwrap();
        let whole = [Instance::new(&on_device)];
        let mut draws = Eyes::new(host, gpu);
        let mut errors = vec![];
        for (distance, most_levels, least_psnr) in
            [(0.065, 20.0, 57.0), (0.25, 30.0, 49.0), (1.0, 130.0, 36.0)]
        {
            let degrees = f64::atan2(distance / 2.0, 2.0).to_degrees();
            let cameras = eyes(distance, degrees);
            let [apart, together] =
                [false, true].map(|shares_sort| draws.draw(&whole, &cameras, shares_sort));
            let (levels, psnr) = error(&apart, &together);
            println!("{distance} m, {degrees:.1} degrees: {levels} levels, {psnr:.1} dB");
            assert!(levels <= most_levels && psnr >= least_psnr, "{levels} {psnr}");
            errors.push(psnr);
        }
        assert!(errors[2].is_finite() && errors.is_sorted_by(|a, b| a >= b), "{errors:?}");
    });
}

/// Sheets of splats, farther apart than the tangent of the angle times the distance across the axis of two splats of
/// one pixel: the order is that of each eye.
#[test]
fn a_squint_changes_nothing_where_depths_are_far_apart() {
    with_host(|host, gpu| {
        let mut gaussians = overlapping();
        let sheets = [1.5, 2.5, 3.5];
        for (i, mean) in gaussians.means_mut().iter_mut().enumerate() {
            // On a grid, whose splats do not meet those of their sheet.
            let (column, row) = (i / 3 % 22, i / 66);
            *mean =
                Vec3::new(0.2 * (column as f32 - 11.0), 0.2 * (row as f32 - 11.0), sheets[i % 3]);
        }
        gaussians.log_scales_mut().fill(Vec3::splat(0.02f32.ln()));
        let on_device = gaussians.upload(gpu).unwrap();
        let whole = [Instance::new(&on_device)];
        let mut draws = Eyes::new(host, gpu);
        let cameras = eyes(0.25, 5.0);
        let [apart, together] =
            [false, true].map(|shares_sort| draws.draw(&whole, &cameras, shares_sort));
        assert!(bytes(&apart.pixels).any(|byte| byte > 150.0), "nothing is seen");
        assert_eq!(apart.pixels, together.pixels);
        assert_eq!(apart.depths, together.depths);
    });
}

#[test]
fn every_pass_of_two_eyes_agrees_with_its_reference_and_depths_are_sorted_once() {
    let host = Host::new(usual_extensions());
    {
        // SAFETY: the handles are the host's own and outlive `gpu`; nothing else uses the queue meanwhile.
        let gpu = unsafe { Gpu::from_host(host.lend()) }.unwrap();
        let on_device = gaussians().upload(&gpu).unwrap();
        let mut renderer = Renderer::new(&gpu, show_settings()).unwrap();
        let whole = Instance::new(&on_device);
        let turned = Instance {
            pose: DAffine3::from_rotation_translation(
                DQuat::from_rotation_y(0.7),
                DVec3::new(0.5, 0.0, 0.5),
            ),
            scale: 1.25,
            ..whole
        };
        let color = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
        let image = color.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
        let mut sorts = |shares_sort, instances: &[Instance<'_>]| {
            let target = Target { color: Some(&image), shares_sort, ..Target::default() };
            let (done, report) = gpu.checked(|| {
                gpu.run("draw", |pass| match instances {
                    [one] => renderer.draw(pass, one.gaussians, &eyes(0.3, 4.0), &OPTIONS, &target),
                    _ => {
                        renderer.draw_instances(pass, instances, &eyes(0.3, 4.0), &OPTIONS, &target)
                    }
                })
            });
            done.unwrap();
            report.agree().unwrap();
            let passes = report.kernels().into_iter();
            passes.filter(|(name, ..)| *name == "sort_downsweep").map(|(_, n, _)| n).sum::<usize>()
        };
        for instances in [&[whole][..], &[whole, turned]] {
            let [apart, together] = [false, true].map(|shares| sorts(shares, instances));
            // By depth in three passes of each eye, or of both.
            assert_eq!(together + 3, apart);
        }
        host.free_picture(color);
    }
    host.destroy();
}

#[test]
fn eyes_that_cannot_share_a_sort_are_refused() {
    let gpu = gpu();
    let on_device = gaussians().upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, show_settings()).unwrap();
    let image = HostImage {
        handle: 1,
        format: ImageFormat::Rgba8Unorm,
        size: SIZE,
        layer: 0,
        before: ImageState::UNDEFINED,
        after: ImageState::SAMPLED,
    };
    let target = Target { color: Some(&image), shares_sort: true, ..Target::default() };
    let mut prepare =
        |cameras: [Camera; 2]| renderer.prepare_draw(&on_device.layout, &cameras, &target);
    prepare(eyes(1.0, 29.0)).unwrap();
    let refused = |refused: nightsplat::Result<()>, words: &str| {
        let message = refused.unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    };
    refused(prepare(eyes(1.0, 31.0)), "looks 31 degrees beside the mean");
    refused(prepare(eyes(1.0, 90.0)), "camera 0 looks");
    let lens = KannalaBrandt { coefficients: [0.0; 4] };
    let fisheye = Camera { model: CameraModel::Fisheye(lens), ..cameras()[0] };
    refused(prepare([cameras()[0], fisheye]), "camera 1 is a fisheye");
}
