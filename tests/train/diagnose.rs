//! The diagnosis finds the defects injected into a capture, and the plan follows from them.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use nightsplat::gpu::Gpu;
use nightsplat::train::plan::Plan;
use nightsplat::train::{Preset, TrainConfig, Trainer};
use nightsplat_core::random::Stream;
use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::dataset::{Dataset, DepthOptions, LoadOptions};
use nightsplat_photographs::image::{Image, ImageFile, linear_from_srgb, srgb_from_linear};
use nightsplat_synth::{Capture, Night, SyntheticOptions};

use crate::common::command::{refused, run, succeed, unwrapped};

const SET: SyntheticOptions = SyntheticOptions {
    views: 12,
    width: 96,
    height: 72,
    seed: 3,
    fisheye: false,
    street: None,
    lamp: None,
    night: Night::NONE,
    normals: false,
};
const MEMORY: u64 = 8 << 30;

fn written(capture: &Capture) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    nightsplat_synth::write_captured(folder.path(), &SET, capture).unwrap();
    folder
}

fn load(folder: &Path) -> (Dataset, LoadOptions) {
    let depth = DepthOptions { load: true, ..DepthOptions::default() };
    let options = LoadOptions { depth, ..LoadOptions::default() };
    (Dataset::load(folder, &options).unwrap(), options)
}

fn diagnosis_of(folder: &Path) -> Diagnosis {
    let (dataset, options) = load(folder);
    Diagnosis::new(&dataset, &options).unwrap()
}

fn plan_of(folder: &Path) -> Plan {
    Plan::new(&diagnosis_of(folder), &TrainConfig::default(), MEMORY)
}

fn diagnosis(capture: &Capture) -> Diagnosis {
    diagnosis_of(written(capture).path())
}

fn close(found: f64, injected: f64, what: &str) {
    assert!((found / injected - 1.0).abs() < 0.1, "{what}: {found}, injected {injected}");
}

/// Replaces every training photograph.
fn edit(folder: &Path, change: impl Fn(usize, &Image) -> Image) {
    let mut paths: Vec<_> =
        fs::read_dir(folder.join("low")).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    for (index, path) in paths.iter().enumerate() {
        change(index, &Image::load(path).unwrap()).save_png8(path).unwrap();
    }
}

/// A photograph at four times the size, a third of the light, and with noise: surfaces are wider than the few pixels in
/// which the noise is measured.
fn taken(image: &Image, gain: f64, read: f64, index: usize) -> Image {
    const TIMES: u32 = 4;
    let noise = Stream::new(7, index as u64);
    let (width, height) = (TIMES * image.width, TIMES * image.height);
    let linear = |x: f32, y: f32| -> [f32; 3] {
        let (x0, y0) = (x.floor(), y.floor());
        let at = |dx: u32, dy: u32| {
            let pixel = image.pixel(
                (x0 as u32 + dx).min(image.width - 1),
                (y0 as u32 + dy).min(image.height - 1),
            );
            pixel.map(|value| linear_from_srgb(value) / 3.0)
        };
        let (tx, ty) = (x - x0, y - y0);
        let [a, b, c, d] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
        std::array::from_fn(|i| {
            (1.0 - ty) * ((1.0 - tx) * a[i] + tx * b[i]) + ty * ((1.0 - tx) * c[i] + tx * d[i])
        })
    };
    Image::from_fn(width, height, |x, y| {
        let signal = linear(x as f32 / TIMES as f32, y as f32 / TIMES as f32);
        std::array::from_fn(|channel| {
            let signal = f64::from(signal[channel]);
            let draw = noise.normal(u64::from(3 * (y * width + x)) + channel as u64);
            let noisy = signal + (gain * signal + read * read).sqrt() * draw;
            srgb_from_linear(noisy as f32).clamp(0.0, 1.0)
        })
    })
}

// ---------------------------------------------------------------------------
// Diagnosis

#[test]
fn injected_noise_is_found_within_a_tenth() {
    let set = written(&Capture::clean());
    let clean: Vec<Image> = (0..SET.views)
        .map(|view| Image::load(set.path().join(format!("low/{view:03}.png"))).unwrap())
        .collect();
    for (gain, read) in [(5e-4, 6e-3), (1.5e-3, 1e-2)] {
        edit(set.path(), |index, _| taken(&clean[index], gain, read, index));
        let noise = diagnosis_of(set.path()).scene.noise.unwrap();
        close(noise.gain, gain, "gain");
        close(noise.read, read, "read noise");
    }
}

#[test]
fn injected_darkening_is_found_within_a_tenth() {
    let light = diagnosis(&Capture::clean()).scene;
    for darkening in [4.0, 25.0] {
        let dark = diagnosis(&Capture { darkening, ..Capture::clean() }).scene;
        close(dark.darkening / light.darkening, darkening, "darkening");
        assert!(dark.brightening > light.brightening && dark.code_values < light.code_values);
    }
    let noisy = diagnosis(&Capture::default()).scene;
    close(noisy.darkening / light.darkening, Capture::default().darkening, "darkening with noise");
}

#[test]
fn an_injected_spread_of_exposures_is_found_within_a_tenth_view_by_view() {
    let stops = vec![0.0, -1.0, -2.0, 1.0, 0.5];
    let capture = Capture { darkening: 8.0, stops: stops.clone(), ..Capture::default() };
    let found = diagnosis(&capture);
    let injected: Vec<f64> = (found.views.iter())
        .map(|view| stops[view.name.parse::<usize>().unwrap() % stops.len()])
        .collect();
    let mean = injected.iter().sum::<f64>() / injected.len() as f64;
    let variance = injected.iter().map(|stops| (stops - mean).powi(2)).sum::<f64>();
    close(found.scene.exposure_spread, (variance / injected.len() as f64).sqrt(), "spread");
    for (view, injected) in found.views.iter().zip(&injected) {
        let exposure = view.exposure.unwrap();
        assert!((exposure - (injected - mean)).abs() < 0.1, "{}: {exposure}", view.name);
    }
    assert!(diagnosis(&Capture::default()).scene.exposure_spread < 0.1);
}

#[test]
fn a_blurred_photograph_and_one_without_a_pose_are_named() {
    let set = written(&Capture::clean());
    // Moved by a few pixels during the exposure.
    let moved = |image: &Image| {
        Image::from_fn(image.width, image.height, |x, y| {
            let places = (0..9).map(|step| image.pixel((x + step).min(SET.width - 1), y));
            places.fold([0.0; 3], |sum, rgb| std::array::from_fn(|c| sum[c] + rgb[c] / 9.0))
        })
    };
    edit(set.path(), |index, image| {
        if index == 3 {
            let turned = moved(image);
            Image::from_fn(SET.width, SET.height, |x, y| {
                let places = (0..9).map(|step| turned.pixel(x, (y + step).min(SET.height - 1)));
                places.fold([0.0; 3], |sum, rgb| std::array::from_fn(|c| sum[c] + rgb[c] / 9.0))
            })
        } else {
            image.clone()
        }
    });
    fs::copy(set.path().join("low/001.png"), set.path().join("low/stray.png")).unwrap();
    let found = diagnosis_of(set.path());
    assert_eq!(found.without_pose, ["stray"]);
    for remark in ["more blurred than the others: 003", "without a pose, not used: stray"] {
        assert!(found.remarks.iter().any(|text| text.contains(remark)), "{:?}", found.remarks);
    }
    let view = |name: &str| found.views.iter().find(|view| view.name == name).unwrap();
    assert!(view("003").blur > view("002").blur);
    assert!(view("002").points > 100 && view("002").overlap > 0.5);
}

// ---------------------------------------------------------------------------
// Plan

/// The parts that a plan enables.
fn parts(plan: &Plan) -> Vec<&'static str> {
    let on = plan.decisions().into_iter().filter(|(_, value, _)| value == "on");
    on.map(|(name, ..)| name).collect()
}

#[test]
fn a_clean_well_lit_dataset_needs_no_part() {
    let plan = plan_of(written(&Capture::clean()).path());
    assert_eq!(parts(&plan), Vec::<&str>::new());
    assert_eq!(plan.left_out, Vec::<String>::new());
    assert!(plan.decisions().iter().all(|(_, _, why)| !why.is_empty()));
}

#[test]
fn each_part_is_enabled_with_its_cause() {
    let planned = |capture: &Capture| parts(&plan_of(written(capture).path()));
    assert_eq!(planned(&Capture { darkening: 25.0, ..Capture::clean() }), ["curve"]);
    let stops = vec![0.0, -1.0, 0.6];
    let set = written(&Capture { stops, darkening: 8.0, ..Capture::clean() });
    // A gain for each view removes the spread; one curve for all of them does not.
    assert_eq!(parts(&plan_of(set.path())), ["curve"]);
    let mut config = TrainConfig::default();
    config.tone.scene_statistics = true;
    let spread = parts(&Plan::new(&diagnosis_of(set.path()), &config, MEMORY));
    assert_eq!(spread, ["curve", "exposure", "structure"]);
    let grainy = Capture { full_well: 5.0, read_noise: 0.5, darkening: 3.0, ..Capture::clean() };
    let noisy = planned(&grainy);
    assert!(noisy.contains(&"denoiser") && !noisy.contains(&"exposure"), "{noisy:?}");

    let set = written(&Capture { darkening: 8.0, ..Capture::clean() });
    edit(set.path(), |_, image| {
        Image::from_fn(image.width, image.height, |x, y| {
            // A lamp in the middle: twelve stops darker on both sides.
            let side = (2.0 * x as f32 / image.width as f32 - 1.0).abs();
            let lamp = (-12.0 * side).exp2();
            image.pixel(x, y).map(|value| srgb_from_linear(8.0 * lamp * linear_from_srgb(value)))
        })
    });
    // The lamp moves with the camera: shared points would attribute it to exposures.
    fs::remove_dir_all(set.path().join("colmap_sparse")).unwrap();
    let plan = plan_of(set.path());
    assert!(plan.tonemapper.on, "{} {}", plan.tonemapper.why, plan.exposure.why);

    let set = written(&Capture::clean());
    fs::create_dir(set.path().join("depth")).unwrap();
    let map = Image::from_fn(SET.width, SET.height, |x, _| [x as f32 / 255.0; 3]);
    map.save_png8(set.path().join("depth/001.png")).unwrap();
    assert_eq!(parts(&plan_of(set.path())), ["depth"]);
}

#[test]
fn planned_values_follow_views_steps_memory_and_preset() {
    let set = written(&Capture::default());
    let found = diagnosis_of(set.path());
    let config = TrainConfig::default();
    let plan = |config: &TrainConfig, memory| {
        let plan = Plan::new(&found, config, memory);
        (plan.sh_degree.value, plan.max_gaussians.value, plan.max_gaussians.why)
    };
    let (degree, budget, why) = plan(&config, MEMORY);
    assert_eq!(budget, (10 * 96 * 72_u64 / 8).max(found.scene.points as u64), "{why}");
    assert!(degree >= 1, "{}", found.scene.views_per_point);
    let (_, small, why) = plan(&config, 1 << 20);
    assert!(small < budget && why.contains("GiB"), "{why}");
    assert_eq!(plan(&TrainConfig { steps: 400, ..config.clone() }, MEMORY).0, 0);
    let mut draft = config;
    Preset::Draft.apply(&mut draft).unwrap();
    draft.max_gaussians = 3000;
    let (degree, capped, why) = plan(&draft, MEMORY);
    assert!(degree == 0 && capped == 3000 && why.contains("limit"), "{why}");
}

#[test]
fn a_plan_survives_its_file_and_applies_only_to_its_dataset() {
    let set = written(&Capture::default());
    let (plan, path) = (plan_of(set.path()), set.path().join("plan.toml"));
    fs::write(&path, plan.to_toml().unwrap()).unwrap();
    let (dataset, options) = load(set.path());
    assert_eq!(Plan::load(&path, &dataset).unwrap(), plan);
    let half = Dataset::load(set.path(), &LoadOptions { downscale: 2.0, ..options }).unwrap();
    let refusal = Plan::load(&path, &half).unwrap_err().to_string();
    for part in ["plan.toml", "another dataset", "96x72", "48x36", "diagnose"] {
        assert!(refusal.contains(part), "{refusal}");
    }
    fs::write(&path, "[curve]\non = maybe\n").unwrap();
    let refusal = Plan::load(&path, &dataset).unwrap_err().to_string();
    assert!(refusal.contains("is not a plan") && refusal.contains("line 2"), "{refusal}");
    let (root, out) = (set.path().display(), set.path().join("run"));
    let absent = format!("train {root} --out {} --plan {root}/absent.toml", out.display());
    refused(&absent, 3, &["absent.toml", "cannot be read"]);
    assert!(!out.exists());
}

// ---------------------------------------------------------------------------
// Commands

#[test]
fn the_command_prints_json_and_writes_a_page_and_a_plan_that_train_uses() {
    let set = written(&Capture::default());
    let at = |name: &str| set.path().join(name).display().to_string();
    let root = set.path().display();
    let (page, plan, out) = (at("page.html"), at("plan.toml"), at("run"));
    let printed =
        succeed(&format!("diagnose {root} --json --report {page} --plan {plan} --steps 9"));
    let json: serde_json::Value = serde_json::from_str(&printed).unwrap();
    assert!(
        json["scene"]["brightening"].as_f64() > Some(2.0) && json["plan"]["curve"]["on"] == true
    );
    assert!(!json["device"].as_str().unwrap().is_empty());
    assert_eq!(json["views"].as_array().unwrap().len(), 10);
    let html = fs::read_to_string(&page).unwrap();
    let plan_at = html.find("The plan").unwrap();
    assert!(plan_at < html.find("<img").unwrap(), "the plan comes first");
    assert!(html.contains("Bad: below 0.02"), "a column states its unit and its bad values");
    assert!(!html.contains("http://") && !html.contains("https://"));
    let all = succeed(&format!("diagnose {root} -v"));
    let whole = unwrapped(&all);
    for part in ["10 photographs to train on (96x72), 2 held out", "denoiser off", "views"] {
        assert!(whole.contains(part), "{all}");
    }
    // Without -v: the verdict, what is on, and no measurement.
    let text = succeed(&format!("diagnose {root}"));
    assert!(text.lines().next().unwrap().contains(" set: 10 "), "{text}");
    assert!(
        !text.contains(" off ") && !text.contains("p90") && text.contains("\ncurve "),
        "{text}"
    );
    for line in text.lines().filter(|line| !line.starts_with("next:")) {
        assert!(line.chars().count() <= 80, "{line}");
    }

    // The user's change is kept, and an option overrides it.
    let written = fs::read_to_string(&plan).unwrap();
    let gaussians = written.split("[max_gaussians]\nvalue = ").nth(1).unwrap();
    let gaussians = gaussians.split_whitespace().next().unwrap();
    fs::write(&plan, written.replace(&format!("value = {gaussians}"), "value = 3210")).unwrap();
    let message = succeed(&format!(
        "train {root} --out {out} --plan {plan} --steps 9 --parts structure --set schedule.densify_after=99"
    ));
    assert!(message.contains("3210") && message.contains("views of 96x72"), "{message}");
    let config = fs::read_to_string(set.path().join("run/config.toml")).unwrap();
    for line in ["max_gaussians = 3210", "structure = true", "denoiser = false"] {
        assert!(config.contains(line), "no `{line}` in {config}");
    }
    let kept = fs::read_to_string(set.path().join("run/plan.toml")).unwrap();
    assert!(kept.contains("3210"), "{kept}");

    // A resumed run keeps its plan.
    let model = fs::read(set.path().join("run/model.ply")).unwrap();
    fs::remove_file(set.path().join("run/metrics.json")).unwrap();
    succeed(&format!(
        "train {root} --out {out} --resume --steps 9 --parts structure --set schedule.densify_after=99"
    ));
    assert_eq!(model, fs::read(set.path().join("run/model.ply")).unwrap());
    assert_eq!(kept, fs::read_to_string(set.path().join("run/plan.toml")).unwrap());
}

#[test]
fn a_preset_of_the_paper_and_a_configuration_are_not_planned() {
    let set = written(&Capture::default());
    let (root, out) = (set.path().display(), set.path().join("run"));
    let at = out.display();
    for options in ["--preset paper", "--preset lom", "--plan none"] {
        succeed(&format!("train {root} --out {at} --overwrite --steps 1 {options}"));
        let config = fs::read_to_string(out.join("config.toml")).unwrap();
        assert!(config.contains("max_gaussians = 1000000") && config.contains("sh_degree = 3"));
        assert!(!out.join("plan.toml").exists(), "{options}");
    }
    succeed(&format!("train {root} --out {at} --overwrite --steps 1"));
    assert!(out.join("plan.toml").exists());
}

#[test]
fn a_run_without_a_length_ends_when_held_out_views_have_converged() {
    let set = written(&Capture::default());
    let (root, out) = (set.path().display(), set.path().join("run"));
    // Any gain is too small.
    let options = "--preset draft --set stop.views=1 --set stop.every=5 --set stop.gain=90 --set stop.detail_gain=1 \
                   --set schedule.resolution_steps=[0,0] --set schedule.cooldown_steps=5 --set checkpoint_every=10";
    let train = format!("train {root} --out {} {options}", out.display());
    succeed(&train);
    let scores = fs::read_to_string(out.join("held_out.csv")).unwrap();
    let steps = |text: &str| -> Vec<String> {
        text.lines().skip(1).map(|line| line.split(',').next().unwrap().to_owned()).collect()
    };
    // It converges at step 15 and then settles.
    assert_eq!(steps(&scores), ["5", "10", "15", "20"]);
    let log = fs::read_to_string(out.join("train.csv")).unwrap();
    assert_eq!(log.lines().count(), 21);
    // The held-out view is never trained on.
    let views: BTreeSet<&str> =
        log.lines().skip(1).map(|line| line.split(',').nth(1).unwrap()).collect();
    assert_eq!(views.len(), 9);
    let json = |file: &str| -> serde_json::Value {
        serde_json::from_str(&fs::read_to_string(out.join(file)).unwrap()).unwrap()
    };
    let (metrics, done) = (json("metrics.json"), json("done.json"));
    assert_eq!((&metrics["steps"], &done["steps"]), (&20.into(), &20.into()));
    let ended = &metrics["ended"];
    assert_eq!((&ended["reason"], &ended["step"]), (&"converged".into(), &20.into()));
    assert_eq!(ended, &done["ended"]);
    let psnr = |line: &str| line.split(',').nth(1).unwrap().parse::<f64>().unwrap();
    let scored: Vec<f64> = scores.lines().skip(1).map(psnr).collect();
    let [low, high] = [f64::min, f64::max].map(|pick| scored.iter().copied().reduce(pick).unwrap());
    let spread = metrics["held_out"]["spread"].as_f64().unwrap();
    assert!((spread - (high - low)).abs() < 1e-9, "{spread}");
    assert_eq!(metrics["held_out"]["scores"], 4);
    // A run resumed from the checkpoint at step 10 ends identically.
    let model = fs::read(out.join("model.ply")).unwrap();
    fs::remove_file(out.join("metrics.json")).unwrap();
    succeed(&format!("{train} --resume"));
    assert!(model == fs::read(out.join("model.ply")).unwrap());
    assert_eq!(scores, fs::read_to_string(out.join("held_out.csv")).unwrap());
}

#[test]
fn a_run_that_ended_early_resumes_from_its_end() {
    let set = written(&Capture::default());
    let (root, out) = (set.path().display(), set.path().join("run"));
    let options = "--preset draft --set stop.views=1 --set stop.every=5 --set stop.gain=90 --set stop.detail_gain=1 \
                   --set schedule.resolution_steps=[0,0] --set schedule.cooldown_steps=6";
    let train = |more: &str| {
        succeed(&format!("train {root} --out {} {options} --progress json {more}", out.display()))
    };
    let message = train("");
    for event in [
        r#""event":"last_step","step":15,"last":21"#,
        r#""ended":{"reason":"converged","step":21,"best_step":21}"#,
    ] {
        assert!(message.contains(event), "no {event} in {message}");
    }
    assert!(message.contains(r#""may_end_early":true"#));
    // A finished run is done, whatever the maximum number of steps was.
    assert!(train("--resume").contains("is done: 21 steps"));
    // A resumed run may change the stopping rule, with a warning, but not which views are held out.
    let again = format!("train {root} --out {} {options} --resume --set", out.display());
    let (_, message) = run(&format!("{again} stop.gain=80"), 0);
    assert!(
        message.contains("stop.gain was 90 and is 80; this applies from step 21 on"),
        "{message}"
    );
    refused(&format!("{again} stop.views=0"), 3, &["was made with stop.views = 1, not 0"]);
    let message = train("--resume --steps 27");
    let steps =
        |event: &&str| event.contains(r#""event":"started""#) && event.contains(r#""step":21"#);
    assert!(message.lines().any(|line| steps(&line)), "{message}");
    assert!(
        message.contains(r#""ended":{"reason":"steps","step":27,"best_step":27}"#),
        "{message}"
    );
    let log = fs::read_to_string(out.join("train.csv")).unwrap();
    assert_eq!(log.lines().count(), 28);
}

#[test]
fn datasets_of_any_kind_have_a_plan_or_one_clear_error() {
    // Black views are left out and named; a dataset of black views alone is refused.
    let set = written(&Capture::default());
    let black = |is: fn(usize) -> bool| {
        edit(set.path(), |index, image| {
            if is(index) {
                Image::filled(image.width, image.height, [0.0; 3])
            } else {
                image.clone()
            }
        });
    };
    black(|index| index == 3 || index == 5);
    let plan = plan_of(set.path());
    assert_eq!(plan.left_out, ["003", "005"]);
    let (root, out) = (set.path().display(), set.path().join("run"));
    let (message, warned) = run(&format!("train {root} --out {} --steps 2", out.display()), 0);
    assert!(
        message.contains("8 views") && warned.contains("2 black, left out of training"),
        "{message} {warned}"
    );
    let log = fs::read_to_string(out.join("train.csv")).unwrap();
    assert!(!log.contains(",003,") && !log.contains(",005,"));
    black(|_| true);
    refused(&format!("diagnose {root}"), 3, &["almost black", "expose longer"]);

    // Half of the views well lit.
    let set = written(&Capture { stops: vec![0.0, 4.5], ..Capture::default() });
    let plan = plan_of(set.path());
    // These are their own targets, and the others get their brightness.
    assert!(plan.curve.on && !plan.exposure.on, "{}", plan.exposure.why);

    // The same photograph and camera in every view.
    let set = written(&Capture::default());
    let first = Image::load(set.path().join("low/001.png")).unwrap();
    edit(set.path(), |_, _| first.clone());
    let path = set.path().join("transforms_train.json");
    let mut list: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let pose = list["frames"][0]["transform_matrix"].clone();
    for frame in list["frames"].as_array_mut().unwrap() {
        frame["transform_matrix"] = pose.clone();
    }
    fs::write(&path, list.to_string()).unwrap();
    let remarks = diagnosis_of(set.path()).remarks.join("; ");
    assert!(remarks.contains("identical") && remarks.contains("one position"), "{remarks}");

    // One view and two.
    for count in [2, 1] {
        list["frames"].as_array_mut().unwrap().truncate(count);
        fs::write(&path, list.to_string()).unwrap();
        let found = diagnosis_of(set.path());
        assert_eq!(found.views.len(), count);
        let plan = Plan::new(&found, &TrainConfig::default(), MEMORY);
        assert_eq!(plan.sh_degree.value, 0);
        let told = found.remarks.join("; ").contains("one photograph gives no depth");
        assert_eq!(told, count == 1);
    }
}

#[test]
fn the_library_plans_and_trains_as_the_command_does() {
    let (set, out) = (written(&Capture::default()), tempfile::tempdir().unwrap());
    let folder = out.path().join("run");
    let train = format!("train {} --out {} --preset draft", set.path().display(), folder.display());
    // It stops immediately, after its configuration is written.
    run(&format!("{train} --max-minutes 1e-9"), 75);
    let config = TrainConfig::load(&folder.join("config.toml")).unwrap();
    let dataset = Dataset::load(set.path(), &config.load_options()).unwrap();
    let gpu = Gpu::new(&config.device.parse().unwrap()).unwrap();
    let trained = |mut trainer: Trainer| {
        while trainer.steps_done() < 3 {
            trainer.advance(3).unwrap();
        }
        trainer.gaussians().unwrap()
    };
    let loaded = Dataset::load(set.path(), &Preset::Draft.load_options().unwrap()).unwrap();
    let planned = Trainer::planned(&gpu, &loaded, Preset::Draft).unwrap();
    assert!(trained(planned) == trained(Trainer::new(&gpu, config, &dataset).unwrap()));
}
