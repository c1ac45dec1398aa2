//! A lamp that moves with the camera is told from the surfaces that it lights.

use nightsplat::splats::lamp::Lamp;
use nightsplat::targets::Targets;
use nightsplat::train::Part;
use nightsplat_models::gaussians::init::Initialization;
use nightsplat_photographs::dataset::{Point, View};

use crate::common::command::json;
use crate::common::prelude::*;

/// The sides of a gallery along z, and half its length.
const HALF: DVec3 = DVec3::new(1.0, 0.8, 4.0);
const SIZE: [u32; 2] = [64, 48];
const VIEWS: usize = 24;

fn lamp() -> Lamp {
    Lamp {
        position: [0.1, -0.1, 0.0],
        axis: [0.05, 0.0],
        ambient: 0.01,
        exponent: 2.0,
        falloffs: [4.0, 1.0],
        reference_distance: 1.5,
        ..Lamp::AT_CAMERA
    }
}

/// Positions and colours on the walls of the gallery.
fn walls() -> (Vec<DVec3>, Vec<Vec3>) {
    let draws = Stream::new(7, 1);
    let number = |i: u64, k: u64| draws.uniform(6 * i + k);
    let on_wall = |i: u64| {
        let inside = DVec3::new(number(i, 0), number(i, 1), number(i, 2)) * 2.0 - 1.0;
        let (wall, side) = ((number(i, 3) * 2.4) as usize, 2.0 * (i % 2) as f64 - 1.0);
        let mut point = inside * HALF;
        point[wall] = side * HALF[wall];
        point
    };
    let points: Vec<DVec3> = (0..1500).map(on_wall).collect();
    let tint = |point: &DVec3| {
        let wave = |at: f64| (0.55 + 0.35 * (3.0 * at).sin()) as f32;
        Vec3::new(wave(point.x + point.z), wave(point.y - point.z), wave(point.x - point.y))
    };
    let colors = points.iter().map(tint).collect();
    (points, colors)
}

/// Cameras along the gallery that look along it, one way or the other, and a bit aside.
fn camera(view: usize) -> Camera {
    let draws = Stream::new(9, 2);
    let number = |k: u64| 2.0 * draws.uniform(4 * view as u64 + k) - 1.0;
    let along = if view.is_multiple_of(2) { 0.0 } else { std::f64::consts::PI };
    let point = DVec3::new(0.4 * number(0), 0.3 * number(1), 2.8 * number(2));
    let turn = DMat3::from_rotation_y(along + 0.6 * number(3));
    let rotation = turn.transpose();
    pinhole(SIZE, 44.0, DAffine3 { matrix3: rotation, translation: -(rotation * point) })
}

/// Photographs of the gallery in the light of the lamp, and the same views in even light.
fn photographed() -> (Dataset, Vec<Image>) {
    let (gpu, (points, colors)) = (gpu(), walls());
    let start = Initialization { opacity: 0.95, scale: 1.0, ..Initialization::default() };
    let gaussians = Gaussians::from_points(&points, &colors, 0, &start, 1).unwrap();
    let on_device = gaussians.upload(&gpu).unwrap();
    let render = |lamp: Option<Lamp>| -> Vec<Image> {
        let settings = RenderSettings { shape: 0.into(), lamp, near: 0.05, ..Default::default() };
        let mut renderer = Renderer::new(&gpu, settings).unwrap();
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        let image = |view| {
            let camera = camera(view);
            renderer.reserve(gaussians.count, [&camera]).unwrap();
            renderer.render_image(&on_device, &camera, &options).unwrap()
        };
        (0..VIEWS).map(image).collect()
    };
    let (even, lit) = (render(None), render(Some(lamp())));
    let view = |(view, image): (usize, Image)| {
        let split = if view % 6 == 0 { Split::Test } else { Split::Train };
        View::new(&format!("{view:02}"), split, camera(view), Some(image))
    };
    let views: Vec<View> = lit.into_iter().enumerate().map(view).collect();
    // Those that see a point are near it: the others see a wall before it.
    let is_near = |view: &View, point: DVec3| view.camera.center().distance(point) < 3.0;
    let seen = |point: DVec3| {
        let sees = |(index, view): (usize, &View)| {
            let is_seen = view.camera.sees(point).is_some() && is_near(view, point);
            is_seen.then_some(index as u32)
        };
        views.iter().enumerate().filter_map(sees).collect()
    };
    let points = points.iter().map(|&position| Point { position, views: seen(position) });
    let points = points.collect();
    (Dataset { root: "gallery".into(), views, points, skipped: vec![] }, even)
}

fn config(parts: &[Part]) -> TrainConfig {
    let mut config = TrainConfig {
        steps: 700,
        sh_degree: 1,
        tone: ToneSettings::new(ToneCurve::None),
        near: 0.02,
        ..TrainConfig::bare()
    };
    config.model.set_parts(parts);
    // As a diagnosis would find it, roughly.
    (config.lamp.exponent, config.lamp.falloff, config.lamp.ambient) = (1.7, 3.0, 0.03);
    config
}

/// Mean PSNR of the test views in the light of the photographs, and evenly lit, there with the gain of least squares
/// for all: the brightness of even light is a matter of definition.
fn scores(trainer: &mut Trainer, dataset: &Dataset, even: &[Image]) -> [f64; 2] {
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    let mut products = [0.0_f32; 2];
    for (view, even) in dataset.views.iter().zip(even).filter(|(view, _)| view.is_train()) {
        let rendered = trainer.render_in_even_light(&view.camera).unwrap().colors;
        for (rendered, even) in rendered.data.iter().zip(&even.data) {
            products = [products[0] + rendered * even, products[1] + rendered * rendered];
        }
    }
    let gain = products[0] / products[1];
    for (view, even) in dataset.views.iter().zip(even).filter(|(view, _)| !view.is_train()) {
        let lit = trainer.render(&view.camera).unwrap().colors;
        let evenly = trainer.render_in_even_light(&view.camera).unwrap().colors;
        let psnr = |a: &Image, b: &Image| Scores::measure(a, b).unwrap().psnr;
        sums[0] += psnr(&lit, view.image.as_ref().unwrap());
        sums[1] +=
            psnr(&Image { data: evenly.data.iter().map(|x| gain * x).collect(), ..evenly }, even);
        count += 1.0;
    }
    sums.map(|sum| sum / count)
}

fn trained(parts: &[Part], dataset: &Dataset) -> Trainer {
    let config = config(parts);
    let mut trainer = Trainer::new(&gpu(), config.clone(), dataset).unwrap();
    advance(&mut trainer, config.steps);
    trainer
}

#[test]
fn a_lamp_is_told_from_the_surfaces_that_it_lights() {
    let (dataset, even) = photographed();
    let mut without = trained(&[], &dataset);
    let plain = scores(&mut without, &dataset, &even);
    let mut with = trained(&[Part::Lamp], &dataset);
    let [lit, evenly] = scores(&mut with, &dataset, &even);
    assert!(lit > 24.0 && evenly > 20.0, "lit {lit:.2} dB, evenly lit {evenly:.2} dB");
    assert!(lit > plain[0] + 2.0, "without a lamp {:.2} dB", plain[0]);
    assert_eq!(without.lamp().unwrap(), None);
    // The light along the axis and across it, up to the reference distances of both and the slope of the tone curve.
    let trained = with.lamp().unwrap().unwrap();
    let ratio = |lamp: &Lamp, point: DVec3| lamp.factor(point) / lamp.factor(1.5 * DVec3::Z);
    for point in [DVec3::Z, 3.0 * DVec3::Z, DVec3::new(0.7, 0.0, 1.2)] {
        let [trained, planted] = [&trained, &lamp()].map(|lamp| ratio(lamp, point));
        assert!(
            (trained / planted).ln().abs() < 0.2,
            "{point}: {trained:.3}, planted {planted:.3}"
        );
    }
}

#[test]
fn a_lamp_that_is_not_there_does_not_hurt() {
    let folder = written(&small_set(17, [80, 60], 4));
    let score = |parts: &[Part]| {
        let mut config = TrainConfig { steps: 600, ..TrainConfig::bare() };
        config.tone.scene_statistics = true;
        config.model.set_parts(parts);
        let dataset = Dataset::load(&folder, &config.load_options()).unwrap();
        let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        advance(&mut trainer, config.steps);
        // The curve's distance from the references is not the lamp's.
        let targets = Targets::new(&gpu(), &config.tone, &dataset).unwrap();
        let psnr = |view: &View| {
            let shown = trainer.render(&view.camera).unwrap().colors;
            Scores::measure(&shown, &targets.target(view).unwrap().unwrap()).unwrap().psnr
        };
        let scores: Vec<f64> = dataset.test_views().map(psnr).collect();
        scores.iter().sum::<f64>() / scores.len() as f64
    };
    let [plain, lit] = [&[][..], &[Part::Lamp]].map(score);
    println!("without {plain:.2} dB, forced {lit:.2} dB");
    assert!(lit > plain - 0.1, "without {plain:.2} dB, forced {lit:.2} dB");
}

#[test]
fn a_run_keeps_its_lamp_for_scores_and_for_a_flight_that_carries_it() {
    let workspace = Workspace::new();
    workspace.succeed("train @set --parts lamp --steps 30 --out @run --set lamp.ambient=0");
    let lamp = workspace.json("run/lamp.json");
    assert!(lamp["reference_distance"].as_f64().unwrap() > 0.1, "{lamp}");
    let config = workspace.text("run/config.toml");
    let gain = config.lines().find(|line| line.starts_with("scene_statistics")).unwrap();
    says(gain, &["true", "the part lamp"]);

    let eval = || json(workspace.succeed("eval @run --json"));
    let lit = eval();
    let psnr = |metrics: &Value| metrics["mean"]["psnr"].as_f64().unwrap();
    assert!((psnr(&lit) - psnr(&workspace.json("run/metrics.json"))).abs() < 1e-3);
    assert!(lit["lit_by_lamp"].is_null());
    workspace.succeed("render @run --split test --out @evenly");
    workspace.succeed("render @run --split test --lamp --out @carried");
    assert!(workspace.read("evenly/000.png") != workspace.read("carried/000.png"));

    // With its test views in the lamp's light, the references of a set are evenly lit.
    for name in ["000.png", "008.png"] {
        workspace.write(&format!("set/lit/{name}"), workspace.read(&format!("carried/{name}")));
    }
    let both = eval();
    assert!(both["mean"] != lit["mean"]);
    let equal = &both["lit_by_lamp"]["mean"]["psnr"];
    assert!(equal.is_null(), "equal images have no finite PSNR: {both:#}");
    assert!(both["lit_by_lamp"]["mean"]["ssim"].as_f64().unwrap() > 0.999);

    workspace.succeed("train @set --parts structure --steps 5 --out @without");
    assert!(!workspace.path("without/lamp.json").exists());
    let flight = "render @without --split test --lamp --out @none";
    workspace.refused(flight, 3, &["has no lamp", "leave out --lamp"]);
    workspace.write("run/lamp.json", "{\"exponent\": 9}");
    workspace.refused("eval @run", 3, &["lamp.json", "is not a lamp"]);
}

#[test]
fn a_lamp_that_cannot_be_told_from_something_else_is_warned_of() {
    let folder = written(&small_set(3, [40, 30], 2));
    let options = "--exposure on --steps 2 --set tone.scene_statistics=false";
    let (_, warnings) = folder.run(&format!("train @ --parts lamp {options} --out @run"), 0);
    let parts =
        ["2 training views do not tell a lamp", "a gain of its own", "exposures of views can take"];
    says(&warnings, &parts);
}
