//! The code that ships is the code that is checked: every pass of rendering, training, density control and pseudo-GT,
//! as the library records it, against its CPU reference.

use nightsplat::Error;
use nightsplat::gpu::testing::{Defect, is_checked, with_defect};
use nightsplat::gpu::{BackwardForm, CheckReport, RecordSums, Sorting, Tile};
use nightsplat::splats::sort::{Count, RadixSort, Scan};
use nightsplat::train::{Background, Part};
use nightsplat_photographs::tone::Tone;

use crate::common::prelude::*;
use crate::common::setup::{Gradients, tile_of, variants};

/// Six views of 40 x 30 pixels with depth maps, as the model requires.
fn dataset(config: &TrainConfig) -> Dataset {
    let folder = Folder::empty();
    crate::common::train::write_with_depth(&folder);
    Dataset::load(folder, &config.load_options()).unwrap()
}

/// A quarter of the points, as references take most of the time. The plain steps keep all: more than a block to sort.
fn with_few_points(dataset: Dataset) -> Dataset {
    Dataset { points: dataset.points.into_iter().step_by(4).collect(), ..dataset }
}

/// Density control runs after the second step.
fn config(parts: &[Part]) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config =
        TrainConfig { steps: 40, background: Background::Random, tone, ..TrainConfig::bare() };
    config.schedule.densify_after = 1;
    config.schedule.densify_interval = 2;
    config.schedule.sh_degree_interval = 1;
    config.density.gradient_threshold = Some(1e-6);
    set_small_parts(&mut config, parts);
    config
}

fn kernels(report: &CheckReport) -> BTreeSet<&str> {
    report.passes.iter().map(|pass| pass.kernel).collect()
}

/// Asserts that every pass was compared and that no number differs by more than its rounding error explains.
fn assert_agrees(what: &str, report: &CheckReport) {
    report.agree().unwrap_or_else(|error| panic!("{what}: {error}"));
    let is_compared = |error: Option<f64>| error.is_some_and(|error| error <= 1.0);
    assert!(report.passes.iter().all(|pass| is_compared(pass.error)), "{what}");
}

/// A device that takes the passes of a CPU, whatever it is.
fn as_a_cpu() -> Gpu {
    gpu_with(|properties| properties.is_cpu = true)
}

/// Runs three checked steps, including density control; returns the kernels that ran.
fn assert_steps_agree(name: &str, config: &TrainConfig) -> BTreeSet<String> {
    assert_steps_agree_on(&as_a_cpu(), name, config)
}

fn assert_steps_agree_on(gpu: &Gpu, name: &str, config: &TrainConfig) -> BTreeSet<String> {
    assert_steps_agree_for(with_few_points(dataset(config)), gpu, name, config)
}

fn assert_steps_agree_for(
    dataset: Dataset,
    gpu: &Gpu,
    name: &str,
    config: &TrainConfig,
) -> BTreeSet<String> {
    let (trainer, mut all) = gpu.checked(|| Trainer::new(gpu, config.clone(), &dataset));
    let mut trainer = trainer.unwrap();
    while trainer.steps_done() < 3 {
        let (reports, report) = trainer.check_step();
        reports.unwrap();
        all.extend(report);
    }
    assert_agrees(name, &all);
    kernels(&all).into_iter().map(str::to_owned).collect()
}

#[test]
fn every_pass_of_a_step_agrees_with_its_reference_for_every_part_of_the_model() {
    let plain = config(&[]);
    let plain = assert_steps_agree_for(dataset(&plain), &as_a_cpu(), "plain", &plain);
    for kernel in ["project", "sort_downsweep", "blend_backward", "ssim", "densify_scatter"] {
        assert!(plain.contains(kernel), "{kernel} is not in {plain:?}");
    }
    let raw = TrainConfig { ssim_weight: 0.0, sh_degree: 2, ..config(&[]) };
    assert!(assert_steps_agree("L1 alone", &raw).contains("l1"));
    let mut smooth = config(&[]);
    (smooth.antialiasing.compensation, smooth.antialiasing.smoothing) = (true, 9.0);
    // The floor follows the last step.
    smooth.steps = 3;
    assert!(assert_steps_agree("antialiased", &smooth).contains("smoothing_floor"));
    let is_off = |kernel: &str| !plain.contains(kernel);
    assert!(["smoothing_floor", "lamp_backward", "lamp_gradient"].into_iter().all(is_off));
    for (part, kernel) in [
        (Part::Structure, "structure_l1"),
        (Part::Depth, "depth_correlation"),
        (Part::Tonemapper, "product_backward"),
        (Part::Denoiser, "norm_backward"),
        (Part::Lamp, "lamp_gradient"),
    ] {
        assert!(assert_steps_agree(part.name(), &config(&[part])).contains(kernel));
    }
}

#[test]
fn every_pass_of_a_step_of_a_gpu_agrees_with_its_reference() {
    let gpu = gpu_with(|properties| properties.is_cpu = false);
    let plain = config(&[]);
    let plain = assert_steps_agree_for(dataset(&plain), &gpu, "plain", &plain);
    for kernel in ["ssim_forward", "ssim_backward", "adam_gaussian"] {
        assert!(plain.contains(kernel), "{kernel} is not in {plain:?}");
    }
    assert!(!plain.contains("adam") && !plain.contains("ssim"), "{plain:?}");
    let nvidia = gpu_with(|properties| (properties.is_cpu, properties.vendor) = (false, 0x10de));
    assert_steps_agree_on(&nvidia, "features", &config(&[Part::Structure]));
    let mut halves = config(&[]);
    halves.precision.rest = StorageFormat::Half;
    for moments in [StorageFormat::Single, StorageFormat::Half] {
        halves.precision.moments = moments;
        for gpu in [&gpu, &as_a_cpu()] {
            let kernels = assert_steps_agree_on(gpu, "halves", &halves);
            assert!(kernels.contains("adam_gaussian") && !kernels.contains("adam"), "{kernels:?}");
        }
    }
}

#[test]
fn every_pass_of_the_whole_model_agrees_with_its_reference_on_a_crop() {
    let mut config = config(&Part::ALL);
    config.model.denoiser_crop = 9;
    config.model.raw_colors = true;
    config.ssim_weight = 0.0;
    for variant in [NetworkVariant::Identity, NetworkVariant::Paper] {
        config.model.network.variant = variant;
        let kernels = assert_steps_agree("the whole model", &config);
        assert!(kernels.contains("crop_scatter") && kernels.contains("denoising"), "{kernels:?}");
    }
}

#[test]
fn a_checked_step_gives_the_bits_of_an_unchecked_one() {
    let (gpu, config) = (gpu(), config(&Part::ALL));
    let dataset = with_few_points(dataset(&config));
    let [mut checked, mut unchecked] =
        [(); 2].map(|()| Trainer::new(&gpu, config.clone(), &dataset).unwrap());
    while checked.steps_done() < 4 {
        let reports = checked.check_step().0.unwrap();
        let same = unchecked.advance(unchecked.steps_done() + 1).unwrap();
        let terms = |reports: &[nightsplat::train::StepReport]| {
            reports.iter().map(|report| (report.step, report.terms.clone())).collect::<Vec<_>>()
        };
        assert_eq!(terms(&reports), terms(&same));
    }
    assert!(checked.gaussians().unwrap() == unchecked.gaussians().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let bytes = |trainer: &mut Trainer, name: &str| {
        let path = folder.path().join(name);
        trainer.save_checkpoint(&path).unwrap();
        fs::read(path).unwrap()
    };
    assert!(bytes(&mut checked, "a") == bytes(&mut unchecked, "b"), "moments or networks differ");
}

/// Values concentrated near black, as in dark photographs, and some that are not finite.
fn dark(pixels: u64) -> Vec<f32> {
    let stream = Stream::new(3, 1);
    let mut image: Vec<f32> =
        (0..3 * pixels).map(|i| 0.4 * stream.uniform(i).powi(4) as f32).collect();
    (image[0], image[1], image[2]) = (f32::NAN, -0.5, f32::INFINITY);
    image
}

#[test]
fn every_pass_of_the_pseudo_gt_agrees_with_its_reference_for_every_curve() {
    let gpu = gpu();
    let profile = ToneSettings::new(Tone::Profile(crate::common::setup::profile()));
    let named = ToneCurve::ALL.map(ToneSettings::new).into_iter();
    for settings in named.chain([ToneSettings::default(), profile]) {
        let curve = &settings.curve;
        if settings.check().is_err() {
            continue;
        }
        let (done, report) = gpu.checked(|| -> nightsplat::Result<()> {
            let pseudo_gt = PseudoGt::new(&gpu, &settings)?;
            let image = gpu.buffer("image", &dark(47 * 33))?;
            // Longer than the image: the values beyond it are undefined.
            let curve = settings.parameters(&Statistics::new(&dark(47 * 33)));
            let parameters = gpu.buffer("tone", &[curve; 3])?;
            let mut target = gpu.zeros("target", image.len())?;
            gpu.run("pseudo-GT", |pass| pseudo_gt.map(pass, &image, &parameters, 1, &mut target))
        });
        done.unwrap();
        assert!(kernels(&report).contains("pseudo_gt"), "{curve}: {:?}", kernels(&report));
        assert_agrees(&curve.to_string(), &report);
    }
}

/// Renders forward and backward, each pass checked.
fn assert_passes_agree(setup: &Setup) -> Gradients {
    let mut random = Random::new(3);
    let (gradients, report) = gpu().checked(|| {
        let mut rendered = setup.render();
        let d_render: Vec<f32> =
            rendered.render.iter().map(|_| random.between(-1.0, 1.0) as f32).collect();
        rendered.backward(&d_render)
    });
    assert_agrees(&format!("{} Gaussians, {:?}", setup.count, setup.settings), &report);
    assert!(kernels(&report).is_superset(&BTreeSet::from(["project", "project_backward"])));
    gradients
}

#[test]
fn every_pass_of_the_rasteriser_agrees_with_its_reference_at_every_size() {
    for setup in variants() {
        assert_passes_agree(&setup);
    }
}

/// Segments begin where the pixels of a part are done, where all of a tile's are, and with the last splat of a run.
#[test]
fn the_passes_of_long_runs_agree_with_their_references_in_segments() {
    let lanes = gpu().properties().subgroup_size;
    for (channels, size, subgroups, trains_depth) in [
        (3, [16, 8], 1, false),
        (11, [16, 16], 1, false),
        (4, [16, 16], 2, false),
        (3, [16, 16], 4, false),
        (5, [16, 8], 1, true),
    ] {
        let tile = tile_of((size, subgroups));
        if !gpu().properties().suits_tile(tile) {
            continue;
        }
        let mut setup = Setup::opaque_above(channels);
        (setup.settings.tile, setup.settings.trains_depth) = (Some(tile), trains_depth);
        let mut in_form = |segment, sums| {
            let tile = Tile { backward: Some(BackwardForm { segment, sums }), ..tile };
            setup.settings.tile = Some(tile);
            gpu().properties().suits_tile(tile).then(|| assert_passes_agree(&setup))
        };
        let whole = in_form(0, RecordSums::Shuffles).unwrap();
        let largest = whole.parameters.iter().fold(0.0f32, |most, d| most.max(d.abs()));
        for segments in RecordSums::ALL.into_iter().filter_map(|sums| in_form(lanes.max(16), sums))
        {
            for (whole, segments) in whole.parameters.iter().zip(&segments.parameters) {
                assert!((whole - segments).abs() <= 1e-5 * largest, "{tile}: {whole} {segments}");
            }
            assert_eq!(whole.visit_counts, segments.visit_counts);
        }
    }
}

/// Two tiles with a run each, of which the second starts at a block's first intersection or within it; no pixel ends.
#[test]
fn runs_of_whole_segments_and_of_one_splat_more_or_less_agree_with_their_references() {
    let length = gpu().properties().subgroup_size.max(16);
    for count in [length - 1, length, length + 1, 2 * length, 2 * length + 1] {
        let shape = Shape { sh_degree: 0, features: Features::NONE };
        let mut setup = Setup::new(count as usize, [32, 16], shape, 7);
        setup.settings.tile = Some(tile_of(([16, 16], 1)));
        for i in 0..setup.count {
            let mean =
                setup.at_pixel(DVec2::new(14.0 + (i % 5) as f64, 8.0), 1.0 + 0.01 * i as f64);
            let log_scale = DVec3::ZERO;
            setup.set(i, &Gaussian { mean, log_scale, raw_opacity: -3.0, ..setup.get(i) });
        }
        assert_eq!(setup.render().renderer.intersections().unwrap(), 2 * count);
        let [whole, segments] = [0, length].map(|segment| {
            let backward = Some(BackwardForm { segment, sums: RecordSums::Shuffles });
            setup.settings.tile = Some(Tile { backward, ..tile_of(([16, 16], 1)) });
            assert_passes_agree(&setup).parameters
        });
        let largest = whole.iter().fold(0.0f32, |most, d| most.max(d.abs()));
        for (whole, segments) in whole.iter().zip(&segments) {
            assert!((whole - segments).abs() <= 1e-5 * largest, "{count}: {whole} {segments}");
        }
    }
}

#[test]
fn the_passes_of_a_render_whose_tiles_are_sorted_by_themselves_agree_with_their_references() {
    for channels in [3, 11] {
        let mut setup = Setup::opaque_above(channels);
        setup.settings.sorting = Some(Sorting::Tiles);
        assert_passes_agree(&setup);
    }
}

#[test]
fn every_pass_of_scan_and_sort_agrees_with_its_reference_at_every_size() {
    let gpu = gpu();
    let stream = Stream::new(5, 0);
    for (count, capacity) in [(0, 1), (1, 1), (5, 1024), (1023, 1024), (1025, 1025), (3000, 5001)] {
        let data: Vec<u32> = (0..capacity).map(|i| stream.bits(i) as u32).collect();
        let (done, report) = gpu.checked(|| -> nightsplat::Result<()> {
            let counts = gpu.buffer("counts", &[7, count])?;
            let (mut keys, mut values) = (gpu.buffer("keys", &data)?, gpu.buffer("values", &data)?);
            let mut offsets = gpu.uninit("offsets", data.len())?;
            let mut total = gpu.uninit("total", 1)?;
            let mut sort = RadixSort::new(&gpu, capacity as u32)?;
            let mut scan = Scan::new(&gpu, capacity as u32)?;
            gpu.run("sort", |pass| {
                let count = Count { counts: &counts, index: 1 };
                scan.record(pass, count, &values, &mut offsets, &mut total)?;
                sort.record(pass, count, &mut keys, &mut values, 13)
            })
        });
        done.unwrap();
        assert_agrees(&format!("{count} of {capacity}"), &report);
    }
}

/// A step of `plain` on a device that flips the lowest bits of one parameter of `kernel`.
fn with_wrong_param(gpu: &Gpu, kernel: &'static str, word: usize, bits: u32) -> CheckReport {
    let mut trainer = Trainer::new(gpu, config(&[]), &dataset(&config(&[]))).unwrap();
    let (step, report) = with_defect(Defect { kernel, word, bits }, || trainer.check_step());
    assert!(step.is_ok() || matches!(step, Err(Error::NotFinite { .. })), "{step:?}");
    report
}

#[test]
fn a_wrong_parameter_is_reported_at_the_pass_that_uses_it() {
    let gpu = as_a_cpu();
    // The near plane, the background, the scale of L1, Adam's rate for the means. What a kernel leaves unwritten may
    // hold the right values of an earlier run: the outputs are written, and wrong.
    for (kernel, word, bits, buffer) in [
        ("project", 1, 0x4000_0000, "splats"),
        ("blend_forward", 4, 0x3f80_0000, "render"),
        ("ssim", 6, 0x0080_0000, "d_render"),
        ("adam", 5, 0x0080_0000, "parameters"),
        ("sort_upsweep", 2, 1, "table"),
    ] {
        let report = with_wrong_param(&gpu, kernel, word, bits);
        let first =
            report.first_difference().unwrap_or_else(|| panic!("{kernel} was not detected"));
        assert_eq!((first.kernel, first.buffer), (kernel, buffer), "{first}");
        assert!((first.device - first.reference).abs() > first.bound && first.count > 0, "{first}");
        assert_eq!(report.passes[first.pass].difference.as_ref(), Some(first));
        let message = first.to_string();
        assert!(message.contains(kernel) && message.contains(buffer), "{message}");
        // Passes that depend on wrong counts or indices are not compared: their references would be out of range.
        let is_index = matches!(kernel, "project" | "sort_upsweep");
        assert_eq!(report.passes.iter().any(|pass| pass.error.is_none()), is_index, "{kernel}");
    }
}

#[test]
fn a_panic_ends_the_checks_and_removes_the_defect() {
    let gpu = gpu();
    let defect = Defect { kernel: "project", word: 12, bits: 0x0040_0000 };
    let work = || gpu.checked(|| with_defect(defect, || panic!("on purpose")));
    assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).is_err());
    assert!(!is_checked(&gpu));
    assert_steps_agree("after a panic", &config(&[]));
    assert!(!is_checked(&gpu));
}

#[test]
fn data_that_is_not_finite_gives_no_difference_and_no_panic() {
    let gpu = as_a_cpu();
    let mut dataset = dataset(&config(&[]));
    for view in &mut dataset.views {
        if let Some(image) = &mut view.image {
            for (i, value) in image.data.iter_mut().enumerate() {
                *value = [f32::NAN, f32::INFINITY, *value][i % 3];
            }
        }
    }
    let mut trainer = Trainer::new(&gpu, config(&[]), &dataset).unwrap();
    let (_, report) = trainer.check_step();
    assert_agrees("a photograph of NaN", &report);

    let mut parameters = trainer.gaussians().unwrap();
    let stream = Stream::new(1, 1);
    for (i, value) in parameters.parameters.iter_mut().enumerate() {
        if stream.uniform(i as u64) < 0.02 {
            *value = [f32::NAN, f32::INFINITY, -f32::INFINITY][i % 3];
        }
    }
    let config = config(&[]);
    let mut trainer = Trainer::from_gaussians(&gpu, config, &dataset, &parameters).unwrap();
    let (_, report) = trainer.check_step();
    assert!(report.passes.iter().any(|pass| pass.kernel == "adam"), "{:?}", kernels(&report));
}

#[test]
fn the_command_checks_a_dataset_and_names_the_buffer_that_differs() {
    use clap::Parser as _;
    let folder = written(&small_set(3, [24, 18], 1));
    let check = |path: &Path| {
        let arguments = ["nightsplat", "check", path.to_str().unwrap(), "--steps", "1", "--json"];
        nightsplat::cli::Cli::try_parse_from(arguments).unwrap().run()
    };
    check(&folder).unwrap();
    // The red of the background.
    let defect = Defect { kernel: "blend_forward", word: 4, bits: 0x3f80_0000 };
    let error = with_defect(defect, || check(&folder)).unwrap_err().to_string();
    says(&error, &["`blend_forward`", "render["]);
}
