//! More Gaussians than one binding can hold: passes in batches, with the same bits.

use nightsplat_models::gaussians::width;

use nightsplat::gpu::testing::gpu_that_binds;

use crate::common::not_run;
use crate::common::prelude::*;
use crate::common::setup::features;
use crate::common::train::dataset;

/// The planes of 2176 Gaussians of SH degree 3, or 16384 splats.
const LITTLE: u64 = 1 << 19;
const BATCH: usize = 2176;

/// A device that is taken for a GPU.
fn little_gpu() -> Gpu {
    gpu_with(|properties| {
        (properties.is_cpu, properties.max_storage_buffer_range) = (false, LITTLE);
    })
}

#[test]
fn the_planes_of_a_gpu_are_written_column_by_column_and_read_back_whole() {
    let shape = Shape { sh_degree: 2, features: features(5) };
    let (columns, before_rest) = (width(shape), width(shape) - 24);
    let gpu = little_gpu();
    for count in [0, 1, 3000, 7000] {
        let all = Layout::new(count, shape, StorageFormat::Single).batches(&gpu);
        let planes: Vec<f32> = (0..count * columns).map(|i| i as f32).collect();
        let buffer = all.upload(&gpu, "planes", &planes).unwrap();
        assert_eq!(all.read(&gpu, &buffer).unwrap(), planes);
        let stored = gpu.read(&buffer).unwrap();
        for (float, value) in stored.iter().take(count * columns).enumerate() {
            assert_eq!(all.index_of(float) as f32, *value);
        }
        // Neighbouring Gaussians of a batch have neighbouring words.
        for batch in all.iter().filter(|batch| batch.count > 1) {
            let of_batch = gpu.read(batch.planes(&buffer).unwrap()).unwrap();
            let second = &of_batch[(before_rest + 1) * batch.count..];
            assert_eq!(second[1] - second[0], 24.0);
        }
    }
}

#[test]
fn planes_are_written_in_batches_and_read_back_whole() {
    written_and_read_back(&gpu_that_binds(LITTLE));
}

#[test]
fn planes_beyond_the_largest_buffer_are_written_and_read_back_whole() {
    written_and_read_back(&gpu_of_little_buffers());
}

fn gpu_of_little_buffers() -> Gpu {
    gpu_with(|properties| {
        properties.max_buffer_size = LITTLE;
        properties.max_storage_buffer_range = LITTLE.min(properties.max_storage_buffer_range);
    })
}

fn written_and_read_back(gpu: &Gpu) {
    let shape = Shape { sh_degree: 2, features: features(5) };
    let columns = width(shape);
    for (count, batches) in [(0, vec![0]), (3000, vec![3000]), (7000, vec![3264, 3264, 472])] {
        let all = Layout::new(count, shape, StorageFormat::Single).batches(gpu);
        assert_eq!(all.iter().map(|batch| batch.count).collect::<Vec<_>>(), batches);
        let planes: Vec<f32> = (0..count * columns).map(|i| i as f32).collect();
        let buffer = all.upload(gpu, "planes", &planes).unwrap();
        assert_eq!(all.read(gpu, &buffer).unwrap(), planes);
        assert!(
            all.zeros(gpu, "zeros")
                .and_then(|zeros| gpu.read(&zeros))
                .unwrap()
                .iter()
                .all(|x| *x == 0.0)
        );
        for (float, value) in gpu.read(&buffer).unwrap().into_iter().enumerate() {
            assert_eq!(all.index_of(float) as f32, value);
        }
        // The scales of each batch's last Gaussian are at the addresses that its kernels read.
        if let Some(batch) = all.iter().filter(|batch| batch.count > 0).last() {
            let of_batch = gpu.read(batch.planes(&buffer).unwrap()).unwrap();
            let of = |count: usize, parameters: &[f32]| {
                let mut gaussians = Gaussians::zeros(count, shape);
                gaussians.parameters.copy_from_slice(parameters);
                gaussians
            };
            let last = of(batch.count, &of_batch).log_scales()[batch.count - 1];
            let whole = of(count, &planes);
            assert_eq!(last, whole.log_scales()[count - 1]);
        }
    }
}

#[test]
fn columns_that_are_not_trained_take_no_memory_and_are_read_as_zeros() {
    let shape = Shape { sh_degree: 1, features: features(5) };
    let columns = width(shape);
    for gpu in [gpu_that_binds(LITTLE), little_gpu()] {
        for (frozen, count) in [(3, 1), (11, 2), (11, 3), (10, 5), (14, 6), (11, 12_347)] {
            let all = Layout::new(count, shape, StorageFormat::Single).batches(&gpu);
            let trained = all.without(frozen);
            let planes: Vec<f32> = (1..=count * columns).map(|i| i as f32).collect();
            let buffer = trained.upload(&gpu, "trained", &planes).unwrap();
            let frozen = frozen as usize * count;
            assert_eq!(buffer.len(), count * columns - frozen / 4 * 4);
            let read = trained.read(&gpu, &buffer).unwrap();
            assert!(read[frozen..] == planes[frozen..]);
            // Up to three floats share a vector with the first trained one.
            assert!(read[..frozen.saturating_sub(3)].iter().all(|value| *value == 0.0));
            let whole = all.upload(&gpu, "whole", &planes).unwrap();
            for (trained, whole_batch) in trained.iter().zip(all.iter()) {
                let of_batch = gpu.read(trained.planes(&buffer).unwrap()).unwrap();
                let expected = gpu.read(whole_batch.planes(&whole).unwrap()).unwrap();
                assert!(expected.ends_with(&of_batch));
            }
        }
    }
}

/// Views of a dataset without points.
fn views() -> Dataset {
    Dataset { points: vec![], ..dataset(8, [40, 30]) }
}

/// The steps include density control and a growing SH degree.
fn config() -> TrainConfig {
    let mut config =
        TrainConfig { steps: 30, max_gaussians: 4700, random_points: 4200, ..TrainConfig::bare() };
    (config.schedule.densify_after, config.schedule.densify_interval) = (4, 5);
    config.schedule.densify_before = 25;
    config.schedule.sh_degree_interval = 7;
    config.density.gradient_threshold = Some(1e-6);
    // Small Gaussians, which intersect few tiles: a binding holds the intersections of all of them on each device.
    config.start.scale = 0.1;
    config.tile = Some([16, 16].into());
    config
}

#[test]
fn training_in_batches_gives_the_bits_of_one_batch() {
    trains_to_the_bits_of_one_batch(&gpu_that_binds(LITTLE));
}

#[test]
fn training_beyond_the_largest_buffer_gives_the_bits_of_one_buffer() {
    trains_to_the_bits_of_one_batch(&gpu_of_little_buffers());
}

fn trains_to_the_bits_of_one_batch(little: &Gpu) {
    let (dataset, folder) = (views(), tempfile::tempdir().unwrap());
    let new = |gpu: &Gpu| Trainer::new(gpu, config(), &dataset).unwrap();
    let whole = &gpu();
    let (mut expected, mut batched) = (new(whole), new(little));
    let [whole_reports, batched_reports] =
        [&mut expected, &mut batched].map(|trainer| advance(trainer, 30));
    assert!(
        batched.gaussian_count() > 2 * BATCH,
        "{} do not make three batches",
        batched.gaussian_count()
    );
    assert_eq!(batched.gaussian_count(), expected.gaussian_count());
    for (batched, whole) in batched_reports.iter().zip(&whole_reports) {
        let (count, terms) = (batched.gaussians, &batched.terms);
        assert_eq!((batched.step, count, terms), (whole.step, whole.gaussians, &whole.terms));
    }
    let end = |trainer: &mut Trainer| {
        let path = folder.path().join("end.safetensors");
        trainer.save_checkpoint(&path).unwrap();
        fs::read(path).unwrap()
    };
    assert!(end(&mut batched) == end(&mut expected), "another state");

    // The run resumes with larger and with smaller bindings.
    let checkpoint = folder.path().join("checkpoint.safetensors");
    for [from, to] in [[whole, little], [little, whole]] {
        let (mut first, mut second) = (new(from), new(to));
        advance(&mut first, 22);
        first.save_checkpoint(&checkpoint).unwrap();
        second.restore(&checkpoint).unwrap();
        advance(&mut second, 30);
        assert!(second.gaussians().unwrap() == expected.gaussians().unwrap());
    }
}

/// The layout of SH coefficients, gradients of colours in place of theirs, the number of kernels of a sort: a GPU and a
/// CPU do the same work in other ways, with the same bits, where tile and loss are the same and no tile has more splats
/// than a segment.
#[test]
fn training_as_on_a_gpu_gives_the_bits_of_training_as_on_a_cpu() {
    let dataset = views();
    for (rest, moments) in [
        (StorageFormat::Single, StorageFormat::Single),
        (StorageFormat::Half, StorageFormat::Single),
        (StorageFormat::Single, StorageFormat::Half),
    ] {
        let (max_gaussians, random_points) = (2600, 2300);
        let mut config = TrainConfig { ssim_weight: 0.0, max_gaussians, random_points, ..config() };
        (config.precision.rest, config.precision.moments) = (rest, moments);
        let train = |gpu: &Gpu| {
            let mut trainer = Trainer::new(gpu, config.clone(), &dataset).unwrap();
            advance(&mut trainer, 23);
            trainer.gaussians().unwrap()
        };
        let expected = train(&gpu());
        assert!(expected.shape.sh_degree == 3 && expected.count > BATCH);
        for gpu in [gpu_with(|properties| properties.is_cpu = false), little_gpu()] {
            assert!(train(&gpu) == expected, "{rest:?} {moments:?}");
        }
    }
}

#[test]
fn passes_in_batches_match_their_references() {
    let dataset = views();
    let gpu = gpu_with(|properties| {
        (properties.is_cpu, properties.max_storage_buffer_range) = (true, LITTLE);
    });
    let mut trainer = Trainer::new(&gpu, config(), &dataset).unwrap();
    advance(&mut trainer, 22);
    let batches = trainer.gaussian_count().div_ceil(BATCH);
    assert!(batches > 1);
    let (done, report) = trainer.check_step();
    done.unwrap();
    assert!(report.first_difference().is_none(), "{report:?}");
    for kernel in ["project", "project_backward", "adam"] {
        let passes = report.passes.iter().filter(|pass| pass.kernel == kernel).count();
        assert_eq!(passes, batches, "{kernel}");
    }
}

#[test]
fn growth_in_batches_matches_its_references() {
    let gpu = gpu_that_binds(LITTLE);
    let dataset = views();
    let mut trainer = Trainer::new(&gpu, config(), &dataset).unwrap();
    let before = trainer.gaussian_count();
    let (_, report) = gpu.checked(|| advance(&mut trainer, 20));
    assert!(trainer.gaussian_count() > before.max(BATCH));
    assert!(report.first_difference().is_none(), "{report:?}");
    let passes = |kernel| report.passes.iter().filter(|pass| pass.kernel == kernel).count();
    // From one batch or two into two.
    assert!(passes("densify_scatter") > 3 && passes("densify_moments") > 6);
}

/// Half of the Gaussians are behind the camera, in the first batch; the visible ones are in the second.
#[test]
fn gaussians_beyond_a_binding_are_rendered() {
    let gpu = gpu();
    let shape = Shape::from(3);
    let binding = gpu.properties().max_storage_buffer_range as usize;
    let hidden = binding / (width(shape) * size_of::<f32>());
    if hidden > 1_000_000 {
        return not_run("lavapipe", format_args!("this device binds {binding} bytes"));
    }
    let seen = Setup::new(500, [64, 48], shape, 5);
    let visible = seen.gaussians();
    let mut all = Gaussians::zeros(hidden + seen.count, shape);
    let out_of_view =
        seen.camera.view_from_world.inverse().transform_point3(DVec3::NEG_Z).as_vec3();
    all.means_mut()[..hidden].fill(out_of_view);
    let copies: [fn(&mut Gaussians, &Gaussians, usize); 6] = [
        |all, visible, at| all.means_mut()[at..].copy_from_slice(visible.means()),
        |all, visible, at| all.quats_mut()[at..].copy_from_slice(visible.quats()),
        |all, visible, at| all.log_scales_mut()[at..].copy_from_slice(visible.log_scales()),
        |all, visible, at| all.raw_opacities_mut()[at..].copy_from_slice(visible.raw_opacities()),
        |all, visible, at| all.dc_mut()[at..].copy_from_slice(visible.dc()),
        |all, visible, at| all.rest_mut()[15 * at..].copy_from_slice(visible.rest()),
    ];
    copies.iter().for_each(|copy| copy(&mut all, &visible, hidden));
    let [alone, among] = [&visible, &all].map(|gaussians| {
        let settings = RenderSettings { shape, ..RenderSettings::default() };
        let mut renderer = Renderer::new(&gpu, settings).unwrap();
        renderer.reserve(gaussians.count, [&seen.camera]).unwrap();
        let options = RenderOptions { sh_degree: 3, background: Vec3::ZERO.to_array() };
        let parameters = gaussians.upload(&gpu).unwrap();
        renderer.render_image(&parameters, &seen.camera, &options).unwrap()
    });
    assert!(alone == among);
}

#[test]
fn more_than_a_device_can_bind_is_refused_and_growth_stops_before_it() {
    let gpu = gpu_that_binds(LITTLE);
    let settings = RenderSettings::default();
    assert_eq!(settings.peak_gaussians(&gpu), 16_384);
    let mut renderer = Renderer::new(&gpu, settings).unwrap();
    let camera = Setup::new(1, [32, 24], 0, 1).camera;
    let refused = renderer.reserve(16_385, [&camera]).unwrap_err().to_string();
    assert!(refused.contains("`splats`"), "{refused}");
    renderer.reserve(3000, [&camera]).unwrap();
    let mut short = Gaussians::zeros(2999, settings.shape).upload(&gpu).unwrap();
    // Fewer parameters than the layout requires.
    short.layout.count = 3000;
    let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
    let refused = renderer.render_image(&short, &camera, &options).unwrap_err().to_string();
    assert!(refused.contains("out of range for buffer `parameters`"), "{refused}");
}

#[test]
fn training_starts_with_the_first_points_if_there_are_more_than_a_device_renders() {
    let mut config = config();
    (config.random_points, config.max_gaussians) = (17_000, 20_000);
    config.start.scale = 1e-3;
    let mut trainer = Trainer::new(&gpu_that_binds(LITTLE), config, &views()).unwrap();
    assert_eq!(trainer.gaussian_count(), 16_384);
    advance(&mut trainer, 6);
    assert!(trainer.gaussian_count() <= 16_384);
}
