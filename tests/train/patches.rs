//! Views too large for one pass are rendered and trained on in patches, with the same result.

use nightsplat::splats::render::{self, GradientNorm};
use nightsplat::train::{Part, Rendered};
use nightsplat_core::camera::TrainingFrame;
use nightsplat_photographs::dataset::View;
use nightsplat_photographs::image::Mask;

use crate::common::command::{command, refused, succeed};
use crate::common::not_run;
use crate::common::prelude::*;
use crate::common::setup::features;

/// Gaussians of every kind in a view of several patches; some are far outside it.
fn setup(patch_pixels: Option<u64>) -> Setup {
    let shape = Shape { sh_degree: 2, features: features(5) };
    let mut setup = Setup::new(400, [83, 57], shape, 3);
    setup.settings.patch_pixels = patch_pixels;
    setup
}

fn renderer(setup: &Setup) -> Renderer {
    let mut renderer = Renderer::new(&gpu(), setup.settings).unwrap();
    renderer.reserve(setup.count, [&setup.camera]).unwrap();
    renderer
}

#[test]
fn patches_show_what_the_whole_view_shows() {
    let whole = setup(None);
    let rendered = whole.render();
    let expected = [&rendered.render[..], &rendered.transmittances].concat();
    let gaussians = whole.upload();
    for (patch_pixels, count) in [(2500, 2), (1000, 6), (300, 20)] {
        let setup = setup(Some(patch_pixels));
        let mut renderer = renderer(&setup);
        assert_eq!(renderer.patches(&setup.camera).len(), count);
        let shown = renderer.render_planes(&gaussians, &setup.camera, &setup.options).unwrap();
        assert_eq!(shown.len(), (setup.channels() + 1) * setup.pixels());
        let errors = shown.iter().zip(&expected).map(|(shown, whole)| (shown - whole).abs());
        // A splat may be just above the minimum alpha in one and just below it in the other.
        let far = errors.clone().filter(|&error| error > 1e-4).count();
        assert!(far * 1000 <= shown.len(), "{far} of {}", shown.len());
        assert!(errors.fold(0.0, f32::max) < 0.02);
    }
}

/// The gradients of the parameters and the statistics for density control, with a loss for each pixel of each patch.
fn gradients(setup: &Setup, weights: &[f32]) -> [Vec<f32>; 3] {
    let (gpu, mut renderer) = (gpu(), renderer(setup));
    let gaussians = setup.upload();
    let mut sums = vec![0.0; setup.parameters.len()];
    let mut grad_norm_sums = gpu.zeros("grad_norm_sums", setup.count).unwrap();
    let mut visit_counts = gpu.zeros("visit_counts", setup.count).unwrap();
    let mut parameters = gpu.buffer("gradients", &sums).unwrap();
    for patch in renderer.patches(&setup.camera) {
        let share = patch.pixel_count() as f32 / setup.pixels() as f32;
        let d_render: Vec<f32> = patch.cut(weights).iter().map(|weight| weight / share).collect();
        let d_render = gpu.buffer("d_render", &d_render).unwrap();
        gpu.run("patch", |pass| {
            renderer.forward(pass, &gaussians, patch, &setup.options)?;
            let gradients = render::Gradients {
                parameters: &mut parameters,
                grad_norm_sums: &mut grad_norm_sums,
                visit_counts: &mut visit_counts,
            };
            let norm = GradientNorm { adds_pixels: true, damping_weight: 0.7, damping_depth: 3.0 };
            renderer.backward(pass, &gaussians, patch, &setup.options, norm, &d_render, gradients)
        })
        .unwrap();
        for (sum, gradient) in sums.iter_mut().zip(gpu.read(&parameters).unwrap()) {
            *sum += share * gradient;
        }
    }
    let visits: Vec<u32> = gpu.read(&visit_counts).unwrap();
    let visits = visits.into_iter().map(|visits| visits as f32).collect();
    [sums, gpu.read(&grad_norm_sums).unwrap(), visits]
}

#[test]
fn the_gradients_of_the_patches_add_up_to_that_of_the_view() {
    let whole = setup(None);
    let mut random = Random::new(9);
    let len = whole.channels() * whole.pixels();
    let weights: Vec<f32> = (0..len).map(|_| random.between(-1.0, 1.0) as f32).collect();
    let [expected, norms, visits] = gradients(&whole, &weights);
    let [sums, own_norms, own_visits] = gradients(&setup(Some(2500)), &weights);
    let planes = whole.planes();
    for column in 0..planes.float_count() / planes.count {
        let plane = column * planes.count..(column + 1) * planes.count;
        let largest = expected[plane.clone()].iter().fold(0.0, |a: f32, b| a.max(b.abs()));
        for i in plane {
            let error = (sums[i] - expected[i]).abs();
            assert!(error <= 2e-3 * largest, "{i}: {} instead of {}", sums[i], expected[i]);
        }
    }
    // A Gaussian visible in one patch only counts for density control as in the whole view.
    let alone = (0..whole.count).filter(|&i| own_visits[i] == 1.0 && visits[i] == 1.0);
    let alone: Vec<usize> = alone.collect();
    assert!(alone.len() > whole.count / 4);
    for i in alone {
        let (sum, norm) = (own_norms[i], norms[i]);
        assert!((sum - norm).abs() <= 1e-2 * norm + 1e-3, "{i}: {sum} instead of {norm}");
    }
}

/// Eight views of 64 x 48 pixels.
fn dataset() -> Dataset {
    crate::common::train::dataset(8, [64, 48])
}

fn config(patch_pixels: Option<u64>) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config = TrainConfig { steps: 60, tone, patch_pixels, ..TrainConfig::bare() };
    config.schedule.densify_after = 10;
    config.schedule.densify_interval = 20;
    config
}

#[test]
fn training_starts_as_with_whole_views_and_uses_every_patch_of_every_photograph_in_turn() {
    let dataset = dataset();
    let whole = Trainer::new(&gpu(), config(None), &dataset).unwrap();
    let mut trainer = Trainer::new(&gpu(), config(Some(800)), &dataset).unwrap();
    assert_eq!(
        whole.gaussians().unwrap().parameters,
        trainer.gaussians().unwrap().parameters,
        "colours come from whole photographs"
    );
    let photographs = dataset.train_views().count();
    let reports = advance(&mut trainer, 4 * photographs as u64);
    for view in dataset.train_views() {
        assert_eq!(reports.iter().filter(|report| report.view == view.name).count(), 4);
    }
    // As good as with whole views, after as many pixels.
    let psnr = |config: TrainConfig| {
        let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        advance(&mut trainer, config.steps);
        let view = dataset.test_views().next().unwrap();
        let shown = trainer.render(&view.camera).unwrap().colors;
        Scores::measure(&shown, view.reference.as_ref().unwrap()).unwrap().psnr
    };
    let expected = psnr(TrainConfig { steps: 60, ..config(None) });
    let patched = psnr(TrainConfig { steps: 240, ..config(Some(800)) });
    assert!(patched > expected - 0.5, "{patched} dB, whole views {expected} dB");
}

#[test]
fn every_part_of_the_model_trains_on_patches_and_two_runs_have_the_same_bits() {
    let mut dataset = dataset();
    for view in &mut dataset.views {
        let (width, height) = (view.camera.width, view.camera.height);
        let weights = (0..width * height).map(|i| f32::from(u8::from(i % width > 9))).collect();
        view.mask = Some(Mask { width, height, weights });
        view.depth = Some((0..width * height).map(|i| (i / width) as f32 / 48.0).collect());
    }
    let mut config = TrainConfig { steps: 12, ..config(Some(800)) };
    config.schedule.resolution_steps = Some([0, 5]);
    let mut exposed = config.clone();
    exposed.exposure.learn = true;
    config.model.set_parts(&Part::ALL);
    config.model.network.channels = 4;
    config.model.network.stages = 2;
    let mut cropped = config.clone();
    cropped.model.denoiser_crop = 20;
    for config in [config, cropped, exposed] {
        let run = || {
            let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
            let reports = advance(&mut trainer, config.steps);
            assert!(reports.iter().all(|report| report.loss.is_finite()));
            let shown = trainer.render(&dataset.views[0].camera).unwrap();
            assert_eq!([shown.colors.width, shown.colors.height], [64, 48]);
            (trainer.gaussians().unwrap().parameters, shown.output().data.clone())
        };
        assert!(run() == run());
    }
}

#[test]
fn a_denoiser_reads_around_each_patch() {
    let dataset = dataset();
    let mut config = TrainConfig { steps: 20, ..config(None) };
    config.model.set_parts(&[Part::Denoiser]);
    config.model.network.channels = 4;
    config.model.rates.denoiser = 1e-2;
    let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
    advance(&mut trainer, config.steps);
    let sh_degree = config.render_settings().shape.sh_degree;
    let gaussians = trainer.gaussians_in_frame().unwrap().with_sh_degree(sh_degree);
    let camera = trainer.frame().camera(&dataset.views[0].camera);
    let on_device = gaussians.upload(&gpu()).unwrap();
    let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
    let [whole, patches] = [None, Some(800)].map(|patch_pixels| {
        let settings = RenderSettings { patch_pixels, ..config.render_settings() };
        let mut renderer = Renderer::new(&gpu(), settings).unwrap();
        Rendered::new(&mut renderer, &on_device, &camera, &options, trainer.networks()).unwrap()
    });
    let largest = |one: &Image, other: &Image| {
        let errors = one.data.iter().zip(&other.data).map(|(one, other)| (one - other).abs());
        errors.fold(0.0, f32::max)
    };
    assert!(largest(&whole.colors, &patches.colors) < 1e-3);
    let [whole, patches] = [&whole, &patches].map(|shown| shown.denoised.as_ref().unwrap());
    assert!(largest(whole, &dataset.views[0].image.clone().unwrap()) > 0.1);
    // The norms are computed per patch.
    let error = largest(whole, patches);
    assert!(error < 0.1, "{error}");
}

#[test]
fn a_run_on_patches_is_reported_resumed_to_the_same_bits_and_scored() {
    let workspace = Workspace::new();
    let output =
        command(&workspace.train("straight", "--steps 30 --patch-pixels 600")).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(message.contains("40x30, in 2 of about 20x30"), "{message}");
    let config = String::from_utf8(workspace.read("straight/config.toml")).unwrap();
    assert!(config.contains("patch_pixels = 600"));
    let stopped = "--steps 30 --patch-pixels 600 --hash-every 7 --max-minutes 1e-7";
    let output = command(&workspace.train("run", stopped)).output().unwrap();
    assert_eq!(output.status.code(), Some(75));
    succeed(&workspace.train("run", "--steps 30 --patch-pixels 600 --resume"));
    assert!(workspace.model("run") == workspace.model("straight"));
    assert!(
        workspace.model("straight") != {
            succeed(&workspace.train("whole", "--steps 30"));
            workspace.model("whole")
        }
    );
    refused(
        &workspace.train("few", "--patch-pixels 255"),
        2,
        &["patch_pixels (--patch-pixels) is 255", "256"],
    );
    assert!(!fs::exists(workspace.path("few")).unwrap());
}

/// `count` Gaussians that each cover a view of this size.
fn covering(count: usize, size: [u32; 2]) -> Setup {
    let mut setup = Setup::new(count, size, 0, 4);
    for i in 0..count {
        let mut gaussian = setup.get(i);
        gaussian.mean = setup.at_pixel(0.5 * setup.camera().size, 2.0 + i as f64 / 100.0);
        gaussian.log_scale = DVec3::splat(1.0);
        gaussian.raw_opacity = -4.0;
        setup.set(i, &gaussian);
    }
    setup
}

#[test]
fn more_intersections_than_the_device_binds_are_rendered_in_halves() {
    let setup = covering(300, [1440, 1280]);
    let mut renderer = renderer(&setup);
    let most = renderer.max_intersections();
    if most > 1 << 22 {
        return not_run("lavapipe", format_args!("this device binds {most} intersections at once"));
    }
    let gaussians = setup.upload();
    let shown = renderer.render_channels(&gaussians, &setup.camera, &setup.options).unwrap();
    assert!(renderer.intersections().unwrap() > most / 3, "the last was no half");
    let mut parted = setup.clone();
    parted.settings.patch_pixels = Some(1 << 18);
    let mut renderer = self::renderer(&parted);
    let expected = renderer.render_channels(&gaussians, &setup.camera, &setup.options).unwrap();
    let errors = shown.iter().zip(&expected).map(|(shown, expected)| (shown - expected).abs());
    assert!(errors.fold(0.0, f32::max) < 1e-3);
}

#[test]
fn training_uses_patches_whose_intersections_the_device_can_process() {
    let setup = covering(300, [1440, 1280]);
    if renderer(&setup).max_intersections() > 1 << 22 {
        return not_run("lavapipe", "this device binds more intersections at once");
    }
    let dark = Image::filled(1440, 1280, [0.1; 3]);
    let view = |name| View::new(name, Split::Train, setup.camera, Some(dark.clone()));
    let dataset = Dataset {
        root: ".".into(),
        views: vec![view("a"), view("b")],
        points: vec![],
        skipped: vec![],
    };
    let gaussians = setup.gaussians();
    let mut config = TrainConfig { steps: 8, sh_degree: 0, ..config(None) };
    config.frame = Some(TrainingFrame::WORLD);
    config.schedule.resolution_steps = Some([0, 0]);
    let mut trainer = Trainer::from_gaussians(&gpu(), config, &dataset, &gaussians).unwrap();
    // Four quarters of each view, with room for twice the intersections.
    let reports = advance(&mut trainer, 8);
    for name in ["a", "b"] {
        assert_eq!(reports.iter().filter(|report| report.view == name).count(), 4);
    }
}
