//! The plan follows from the diagnosis, and training from the plan.

use nightsplat::train::Preset;
use nightsplat::train::plan::Plan;
use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::dataset::{DepthOptions, LoadOptions};

use crate::common::command::{json, unwrapped};
use crate::common::prelude::*;
use crate::common::sets::{lamp_set, varying};

const VIEWS: usize = 12;
const SIZE: [u32; 2] = [96, 72];
const MEMORY: u64 = 8 << 30;

fn taken_by(capture: &Capture) -> Folder {
    captured(&small_set(VIEWS, SIZE, 3), capture)
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

// ---------------------------------------------------------------------------
// Plan

/// The parts that a plan enables.
fn parts(plan: &Plan) -> Vec<&'static str> {
    let on = plan.decisions().into_iter().filter(|(_, value, _)| value == "on");
    on.map(|(name, ..)| name).collect()
}

#[test]
fn a_clean_well_lit_dataset_needs_no_part() {
    let plan = plan_of(&taken_by(&Capture::clean()));
    assert_eq!(parts(&plan), Vec::<&str>::new());
    assert_eq!(plan.left_out, Vec::<String>::new());
    assert!(plan.decisions().iter().all(|(_, _, why)| !why.is_empty()));
}

#[test]
fn each_part_is_enabled_with_its_cause() {
    let planned = |capture: &Capture| parts(&plan_of(&taken_by(capture)));
    assert_eq!(planned(&Capture { darkening: 25.0, ..Capture::clean() }), ["curve"]);
    let stops = vec![0.0, -1.0, 0.6];
    let set = taken_by(&Capture { stops, darkening: 8.0, ..Capture::clean() });
    // A gain for each view removes the spread; one curve for all of them does not.
    assert_eq!(parts(&plan_of(&set)), ["curve"]);
    let mut config = TrainConfig::default();
    config.tone.scene_statistics = true;
    let spread = parts(&Plan::new(&diagnosis_of(&set), &config, MEMORY));
    assert_eq!(spread, ["curve", "exposure", "structure"]);
    let grainy = Capture { full_well: 5.0, read_noise: 0.5, darkening: 3.0, ..Capture::clean() };
    let noisy = planned(&grainy);
    assert!(noisy.contains(&"denoiser") && !noisy.contains(&"exposure"), "{noisy:?}");

    let set = taken_by(&Capture { darkening: 8.0, ..Capture::clean() });
    relit(&set, |_, [x, _], light| {
        // A lamp in the middle: twelve stops darker on both sides.
        let side = (2.0 * f64::from(x) / f64::from(SIZE[0]) - 1.0).abs();
        8.0 * (-12.0 * side).exp2() * light
    });
    // The lamp moves with the camera: shared points would attribute it to exposures.
    fs::remove_dir_all(set.join("colmap_sparse")).unwrap();
    let plan = plan_of(&set);
    assert!(plan.tonemapper.on, "{} {}", plan.tonemapper.why, plan.exposure.why);

    let set = taken_by(&Capture::clean());
    fs::create_dir(set.join("depth")).unwrap();
    let map = Image::from_fn(SIZE[0], SIZE[1], |x, _| [x as f32 / 255.0; 3]);
    map.save_png8(set.join("depth/001.png")).unwrap();
    assert_eq!(parts(&plan_of(&set)), ["depth"]);
}

#[test]
fn planned_values_follow_views_steps_memory_and_preset() {
    let set = taken_by(&Capture::default());
    let found = diagnosis_of(&set);
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
    let set = taken_by(&Capture::default());
    let (plan, path) = (plan_of(&set), set.join("plan.toml"));
    fs::write(&path, plan.to_toml().unwrap()).unwrap();
    let (dataset, options) = load(&set);
    assert_eq!(Plan::load(&path, &dataset).unwrap(), plan);
    let half = Dataset::load(&set, &LoadOptions { downscale: 2.0, ..options }).unwrap();
    let refusal = Plan::load(&path, &half).unwrap_err().to_string();
    says(&refusal, &["plan.toml", "another dataset", "96x72", "48x36", "diagnose"]);
    fs::write(&path, "[curve]\non = maybe\n").unwrap();
    let refusal = Plan::load(&path, &dataset).unwrap_err().to_string();
    says(&refusal, &["is not a plan", "line 2"]);
    let absent = "train @ --out @run --plan @absent.toml";
    set.refused(absent, 3, &["absent.toml", "cannot be read"]);
    assert!(!set.join("run").exists());
}

// ---------------------------------------------------------------------------
// Commands

#[test]
fn the_command_prints_json_and_writes_a_page_and_a_plan_that_train_uses() {
    let set = taken_by(&Capture::default());
    let printed = set.succeed("diagnose @ --json --report @page.html --plan @plan.toml --steps 9");
    let json = json(&printed);
    assert!(json["scene"]["brightening"].as_f64() > Some(2.0));
    assert_eq!(json["plan"]["curve"]["on"], true);
    assert!(!json["device"].as_str().unwrap().is_empty());
    assert_eq!(json["views"].as_array().unwrap().len(), 10);
    let html = set.text("page.html");
    let plan_at = html.find("The plan").unwrap();
    assert!(plan_at < html.find("<img").unwrap(), "the plan comes first");
    assert!(html.contains("Bad: below 0.02"), "a column states its unit and its bad values");
    assert!(!html.contains("http://") && !html.contains("https://"));
    let whole = unwrapped(&set.succeed("diagnose @ -v"));
    says(&whole, &["10 photographs to train on (96x72), 2 held out", "denoiser off", "views"]);
    // Without -v: the verdict, what is on, and no measurement.
    let text = set.succeed("diagnose @");
    says(text.lines().next().unwrap(), &[" set: 10 "]);
    says(&text, &["\ncurve "]);
    assert!(!text.contains(" off ") && !text.contains("p90"), "{text}");
    for line in text.lines().filter(|line| !line.starts_with("next:")) {
        assert!(line.chars().count() <= 80, "{line}");
    }

    // The user's change is kept, and an option overrides it.
    let written = set.text("plan.toml");
    let gaussians = written.split("[max_gaussians]\nvalue = ").nth(1).unwrap();
    let gaussians = gaussians.split_whitespace().next().unwrap();
    set.write("plan.toml", written.replace(&format!("value = {gaussians}"), "value = 3210"));
    let train = |more: &str| {
        let options = "--steps 9 --parts structure --set schedule.densify_after=99";
        set.succeed(&format!("train @ --out @run {more} {options}"))
    };
    says(&train("--plan @plan.toml"), &["3210", "views of 96x72"]);
    let config = set.text("run/config.toml");
    says(&config, &["max_gaussians = 3210", "structure = true", "denoiser = false"]);
    let kept = set.text("run/plan.toml");
    says(&kept, &["3210"]);

    // A resumed run keeps its plan.
    let model = set.model("run");
    fs::remove_file(set.join("run/metrics.json")).unwrap();
    train("--resume");
    assert_eq!(model, set.model("run"));
    assert_eq!(kept, set.text("run/plan.toml"));
}

#[test]
fn a_preset_of_the_paper_and_a_configuration_are_not_planned() {
    let set = taken_by(&Capture::default());
    for options in ["--preset paper", "--preset lom", "--plan none"] {
        set.succeed(&format!("train @ --out @run --overwrite --steps 1 {options}"));
        says(&set.text("run/config.toml"), &["max_gaussians = 1000000", "sh_degree = 3"]);
        assert!(!set.join("run/plan.toml").exists(), "{options}");
    }
    set.succeed("train @ --out @run --overwrite --steps 1");
    assert!(set.join("run/plan.toml").exists());
}

#[test]
fn a_run_without_a_length_ends_when_held_out_views_have_converged() {
    let set = taken_by(&Capture::default());
    // Any gain is too small.
    let options = "--preset draft --set stop.views=1 --set stop.every=5 --set stop.gain=90 --set stop.detail_gain=1 \
                   --set schedule.resolution_steps=[0,0] --set schedule.cooldown_steps=5 --set checkpoint_every=10";
    let train = format!("train @ --out @run {options}");
    set.succeed(&train);
    let scores = set.text("run/held_out.csv");
    let steps = |text: &str| -> Vec<String> {
        text.lines().skip(1).map(|line| line.split(',').next().unwrap().to_owned()).collect()
    };
    // It converges at step 15 and then settles.
    assert_eq!(steps(&scores), ["5", "10", "15", "20"]);
    let log = set.text("run/train.csv");
    assert_eq!(log.lines().count(), 21);
    // The held-out view is never trained on.
    let views: BTreeSet<&str> =
        log.lines().skip(1).map(|line| line.split(',').nth(1).unwrap()).collect();
    assert_eq!(views.len(), 9);
    let [metrics, done] = ["metrics", "done"].map(|name| set.json(&format!("run/{name}.json")));
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
    let model = set.model("run");
    fs::remove_file(set.join("run/metrics.json")).unwrap();
    set.succeed(&format!("{train} --resume"));
    assert!(model == set.model("run"));
    assert_eq!(scores, set.text("run/held_out.csv"));
}

#[test]
fn a_run_that_ended_early_resumes_from_its_end() {
    let set = taken_by(&Capture::default());
    let options = "--preset draft --set stop.views=1 --set stop.every=5 --set stop.gain=90 --set stop.detail_gain=1 \
                   --set schedule.resolution_steps=[0,0] --set schedule.cooldown_steps=6";
    let train =
        |more: &str| set.succeed(&format!("train @ --out @run {options} --progress json {more}"));
    let events = [
        r#""event":"last_step","step":15,"last":21"#,
        r#""ended":{"reason":"converged","step":21,"best_step":21}"#,
        r#""may_end_early":true"#,
    ];
    says(&train(""), &events);
    // A finished run is done, whatever the maximum number of steps was.
    assert!(train("--resume").contains("is done: 21 steps"));
    // A resumed run may change the stopping rule, with a warning, but not which views are held out.
    let again = format!("train @ --out @run {options} --resume --set");
    let (_, message) = set.run(&format!("{again} stop.gain=80"), 0);
    says(&message, &["stop.gain was 90 and is 80; this applies from step 21 on"]);
    set.refused(&format!("{again} stop.views=0"), 3, &["was made with stop.views = 1, not 0"]);
    let message = train("--resume --steps 27");
    let steps =
        |event: &&str| event.contains(r#""event":"started""#) && event.contains(r#""step":21"#);
    assert!(message.lines().any(|line| steps(&line)), "{message}");
    says(&message, &[r#""ended":{"reason":"steps","step":27,"best_step":27}"#]);
    assert_eq!(set.text("run/train.csv").lines().count(), 28);
}

#[test]
fn datasets_of_any_kind_have_a_plan_or_one_clear_error() {
    // Black views are left out and named; a dataset of black views alone is refused.
    let set = taken_by(&Capture::default());
    let black = |is: fn(usize) -> bool| {
        repaint(&set, |index, image| {
            if is(index) {
                Image::filled(image.width, image.height, [0.0; 3])
            } else {
                image.clone()
            }
        });
    };
    black(|index| index == 3 || index == 5);
    let plan = plan_of(&set);
    assert_eq!(plan.left_out, ["003", "005"]);
    let (message, warned) = set.run("train @ --out @run --steps 2", 0);
    says(&message, &["8 views"]);
    says(&warned, &["2 black, left out of training"]);
    let log = set.text("run/train.csv");
    assert!(!log.contains(",003,") && !log.contains(",005,"));
    black(|_| true);
    set.refused("diagnose @", 3, &["almost black", "expose longer"]);

    // Half of the views well lit.
    let set = taken_by(&Capture { stops: vec![0.0, 4.5], ..Capture::default() });
    let plan = plan_of(&set);
    // These are their own targets, and the others get their brightness.
    assert!(plan.curve.on && !plan.exposure.on, "{}", plan.exposure.why);

    // The same photograph and camera in every view.
    let set = taken_by(&Capture::default());
    let first = Image::load(set.join("low/001.png")).unwrap();
    repaint(&set, |_, _| first.clone());
    let path = set.join("transforms_train.json");
    let mut list = json(fs::read(&path).unwrap());
    let pose = list["frames"][0]["transform_matrix"].clone();
    for frame in list["frames"].as_array_mut().unwrap() {
        frame["transform_matrix"] = pose.clone();
    }
    fs::write(&path, list.to_string()).unwrap();
    let remarks = diagnosis_of(&set).remarks.join("; ");
    says(&remarks, &["identical", "one position"]);

    // One view and two.
    for count in [2, 1] {
        list["frames"].as_array_mut().unwrap().truncate(count);
        fs::write(&path, list.to_string()).unwrap();
        let found = diagnosis_of(&set);
        assert_eq!(found.views.len(), count);
        let plan = Plan::new(&found, &TrainConfig::default(), MEMORY);
        assert_eq!(plan.sh_degree.value, 0);
        let told = found.remarks.join("; ").contains("one photograph gives no depth");
        assert_eq!(told, count == 1);
    }
}

#[test]
fn the_library_plans_and_trains_as_the_command_does() {
    let set = taken_by(&Capture::default());
    // It stops immediately, after its configuration is written.
    set.run("train @ --out @run --preset draft --max-minutes 1e-9", 75);
    let config = TrainConfig::load(&set.join("run/config.toml")).unwrap();
    let dataset = Dataset::load(&set, &config.load_options()).unwrap();
    let gpu = Gpu::new(&config.device.parse().unwrap()).unwrap();
    let trained = |mut trainer: Trainer| {
        advance(&mut trainer, 3);
        trainer.gaussians().unwrap()
    };
    let loaded = Dataset::load(&set, &Preset::Draft.load_options().unwrap()).unwrap();
    let planned = Trainer::planned(&gpu, &loaded, Preset::Draft).unwrap();
    assert!(trained(planned) == trained(Trainer::new(&gpu, config, &dataset).unwrap()));
}

// ---------------------------------------------------------------------------
// A lamp

#[test]
fn the_plan_has_a_lamp_and_exposures_each_where_its_cause_is() {
    let plan = |lamp, capture: &Capture| {
        let folder = captured(&lamp_set(lamp), capture);
        let found = diagnosis_of(&folder);
        let mut config = TrainConfig::default();
        config.tone.scene_statistics = true;
        let plan = Plan::new(&found, &config, MEMORY);
        config.freeze = Some("means,quats,scales,opacities,dc".parse().unwrap());
        let frozen = Plan::new(&found, &config, MEMORY).lamp;
        assert!(
            !frozen.on && frozen.why.contains("colours are frozen") == plan.lamp.on,
            "{frozen:?}"
        );
        (found.scene.lamp.unwrap(), plan)
    };
    for (lamp, capture, expected) in [
        (None, Capture::default(), [false, false]),
        (None, varying(), [false, true]),
        (Some(16.0), Capture::default(), [true, false]),
        (Some(16.0), varying(), [true, true]),
    ] {
        let (found, plan) = plan(lamp, &capture);
        assert_eq!(
            [plan.lamp.on, plan.exposure.on],
            expected,
            "{:?} {:?}",
            plan.lamp,
            plan.exposure
        );
        assert!(plan.lamp.why.contains("threshold"), "{:?}", plan.lamp);
        let begins = match lamp {
            Some(_) => (found.exponent, found.falloff, found.ambient),
            None => (2.0, [0.0; 2], 0.05),
        };
        assert_eq!((plan.lamp.exponent, plan.lamp.falloff, plan.lamp.ambient), begins);
    }
}

#[test]
fn a_run_learns_the_lamp_that_was_found_and_none_where_there_is_none() {
    for (lamp, learned) in [(Some(16.0), "lamp = true"), (None, "lamp = false")] {
        let folder = written(&lamp_set(lamp));
        folder.succeed("train @ --out @run --steps 2");
        let config = folder.text("run/config.toml");
        says(&config, &[learned]);
        assert_eq!(config.contains("scene_statistics = true"), lamp.is_some(), "{config}");
        let plan: toml::Value = toml::from_str(&folder.text("run/plan.toml")).unwrap();
        let exponent = plan["lamp"]["exponent"].as_float().unwrap();
        assert!((exponent - 2.0).abs() < 0.5 && config.contains(&format!("exponent = {exponent}")));
    }
}

#[test]
fn the_command_reports_the_lamp_as_text_json_and_page() {
    let folder = written(&lamp_set(Some(16.0)));
    let text = folder.succeed("diagnose @ -v --report @page.html");
    assert!(text.lines().any(|line| line.starts_with("lamp ") && line.contains(" on ")), "{text}");
    says(text.lines().next().unwrap(), &["lit by a lamp"]);
    let whole = unwrapped(&text);
    says(&whole, &["moves with the camera", "exponent", "beyond exposures", "by distance"]);
    says(&folder.text("page.html"), &["moves with the camera"]);
    let json = json(folder.succeed("diagnose @ --json"));
    let lamp = &json["scene"]["lamp"];
    for key in ["exponent", "ambient", "d_ref", "r_squared", "stops", "exposure_r_squared"] {
        assert!(lamp[key].is_f64(), "{key} of {lamp}");
    }
    assert_eq!(lamp["falloff"].as_array().unwrap().len(), 2);
}
