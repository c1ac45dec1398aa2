//! Interrupted runs that are resumed.

use nightsplat::results::run::{self, Event, IfExists};
use nightsplat::train::{Background, EndReason, Part, StepReport};
use nightsplat_models::gaussians::Attribute;
use nightsplat_photographs::dataset::View;
use safetensors::SafeTensors;

use crate::common::command::{command, refused, succeed};
use crate::common::prelude::*;
use crate::common::workspace::log;

/// A dataset of nine small views.
fn nine() -> Folder {
    written(&small_set(9, [40, 30], 2))
}

/// Density control runs after steps 10 and 20 of thirty.
fn config(parts: &[Part]) -> TrainConfig {
    let mut config =
        TrainConfig { steps: 30, background: Background::Random, ..TrainConfig::bare() };
    config.schedule.densify_after = 5;
    config.schedule.densify_interval = 10;
    config.schedule.sh_degree_interval = 8;
    set_small_parts(&mut config, parts);
    config.model.denoiser_crop = 16;
    config.lamp.rates.after = 2;
    config
}

/// The complete state at the end, and the report of every step.
fn finished(trainer: &mut Trainer, folder: &Path) -> (Vec<u8>, Vec<StepReport>) {
    let reports = advance(trainer, 30);
    let path = folder.join("end.safetensors");
    trainer.save_checkpoint(&path).unwrap();
    (fs::read(path).unwrap(), reports)
}

/// A new trainer with the state of another that was interrupted at a step.
fn restored(new: impl Fn() -> Trainer, step: u64, folder: &Path) -> Trainer {
    let checkpoint = folder.join("checkpoint.safetensors");
    let mut interrupted = new();
    advance(&mut interrupted, step);
    interrupted.save_checkpoint(&checkpoint).unwrap();
    let mut restored = new();
    restored.restore(&checkpoint).unwrap();
    restored
}

#[test]
fn a_restored_run_continues_bit_for_bit() {
    let folder = nine();
    let gpu = gpu();
    for parts in [&[][..], &[Part::Denoiser, Part::Tonemapper, Part::Structure, Part::Lamp]] {
        let config = config(parts);
        let dataset = Dataset::load(&folder, &config.load_options()).unwrap();
        let new = || Trainer::new(&gpu, config.clone(), &dataset).unwrap();
        let (expected, all) = finished(&mut new(), &folder);
        // Between passes of density control, right after one, and before the first.
        for step in [17, 20, 3] {
            let mut restored = restored(new, step, &folder);
            // The trainer's previous state is discarded.
            advance(&mut restored, step + 5);
            restored.restore(&folder.join("checkpoint.safetensors")).unwrap();
            assert_eq!(restored.steps_done(), step);
            let (end, reports) = finished(&mut restored, &folder);
            assert!(end == expected, "{parts:?} from step {step}: another end");
            let same = reports.iter().zip(&all[step as usize..]);
            assert!(same.clone().all(|(a, b)| a.terms == b.terms && a.view == b.view));
            assert_eq!(same.len() as u64, 30 - step);
        }
    }
}

/// No gain is enough: both end at the first check.
#[test]
fn growth_and_the_sh_degree_stop_if_held_out_views_gain_too_little_and_stay_so_after_a_resume() {
    // Enough views to hold one out.
    let folder = written(&small_set(12, [40, 30], 2));
    let gpu = gpu();
    let mut free = config(&[]);
    free.schedule.densify_interval = 3;
    free.schedule.resolution_steps = Some([0, 0]);
    free.stop.views = 1;
    let mut ending = free.clone();
    (ending.stop.growth_gain, ending.stop.degree_gain) = (1e3, 1e3);
    let dataset = Dataset::load(&folder, &free.load_options()).unwrap();
    let new = |config: &TrainConfig| Trainer::new(&gpu, config.clone(), &dataset).unwrap();
    let [mut freely, mut ended] = [new(&free), new(&ending)];
    finished(&mut freely, &folder);
    // Rounds after steps 6, 9, 12, 15 and 18; SH degree 1 is in use from step 8 to 15.
    advance(&mut ended, 18);
    let count = ended.gaussian_count();
    let (expected, _) = finished(&mut ended, &folder);
    assert!(ended.held_out_psnr().unwrap().is_some());
    let colors = |trainer: &Trainer| trainer.gaussians().unwrap().rest().to_vec();
    assert!(ended.gaussian_count() <= count && freely.gaussian_count() > count);
    assert!(colors(&ended).iter().all(|rest| *rest == Vec3::ZERO));
    assert!(colors(&freely).iter().any(|rest| *rest != Vec3::ZERO));
    for step in [13, 16, 20] {
        let mut restored = restored(|| new(&ending), step, &folder);
        assert!(finished(&mut restored, &folder).0 == expected, "from step {step}");
    }
}

/// A dataset with one held-out view, and a run on it that converges as early as possible: no gain is enough.
fn early() -> (Folder, Dataset, TrainConfig) {
    let folder = written(&small_set(12, [40, 30], 2));
    let mut config = config(&[]);
    config.steps = 60;
    config.schedule.resolution_steps = Some([0, 0]);
    (config.stop.views, config.stop.every, config.stop.gain) = (1, 7, 90.0);
    config.stop.detail_gain = 1.0;
    config.schedule.cooldown_steps = 9;
    let dataset = Dataset::load(&folder, &config.load_options()).unwrap();
    (folder, dataset, config)
}

fn ended(trainer: &mut Trainer, folder: &Path) -> Vec<u8> {
    while !trainer.has_ended() {
        trainer.advance(u64::MAX).unwrap();
    }
    let path = folder.join("end.safetensors");
    trainer.save_checkpoint(&path).unwrap();
    fs::read(path).unwrap()
}

#[test]
fn a_run_that_converges_settles_and_ends_and_so_does_one_that_is_killed_and_resumed() {
    let (folder, dataset, config) = early();
    let new = || Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
    let mut whole = new();
    assert!(whole.may_end_early());
    let expected = ended(&mut whole, &folder);
    // Rounds follow steps 10 and 20. A score that drops within ten steps of a round waits until they are over.
    let steps: Vec<u64> = whole.held_out_scores().map(|(step, _)| step).collect();
    assert_eq!(steps, [7, 20, 30, 39]);
    assert_eq!(
        (whole.cooldown_begin(), whole.steps_done(), whole.may_end_early()),
        (30, 39, false)
    );
    let rate = |step| whole.learning_rates(step)[Attribute::Quats];
    assert!(rate(30) > 0.99 * rate(29) && rate(39) < 0.06 * rate(30));
    let refused = whole.advance(60).unwrap_err().to_string();
    assert!(refused.contains("has ended at step 39, before step 60"), "{refused}");
    let end = whole.end().unwrap();
    assert_eq!((end.reason, end.step), (EndReason::Converged, 39));
    // During growth, after a score, at convergence, and while it settles.
    for step in [5, 20, 25, 30, 34] {
        let mut restored = restored(new, step, &folder);
        assert!(ended(&mut restored, &folder) == expected, "from step {step}");
        assert_eq!(restored.end().unwrap(), end);
    }
}

/// After a round of density control that it may not repeat, between rounds, before the first step, and where the
/// cooldown has begun as planned.
#[test]
fn a_run_whose_end_is_requested_cools_down_from_there_and_so_does_one_that_is_killed_and_resumed() {
    let (folder, dataset, mut config) = early();
    // It does not converge before.
    config.stop.every = 1000;
    let checkpoint = folder.join("checkpoint.safetensors");
    for (from, last, reason) in [
        (10, 19, EndReason::Requested),
        (17, 26, EndReason::Requested),
        (0, 9, EndReason::Requested),
        (55, 60, EndReason::Steps),
    ] {
        let new = || Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        let mut whole = new();
        advance(&mut whole, from);
        whole.save_checkpoint(&checkpoint).unwrap();
        whole.finish();
        assert_eq!((whole.last_step(), whole.may_end_early()), (last, false), "from {from}");
        let rate = |step| whole.learning_rates(step)[Attribute::Quats];
        assert!(rate(last) < 0.1 * rate(from.min(51)));
        // Stopped there, and finished after it was resumed.
        let mut resumed = new();
        resumed.restore(&checkpoint).unwrap();
        resumed.finish();
        let expected = ended(&mut whole, &folder);
        assert!(ended(&mut resumed, &folder) == expected, "from {from}");
        let end = whole.end().unwrap();
        assert_eq!((end.reason, end.step), (reason, last));
        // Killed while it cools down: the checkpoint records the request.
        let mut killed = new();
        advance(&mut killed, from);
        killed.finish();
        advance(&mut killed, from + 3);
        killed.save_checkpoint(&checkpoint).unwrap();
        let mut restored = new();
        restored.restore(&checkpoint).unwrap();
        assert!(ended(&mut restored, &folder) == expected, "from {from}, killed");
        assert_eq!(restored.end().unwrap(), end);
        // With more steps, the request is over.
        let mut longer =
            Trainer::new(&gpu(), TrainConfig { steps: 70, ..config.clone() }, &dataset).unwrap();
        longer.restore(&checkpoint).unwrap();
        assert_eq!(longer.last_step(), 70);
    }
}

#[test]
fn a_run_that_is_resumed_with_other_steps_runs_all_of_them() {
    let (folder, dataset, config) = early();
    let checkpoint = folder.join("end.safetensors");
    ended(&mut Trainer::new(&gpu(), config.clone(), &dataset).unwrap(), &folder);
    let longer = TrainConfig { steps: 48, ..config };
    let mut restored = Trainer::new(&gpu(), longer, &dataset).unwrap();
    restored.restore(&checkpoint).unwrap();
    assert_eq!((restored.last_step(), restored.may_end_early()), (48, false));
    ended(&mut restored, &folder);
    let end = restored.end().unwrap();
    assert_eq!((end.reason, end.step), (EndReason::Steps, 48));
}

#[test]
fn held_out_views_that_show_nothing_are_not_scored() {
    let (_folder, mut dataset, config) = early();
    let held_out = |view: &&mut View| view.split == Split::HeldOut;
    let view = dataset.views.iter_mut().find(held_out).unwrap();
    (view.image, view.original) = (Some(Image::filled(40, 30, [0.0; 3])), None);
    let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
    assert!(!trainer.may_end_early());
    assert_eq!((trainer.last_step(), trainer.held_out_psnr().unwrap()), (60, None));
}

#[test]
fn a_checkpoint_that_does_not_fit_is_refused_and_changes_nothing() {
    let folder = nine();
    let (gpu, path) = (gpu(), folder.join("checkpoint.safetensors"));
    let config = config(&[]);
    let dataset = Dataset::load(&folder, &config.load_options()).unwrap();
    let mut trainer = Trainer::new(&gpu, config.clone(), &dataset).unwrap();
    advance(&mut trainer, 6);
    trainer.save_checkpoint(&path).unwrap();
    let whole = fs::read(&path).unwrap();
    let (before, count) = (trainer.gaussians().unwrap(), trainer.gaussian_count());

    let refuses = |trainer: &mut Trainer, bytes: &[u8], parts: &[&str]| {
        fs::write(&path, bytes).unwrap();
        let message = trainer.restore(&path).unwrap_err().to_string();
        says(&message, &[parts, &["checkpoint.safetensors"]].concat());
    };
    let edited = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = whole.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        [&whole[..at], to.as_bytes(), &whole[at + from.len()..]].concat()
    };
    refuses(&mut trainer, &whole[..whole.len() - 5], &["not an intact checkpoint"]);
    refuses(&mut trainer, b"", &["not an intact checkpoint"]);
    refuses(&mut trainer, &edited("checkpoint 1", "checkpoint 9"), &["is not a `nightsplat"]);
    refuses(&mut trainer, &edited("visit_counts", "visit_c0unts"), &["density.visit_counts"]);
    refuses(&mut trainer, &edited("first_moments", "first_m0ments"), &["gaussians.first_moments"]);
    refuses(
        &mut trainer,
        &edited("seed = 10", "seed = 11"),
        &["seed (--seed) = 11, not 10", "--overwrite"],
    );
    refuses(&mut trainer, &edited("steps = 30", "stepz = 30"), &["another version"]);
    let file = SafeTensors::deserialize(&whole).unwrap();
    let sums = file.tensor("density.grad_norm_sums").unwrap().data();
    let at = sums.as_ptr() as usize - whole.as_ptr() as usize;
    let mut spoiled = whole.clone();
    spoiled[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    refuses(&mut trainer, &spoiled, &["not finite"]);
    assert_eq!((trainer.gaussians().unwrap(), trainer.gaussian_count()), (before, count));

    let shorter = TrainConfig { steps: 5, ..config };
    let mut shorter = Trainer::new(&gpu, shorter, &dataset).unwrap();
    refuses(&mut shorter, &whole, &["at step 6", "ends at 5", "raise steps"]);
}

#[test]
fn a_run_reports_every_event_to_its_observer_in_order() {
    let folder = nine();
    let config = TrainConfig { eval_every: 12, checkpoint_every: 20, ..config(&[]) };
    let dataset = Dataset::load(&folder, &config.load_options()).unwrap();
    let train = |config: &TrainConfig, if_exists| {
        let mut told = vec![];
        let out = folder.join("run");
        let trained = run::train(&gpu(), config, &dataset, &out, if_exists, |event| {
            told.push(match event {
                Event::Started { step, steps, .. } => format!("started {step} of {steps}"),
                Event::Step(report) => format!("step {}", report.step),
                Event::Checkpointed { step } => format!("checkpointed {step}"),
                Event::Evaluated { step, evaluation } => {
                    format!("evaluated {step}: {}", evaluation.views().len())
                }
                Event::Ended(ended) => format!("ended {}", ended.step),
                Event::Finished(trained) => {
                    format!("finished {}", trained.evaluation.views().len())
                }
                _ => String::new(),
            });
        });
        (trained.map(|trained| trained.losses.len()), told)
    };
    let mut expected = vec!["started 0 of 30".to_owned()];
    for step in 1..=30 {
        expected.push(format!("step {step}"));
        expected.extend((step == 20).then(|| "checkpointed 20".to_owned()));
        expected.extend((step % 12 == 0).then(|| format!("evaluated {step}: 2")));
    }
    let end = ["checkpointed 30", "ended 30", "evaluated 30: 2", "finished 2"];
    expected.extend(end.map(str::to_owned));
    let (steps, told) = train(&config, IfExists::Refuse);
    assert_eq!((steps.unwrap(), told), (30, expected));

    let (refused, told) = train(&config, IfExists::Refuse);
    assert!(refused.unwrap_err().to_string().contains("already contains a run") && told.is_empty());
    let (steps, told) = train(&TrainConfig { steps: 33, ..config }, IfExists::Resume);
    assert_eq!((steps.unwrap(), told[0].as_str()), (3, "started 30 of 33"));
}

#[test]
fn a_killed_run_is_resumed_to_the_same_model() {
    let workspace = Workspace::new();
    let train = |run: &str, options: &str| {
        let set = format!("train @set --out @{run} --sh-degree 1 --checkpoint-every 10");
        workspace.named(&format!("{set} {options}"))
    };
    succeed(&train("straight", "--steps 200"));

    // Without a checkpoint it starts over; killed at some step after one, it resumes.
    let mut child = command(&train("killed", "--steps 200 --resume"));
    let mut child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let killed = workspace.path("killed");
    let checkpoint = killed.join("checkpoint.safetensors");
    while !checkpoint.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!killed.join("metrics.json").exists(), "the run ended before it was killed");
    succeed(&train("killed", "--steps 200 --resume"));
    assert!(workspace.model("killed") == workspace.model("straight"));
    assert_eq!(log(&killed), log(&workspace.path("straight")));

    // A finished run is extended; the files of its previous end are replaced.
    succeed(&train("killed", "--steps 203 --resume"));
    assert_eq!(log(&killed).len(), 204);
    assert!(workspace.model("killed") != workspace.model("straight"));

    let refused = |options: &str, code: i32, parts: &[&str]| {
        refused(&train("killed", &format!("{options} --resume")), code, parts);
    };
    refused("--steps 203 --overwrite", 2, &["--overwrite"]);
    refused("--steps 300 --seed 4", 3, &["seed (--seed) = 10, not 4"]);
    refused("--steps 199", 3, &["at step 203", "raise steps"]);
    workspace.write("killed/train.csv", "step,view\n1,000,1\n");
    refused("--steps 300", 3, &["train.csv", "step 203"]);
    fs::remove_file(&checkpoint).unwrap();
    fs::remove_file(killed.join("checkpoint.before.safetensors")).unwrap();
    refused("--steps 300", 1, &["already contains a run", "--overwrite"]);
}
