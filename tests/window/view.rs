//! `view --window` and `train --window` on an X server without a screen.

use std::fs;
use std::process::Command;

use glam::DVec2;
use nightsplat::camera::Camera;
use nightsplat::gpu::testing::gpu;
use nightsplat::photographs::dataset::{Dataset, LoadOptions};
use nightsplat::photographs::image::Image;
use nightsplat::splats::model::Model;
use nightsplat::splats::render::{RenderOptions, Renderer};

use crate::common::command::{command, refused_with, succeed};
use crate::common::not_run;
use crate::common::place::Place;

/// Runs `nightsplat` on a display of its own; its error output.
fn with_display(arguments: &str) -> String {
    let plain = command(arguments);
    let run = Command::new("xvfb-run")
        .args(["--auto-servernum", "--server-args", "-screen 0 1600x1024x24"])
        .arg(plain.get_program())
        .args(plain.get_args())
        .envs(plain.get_envs().filter_map(|(key, value)| Some((key, value?))))
        .env_remove("WAYLAND_DISPLAY")
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{arguments}: {errors}");
    errors
}

fn has_no_display() -> bool {
    let is_absent = Command::new("xvfb-run").arg("--help").output().is_err();
    if is_absent {
        not_run("xvfb", "there is no xvfb-run (on Debian `apt install xvfb xauth`)");
    }
    is_absent
}

#[test]
fn a_window_shows_a_run_as_the_renderer_renders_it() {
    if has_no_display() {
        return;
    }
    let place = Place::new();
    let path = |name: &str| place.path(name).display().to_string();
    succeed(&place.train("run", "--steps 60"));
    let shot = path("shot.png");
    with_display(&format!("view {} --window --frames 4 --screenshot {shot}", path("run")));
    let picture = Image::load(&shot).unwrap();
    assert_eq!([picture.width, picture.height], [1280, 720]);

    let model = Model::load(place.path("run")).unwrap();
    let dataset = Dataset::load(place.path("set"), &LoadOptions::default()).unwrap();
    let view = &dataset.views[0].camera;
    // As large as the window allows.
    let scale = (1280.0 / f64::from(view.width)).min(720.0 / f64::from(view.height));
    let half = DVec2::new(f64::from(view.width), f64::from(view.height)) / 2.0;
    let camera = Camera {
        width: 1280,
        height: 720,
        focal: view.focal * scale,
        principal_point: (view.principal_point - half) * scale + DVec2::new(640.0, 360.0),
        ..*view
    };
    let gpu = gpu();
    let on_device = model.gaussians.upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, model.render_settings()).unwrap();
    renderer.reserve(model.gaussians.count, [&camera]).unwrap();
    let sh_degree = model.gaussians.shape.sh_degree;
    let options = RenderOptions { sh_degree, background: [0.0; 3] };
    let own = renderer.render_image(&on_device, &camera, &options).unwrap();
    let level = |value: f32| 255.0 * value.clamp(0.0, 1.0);
    let is_off = |(a, b): (&f32, &f32)| (level(*a) - level(*b)).abs() > 1.0;
    let off = own.data.iter().zip(&picture.data).filter(|pair| is_off(*pair)).count();
    assert!(off as f64 <= 1e-4 * own.data.len() as f64, "{off} of {} values", own.data.len());
    assert!(own.data.iter().filter(|value| **value > 0.1).count() > own.data.len() / 10);
}

#[test]
fn a_training_that_is_watched_in_a_window_writes_the_same_model() {
    if has_no_display() {
        return;
    }
    let place = Place::new();
    succeed(&place.train("alone", "--steps 300"));
    with_display(&format!("{} --window", place.train("watched", "--steps 300")));
    assert!(place.model("alone") == place.model("watched"), "watching changed the model");
}

#[test]
fn a_window_without_a_display_or_a_model_is_refused() {
    let place = Place::new();
    let path = |name: &str| place.path(name).display().to_string();
    fs::write(place.path("no.ply"), "ply\n").unwrap();
    let nothing = format!("view {} --window", path("no.ply"));
    refused_with(&nothing, &[], 3, &["no.ply"]);
    succeed(&place.train("run", "--steps 2"));
    let none = [("DISPLAY", ""), ("WAYLAND_DISPLAY", ""), ("WAYLAND_SOCKET", "")];
    let view = format!("view {} --window", path("run"));
    refused_with(&view, &none, 2, &["no display", "leave out --window"]);
    let train = format!("{} --window", place.train("no", "--steps 2"));
    refused_with(&train, &none, 2, &["no display"]);
    assert!(!place.path("no").exists());
}
