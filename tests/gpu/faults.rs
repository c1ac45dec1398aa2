//! Memory that runs out and devices that are lost, at every possible place: saved work is not lost, and no run claims
//! to be finished unless it is.

use nightsplat::Error;
use nightsplat::gpu::DeviceChoice;
use nightsplat::gpu::testing::faults;
use nightsplat::networks::Denoiser;
use nightsplat::results::run::{self, Event, IfExists, RunSummary};
use nightsplat::splats::densify::DensityControl;
use nightsplat::train::{MemoryEstimate, ModelConfig, Part};

use crate::common::prelude::*;
use crate::common::train::dataset;

fn gpu() -> Gpu {
    let choice = std::env::var("NIGHTSPLAT_DEVICE").unwrap_or_default();
    Gpu::with_validation(&choice.parse::<DeviceChoice>().unwrap()).unwrap()
}

/// All sources of allocations in a few steps: growth, higher SH degrees, networks, checkpoints.
fn config() -> TrainConfig {
    let mut config = TrainConfig {
        steps: 14,
        sh_degree: 1,
        random_points: 300,
        checkpoint_every: 6,
        checkpoint_minutes: 0.0,
        eval_every: 7,
        ..TrainConfig::bare()
    };
    config.model = ModelConfig::default();
    config.model.set_parts(&[Part::Structure]);
    config.schedule.densify_after = 2;
    config.schedule.densify_interval = 4;
    config.schedule.sh_degree_interval = 5;
    config.schedule.resolution_steps = Some([0, 0]);
    config.density.gradient_threshold = Some(1e-7);
    config
}

/// Trains into `out`; returns the error, if any, and the last reported step.
fn train(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    out: &Path,
    held: IfExists,
) -> (Option<Error>, u64) {
    let mut last = 0;
    let trained = run::train(gpu, config, dataset, out, held, |event| {
        if let Event::Step(report) = event {
            last = report.step;
        }
    });
    (trained.err(), last)
}

#[test]
fn a_lack_of_memory_anywhere_leaves_a_checkpoint_and_no_finished_run() {
    let (gpu, dataset, config) = (gpu(), dataset(5, [24, 20]), config());
    let folder = tempfile::tempdir().unwrap();
    let straight = folder.path().join("straight");
    faults(&gpu).fail_allocation(0);
    assert!(train(&gpu, &config, &dataset, &straight, IfExists::Refuse).0.is_none());
    let names = faults(&gpu).allocations();
    let expected = fs::read(straight.join("model.ply")).unwrap();
    // The first and the last of every name.
    let mut sites = BTreeMap::<&str, [usize; 2]>::new();
    for (index, name) in names.iter().enumerate() {
        sites.entry(name).or_insert([index; 2])[1] = index;
    }
    let mut numbers: Vec<usize> = sites.into_values().flatten().collect();
    numbers.sort_unstable();
    numbers.dedup();
    // All of them take minutes: test some of those before the first step, and the last.
    if std::env::var_os("NIGHTSPLAT_ALL_SITES").is_none() {
        let (early, late) = numbers.split_at(numbers.len().saturating_sub(8));
        let some = early.iter().step_by((early.len() / 4).max(1));
        numbers = some.chain(late).copied().collect();
    }
    let mut resumed = 0;
    for index in numbers {
        let (name, out) = (&names[index], folder.path().join(format!("run{index}")));
        faults(&gpu).fail_allocation(index as u64 + 1);
        let (error, last) = train(&gpu, &config, &dataset, &out, IfExists::Refuse);
        let asked = faults(&gpu).allocations().len();
        faults(&gpu).fail_allocation(0);
        let Some(error) = error else {
            // The steps may be in fewer submissions than before.
            assert!(asked <= index, "{name} ({index}): the run says it is done");
            continue;
        };
        assert_eq!(error.exit_code(), 4, "{name} ({index}): {error}");
        for sign in ["done.json", "metrics.json"] {
            assert!(!out.join(sign).exists(), "{name} ({index}): {sign}");
        }
        let is_saved = out.join("checkpoint.safetensors").exists();
        assert!(is_saved || last == 0, "{name} ({index}): {last} steps are lost");
        if is_saved {
            let (again, _) = train(&gpu, &config, &dataset, &out, IfExists::Resume);
            assert!(again.is_none(), "{name} ({index}), {error}: {again:?}");
            let model = fs::read(out.join("model.ply")).unwrap();
            assert!(model == expected, "{name} ({index}), {error}: another model");
            resumed += 1;
        }
    }
    assert!(resumed >= 3, "{resumed} runs went on from what was saved");
}

#[test]
fn a_device_lost_anywhere_leaves_the_last_checkpoint_to_resume_from() {
    let (dataset, config) = (dataset(5, [24, 20]), config());
    let folder = tempfile::tempdir().unwrap();
    let straight = folder.path().join("straight");
    assert!(train(&gpu(), &config, &dataset, &straight, IfExists::Refuse).0.is_none());
    let expected = fs::read(straight.join("model.ply")).unwrap();
    let mut resumed = 0;
    for number in [1, 40, 80, 95, 105, 115, 125] {
        let out = folder.path().join(format!("run{number}"));
        let lost = gpu();
        faults(&lost).lose_at_submission(number);
        let (error, _) = train(&lost, &config, &dataset, &out, IfExists::Refuse);
        drop(lost);
        let Some(error) = error else { continue };
        assert!(matches!(error, Error::DeviceLost { .. }), "{number}: {error}");
        assert_eq!(error.exit_code(), 4);
        assert!(!out.join("done.json").exists() && !out.join("metrics.json").exists());
        if out.join("config.toml").exists() {
            let (error, _) = train(&gpu(), &config, &dataset, &out, IfExists::Resume);
            assert!(error.is_none(), "{number}: {error:?}");
            assert!(fs::read(out.join("model.ply")).unwrap() == expected, "{number}");
            resumed += 1;
        }
    }
    assert!(resumed > 1);
}

/// A growing run on nine views, and its memory estimate.
fn foreseen(gpu: &Gpu, config: &TrainConfig) -> (MemoryEstimate, RunSummary) {
    let (dataset, folder) = (dataset(9, [100, 75]), tempfile::tempdir().unwrap());
    let mut foreseen = None;
    let observe = |event: Event<'_>| {
        if let Event::Started { memory, .. } = event {
            foreseen = Some(*memory);
        }
    };
    let out = folder.path().join("run");
    let trained = run::train(gpu, config, &dataset, &out, IfExists::Refuse, observe).unwrap();
    (foreseen.unwrap(), trained)
}

/// Grows to its limit in the second round, and reaches its SH degree.
fn growing() -> TrainConfig {
    let mut config = TrainConfig {
        steps: 60,
        sh_degree: 2,
        max_gaussians: 9000,
        checkpoint_every: 40,
        ..TrainConfig::bare()
    };
    config.schedule.densify_after = 2;
    config.schedule.densify_interval = 10;
    config.schedule.sh_degree_interval = 20;
    config.schedule.resolution_steps = Some([0, 0]);
    config.density.control = DensityControl::Paper;
    config.density.gradient_threshold = Some(1e-9);
    config.density.min_opacity = 1e-4;
    config
}

#[test]
fn memory_is_estimated_to_a_fifth() {
    // Without validation, which needs memory.
    let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
    // With every SH degree, with none above 0, and with the activations of a denoiser's stages.
    for (sh_degree_interval, stages) in [(20, 0), (1000, 0), (1000, 3)] {
        let mut config = growing();
        config.schedule.sh_degree_interval = sh_degree_interval;
        config.model.denoiser = stages > 0;
        config.model.network.stages = stages.max(1);
        let (estimate, trained) = foreseen(&gpu, &config);
        assert_eq!(trained.trainer.gaussian_count(), 9000);
        assert_eq!(estimate.peak_gaussians, 9000);
        let spent = &trained.spent;
        let share = estimate.peak_device as f64 / spent.device_bytes as f64;
        assert!((0.8..=1.2).contains(&share), "{estimate:?}, and {spent:?} came");
        if let Some(host) = spent.host_bytes {
            // Other tests of this process have raised the peak; the estimate is at least the present memory.
            assert!(
                estimate.peak_host as f64 <= 1.2 * host as f64,
                "{estimate:?}, and {spent:?} came"
            );
        }
    }
}

/// Two fifths of a step's memory are activations here.
#[test]
fn activations_are_kept_within_a_fraction_of_max_vram_and_change_no_bit_of_the_model() {
    let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
    let mut config = growing();
    (config.steps, config.max_gaussians) = (12, 100);
    config.model.denoiser = true;
    config.model.network.stages = 3;
    let kept = Denoiser::kept_bytes(config.model.network, UVec2::new(100, 75));
    let vram = 4 * kept - 4;
    let mut run = |max_vram: Option<u64>| {
        config.max_vram = max_vram.map(|bytes| bytes.to_string().parse().unwrap());
        let (foreseen, RunSummary { trainer, spent, .. }) = foreseen(&gpu, &config);
        gpu.limit_memory(u64::MAX);
        let model = trainer.gaussians().unwrap();
        (foreseen.device, spent.device_bytes, model)
    };
    let (free, held) = (run(None), run(Some(vram)));
    assert!(free.0 >= held.0 + kept, "{} and {} foreseen, {kept} kept", free.0, held.0);
    assert!(held.1 <= vram, "{} of {vram}", held.1);
    assert!(free.2 == held.2, "what is kept changed the model");
}

#[test]
fn growth_stops_at_the_memory_limit_and_always_at_the_same_number() {
    let gpu = gpu();
    let mut config = growing();
    let vram = 7 << 20;
    config.max_vram = vram.to_string().parse().ok();
    let counts = [0; 2].map(|_| {
        let (foreseen, trained) = foreseen(&gpu, &config);
        let RunSummary { trainer, spent, .. } = trained;
        assert!(spent.device_bytes <= vram, "{} of {vram}", spent.device_bytes);
        assert!(trainer.gaussian_count() <= foreseen.peak_gaussians);
        trainer.gaussian_count()
    });
    gpu.limit_memory(u64::MAX);
    assert!(counts[0] == counts[1] && counts[0] < 9000, "{counts:?}");
    config.max_vram = None;
    config.max_ram = "260M".parse().ok();
    let (foreseen, trained) = foreseen(&gpu, &config);
    assert!(trained.trainer.gaussian_count() <= foreseen.peak_gaussians.max(counts[0]));
}
