//! Density control: the kernels against their references, what becomes of whom, the limit, the edges.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

use glam::{Quat, Vec3};
use nightsplat::densify::{
    Densifier, DensifyInputs, DensifyReport, DensifySettings, DensityControl, DeviceGaussians,
    Round,
};
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{Gpu, Reference};
use nightsplat::halves::Bits;
use nightsplat::kernels::fate::{KEY_KEEP, KEY_PRUNE};
use nightsplat::kernels::{densify_decide, densify_moments, densify_scatter, densify_score};
use nightsplat::optimizer::Moments;

/// Four features and SH of degree 1.
const COLUMNS: usize = 27;
const FEATURES: usize = 4;
const REST: usize = 14 + FEATURES;
const SETTINGS: DensifySettings = DensifySettings {
    control: DensityControl::Paper,
    gradient_threshold: 2e-4,
    split_scale: 0.05,
    min_opacity: 0.005,
    max_gaussians: usize::MAX,
    seed: 10,
};
const CONSERVING: DensifySettings =
    DensifySettings { control: DensityControl::Conserving, ..SETTINGS };
const STEP: u64 = 600;
const LAST: Round = Round { step: STEP, rounds_left: 1, most: usize::MAX };

fn room_for(gpu: &Gpu, count: usize) -> DeviceGaussians {
    DeviceGaussians::new(gpu, count, [COLUMNS, FEATURES], [Bits::Single; 2]).unwrap()
}

/// Gaussians, their moments and their statistics in host memory.
#[derive(Clone, Debug, PartialEq)]
struct Host {
    count: usize,
    parameters: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    grad_norm_sums: Vec<f32>,
    visit_counts: Vec<u32>,
}

impl Host {
    /// Opaque Gaussians of scale 0.01 that nothing pulls at.
    fn calm(count: usize) -> Self {
        let wave = |phase: f32| -> Vec<f32> {
            (0..count * COLUMNS).map(|i| (i as f32 * 0.7 + phase).sin()).collect()
        };
        let mut parameters = wave(0.0);
        parameters[7 * count..10 * count].fill(0.01f32.ln());
        parameters[10 * count..11 * count].fill(2.0);
        let (first, second) = (wave(1.0), wave(2.0));
        Self {
            count,
            parameters,
            first,
            second,
            grad_norm_sums: vec![0.0; count],
            visit_counts: vec![4; count],
        }
    }

    /// Large and small, faint and opaque ones under gradients of all sizes, some never seen.
    fn mixed(count: usize) -> Self {
        let mut host = Self::calm(count);
        for i in 0..count {
            host.parameters[7 * count + 3 * i] =
                if i % 3 == 0 { 0.2f32.ln() } else { 0.01f32.ln() };
            host.parameters[10 * count + i] = if i % 7 == 0 { -6.0 } else { 1.0 };
            host.visit_counts[i] = i as u32 % 5;
            host.grad_norm_sums[i] = (i * 37 % 101) as f32 * 2e-5;
        }
        host
    }

    fn pull_at(&mut self, i: usize) {
        self.grad_norm_sums[i] = 1.0;
    }

    fn quat_mut(&mut self, i: usize) -> &mut [f32] {
        let first = 3 * self.count + 4 * i;
        &mut self.parameters[first..first + 4]
    }

    fn log_scales_mut(&mut self, i: usize) -> &mut [f32] {
        let first = 7 * self.count + 3 * i;
        &mut self.parameters[first..first + 3]
    }

    fn mean(&self, i: usize) -> Vec3 {
        Vec3::from_slice(&self.parameters[3 * i..])
    }

    /// All floats of one Gaussian, column by column.
    fn row(&self, planes: &[f32], i: usize) -> Vec<f32> {
        [(0, 3), (3, 4), (7, 3), (10, 1), (11, 3), (14, FEATURES), (REST, COLUMNS - REST)]
            .into_iter()
            .flat_map(|(column, width)| {
                let first = column * self.count + width * i;
                planes[first..first + width].to_vec()
            })
            .collect()
    }

    fn densify(&self, gpu: &Gpu, settings: DensifySettings, round: Round) -> (Self, DensifyReport) {
        let planes = |data: &[f32]| gpu.buffer("planes", data).unwrap();
        let mut gaussians = room_for(gpu, self.count);
        gaussians.parameters = planes(&self.parameters);
        gaussians.moments =
            Moments::Single { first: planes(&self.first), second: planes(&self.second) };
        let inputs = DensifyInputs {
            grad_norm_sums: &mut planes(&self.grad_norm_sums),
            visit_counts: &mut gpu.buffer("visit_counts", &self.visit_counts).unwrap(),
            gradients: &mut planes(&vec![f32::NAN; self.count * COLUMNS]),
        };
        let mut densifier = Densifier::new(gpu, settings).unwrap();
        let report = densifier.densify(&mut gaussians, inputs, round).unwrap();
        assert_eq!(report.count, gaussians.count as usize);
        let Moments::Single { first, second } = &gaussians.moments else { panic!() };
        let read = |buffer| {
            let mut planes = gpu.read(buffer).unwrap();
            planes.truncate(report.count * COLUMNS);
            assert_eq!(planes.len(), report.count * COLUMNS);
            planes
        };
        let host = Self {
            count: report.count,
            parameters: read(&gaussians.parameters),
            first: read(first),
            second: read(second),
            grad_norm_sums: vec![0.0; report.count],
            visit_counts: vec![0; report.count],
        };
        (host, report)
    }

    /// The same by the references, with sort and prefix sums on the host.
    fn reference(&self, settings: DensifySettings, round: Round) -> Self {
        let n = self.count;
        let (gaussian_count, column_count, feature_count) =
            (n as u32, COLUMNS as u32, FEATURES as u32);
        let (mut keys, mut ids, mut tally) = (vec![0; n], vec![0; n], vec![0; 4]);
        let params = densify_score::Params {
            gaussian_count,
            column_count,
            feature_count,
            gradient_threshold: settings.gradient_threshold as f32,
            min_raw_opacity: (settings.min_opacity / (1.0 - settings.min_opacity)).ln() as f32,
            first_gaussian: 0,
        };
        let slices = densify_score::Slices {
            parameters: &self.parameters,
            grad_norm_sums: &self.grad_norm_sums,
            visit_counts: &self.visit_counts,
            keys: &mut keys,
            ids: &mut ids,
            tally: &mut tally,
        };
        densify_score::Kernel::run(&params, &densify_score::Constants::default(), slices);
        assert_eq!(tally[0] as usize, keys.iter().filter(|&&key| key < KEY_KEEP).count());
        assert_eq!(tally[1] as usize, keys.iter().filter(|&&key| key == KEY_PRUNE).count());
        ids.sort_by_key(|&id| keys[id as usize]);
        keys.sort_unstable();
        let (mut fates, mut offspring_counts) = (vec![0; n], vec![0; n]);
        let params = densify_decide::Params {
            gaussian_count,
            first_gaussian: 0,
            batch_count: gaussian_count,
            max_gaussians: settings.max_gaussians.min(u32::MAX as usize) as u32,
            rounds_left: round.rounds_left as u32,
            split_log_scale: settings.split_scale.ln() as f32,
        };
        let slices = densify_decide::Slices {
            parameters: &self.parameters,
            sorted_keys: &keys,
            sorted_ids: &ids,
            tally: &mut tally,
            fates: &mut fates,
            offspring_counts: &mut offspring_counts,
        };
        let conserving = settings.control == DensityControl::Conserving;
        densify_decide::Kernel::run(&params, &densify_decide::Constants { conserving }, slices);
        let mut count = 0;
        let offsets: Vec<u32> = offspring_counts
            .iter()
            .map(|offspring| {
                count += offspring;
                count - offspring
            })
            .collect();
        let new_gaussian_count = count;
        let count = count as usize;
        let mut new_parameters = vec![0.0; count * COLUMNS];
        let params = densify_scatter::Params {
            gaussian_count,
            new_gaussian_count,
            column_count,
            feature_count,
            seed: settings.seed as u32,
            step: round.step as u32,
            first_gaussian: 0,
            first_new_gaussian: 0,
        };
        let slices = densify_scatter::Slices {
            parameters: &self.parameters,
            fates: &fates,
            offsets: &offsets,
            new_parameters: &mut new_parameters,
        };
        densify_scatter::Kernel::run(&params, &densify_scatter::Constants { conserving }, slices);
        let carry = |moments: &[f32]| {
            let mut new_moments = vec![0.0_f32; count * COLUMNS];
            let params = densify_moments::Params {
                gaussian_count,
                new_gaussian_count,
                column_count,
                feature_count,
                first_new_gaussian: 0,
            };
            let slices = densify_moments::Slices {
                moments: bytemuck::cast_slice(moments),
                fates: &fates,
                offsets: &offsets,
                new_moments: bytemuck::cast_slice_mut(&mut new_moments),
            };
            densify_moments::Kernel::run(&params, &densify_moments::Constants::default(), slices);
            new_moments
        };
        Self {
            count,
            parameters: new_parameters,
            first: carry(&self.first),
            second: carry(&self.second),
            grad_norm_sums: vec![0.0; count],
            visit_counts: vec![0; count],
        }
    }
}

#[test]
fn density_control_matches_its_references() {
    let gpu = gpu();
    let limited = DensifySettings { max_gaussians: 1100, ..CONSERVING };
    let sizes = [0, 1, 2, 63, 64, 65, 1000];
    let cases = [SETTINGS, CONSERVING, limited].into_iter().flat_map(|s| sizes.map(|n| (s, n)));
    for (settings, count) in cases {
        let before = Host::mixed(count);
        let round = Round { rounds_left: 3, ..LAST };
        let (actual, report) = before.densify(&gpu, settings, round);
        let expected = before.reference(settings, round);
        assert_eq!(actual.count, expected.count, "{report:?}");
        assert_eq!((&actual.first, &actual.second), (&expected.first, &expected.second));
        for (i, (a, b)) in actual.parameters.iter().zip(&expected.parameters).enumerate() {
            // Only means, scales and opacities are computed; exp, log and cos are good to about 1e-5 here.
            let tolerance = if i < 11 * actual.count { 2e-5 } else { 0.0 };
            assert!((a - b).abs() <= tolerance, "{count} Gaussians, float {i}: {a} {b}");
        }
        if settings == SETTINGS && count == 1000 {
            assert!(report.cloned > 100 && report.split > 50 && report.pruned > 100, "{report:?}");
        }
    }
}

#[test]
fn a_small_gaussian_under_a_large_gradient_stays_and_gets_a_copy() {
    let gpu = gpu();
    let mut before = Host::calm(3);
    before.pull_at(1);
    let (after, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report, DensifyReport { cloned: 1, count: 4, ..Default::default() });
    for (old, new) in [(0, 0), (1, 1), (2, 3)] {
        for (planes, new_planes) in [
            (&before.parameters, &after.parameters),
            (&before.first, &after.first),
            (&before.second, &after.second),
        ] {
            assert_eq!(before.row(planes, old), after.row(new_planes, new));
        }
    }
    let (parent, copy) = (before.row(&before.parameters, 1), after.row(&after.parameters, 2));
    assert_eq!(parent[3..], copy[3..]);
    let distance = before.mean(1).distance(after.mean(2));
    assert!(distance > 0.0 && distance < 0.06, "{distance}: not a draw at scale 0.01");
    assert!(
        after.row(&after.first, 2).iter().chain(&after.row(&after.second, 2)).all(|m| *m == 0.0)
    );
}

#[test]
fn a_large_gaussian_under_a_large_gradient_is_replaced_by_two_smaller_ones() {
    let gpu = gpu();
    let mut before = Host::calm(2);
    before.pull_at(0);
    before.log_scales_mut(0).copy_from_slice(&[0.2f32.ln(), 0.1f32.ln(), 0.01f32.ln()]);
    let (after, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report, DensifyReport { split: 1, count: 3, ..Default::default() });
    for i in 0..2 {
        let row = after.row(&after.parameters, i);
        let parent = before.row(&before.parameters, 0);
        assert_eq!((&row[3..7], &row[10..]), (&parent[3..7], &parent[10..]));
        for (log_scale, scale) in row[7..10].iter().zip([0.2f32, 0.1, 0.01]) {
            assert!((log_scale.exp() - scale / 1.6).abs() < 1e-6);
        }
        assert!(after.row(&after.first, i).iter().all(|m| *m == 0.0));
    }
    assert_ne!(after.mean(0), after.mean(1));
    assert_eq!(before.row(&before.first, 1), after.row(&after.first, 2));
}

#[test]
fn drawn_positions_have_the_covariance_of_their_parent() {
    let gpu = gpu();
    let count = 4000;
    let mut before = Host::calm(count);
    let rotation = Quat::from_euler(glam::EulerRot::XYZ, 0.3, 0.7, -0.4);
    let scales = Vec3::new(0.04, 0.02, 0.005);
    for i in 0..count {
        before.pull_at(i);
        // Twice the length: what is stored is not normalised.
        let [x, y, z, w] = (rotation * 2.0).to_array();
        before.quat_mut(i).copy_from_slice(&[w, x, y, z]);
        before.log_scales_mut(i).copy_from_slice(&scales.to_array().map(f32::ln));
    }
    let (after, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report.cloned, count);
    let draws: Vec<Vec3> = (0..count)
        .map(|i| rotation.inverse() * (after.mean(2 * i + 1) - before.mean(i)) / scales)
        .collect();
    let mean = draws.iter().sum::<Vec3>() / count as f32;
    assert!(mean.abs().max_element() < 0.05, "{mean}");
    for j in 0..3 {
        for k in 0..3 {
            let moment = draws.iter().map(|draw| draw[j] * draw[k]).sum::<f32>() / count as f32;
            let expected = f32::from(u8::from(j == k));
            assert!((moment - expected).abs() < 0.08, "moment {j} {k}: {moment}");
        }
    }
}

#[test]
fn a_faint_gaussian_goes_even_where_views_pull_at_it() {
    let gpu = gpu();
    let mut before = Host::calm(3);
    before.parameters[10 * 3 + 1] = -5.4;
    before.pull_at(1);
    let (after, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report, DensifyReport { pruned: 1, count: 2, ..Default::default() });
    assert_eq!(after.row(&after.first, 1), before.row(&before.first, 2));
}

#[test]
fn all_can_go() {
    let gpu = gpu();
    let mut before = Host::calm(70);
    before.parameters[10 * 70..11 * 70].fill(-9.0);
    let (after, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report, DensifyReport { pruned: 70, ..Default::default() });
    assert_eq!(after.count, 0);
}

#[test]
fn a_gaussian_that_is_not_finite_goes() {
    let gpu = gpu();
    for (column, value) in [
        (0, f32::NAN),
        (4, f32::INFINITY),
        (8, f32::INFINITY),
        (10, f32::NAN),
        (12, f32::NEG_INFINITY),
        (20, f32::NAN),
    ] {
        let mut before = Host::calm(5);
        before.pull_at(2);
        before.parameters[column * 5 + 2] = value;
        let (after, report) = before.densify(&gpu, SETTINGS, LAST);
        assert_eq!(
            (report.pruned, report.count - report.cloned),
            (1, 4),
            "column {column}: {report:?}"
        );
        assert!(after.parameters.iter().all(|p| p.is_finite()));
    }
}

#[test]
fn a_quaternion_of_zero_length_draws_along_the_axes() {
    let gpu = gpu();
    let mut before = Host::calm(1);
    before.pull_at(0);
    before.quat_mut(0).fill(0.0);
    before.log_scales_mut(0).copy_from_slice(&[0.04f32.ln(), -30.0, -30.0]);
    let (after, _) = before.densify(&gpu, SETTINGS, LAST);
    let offset = after.mean(1) - before.mean(0);
    assert!(offset.x != 0.0 && offset.y == 0.0 && offset.z == 0.0, "{offset}");
}

/// At this step the first uniform draw of this clone has all its bits zero; its logarithm must stay finite.
#[test]
fn the_rarest_draw_is_finite() {
    let gpu = gpu();
    let mut before = Host::calm(1);
    before.pull_at(0);
    let (after, report) = before.densify(&gpu, SETTINGS, Round { step: 14_117_035, ..LAST });
    assert_eq!(report.cloned, 1);
    // 5.8 standard deviations: sqrt(2 ln 2^24).
    let distance = after.mean(1).distance(before.mean(0));
    assert!(distance > 0.05 && distance < 0.08, "{distance}");
}

#[test]
fn a_gradient_that_is_nan_or_was_never_seen_multiplies_nothing() {
    let gpu = gpu();
    let mut before = Host::calm(3);
    before.grad_norm_sums = vec![f32::NAN, 1.0, 7e-4];
    before.visit_counts = vec![1, 0, 4];
    let (_, report) = before.densify(&gpu, SETTINGS, LAST);
    assert_eq!(report, DensifyReport { count: 3, ..Default::default() });
}

#[test]
fn growth_beyond_the_limit_goes_to_the_neediest() {
    let gpu = gpu();
    let mut before = Host::calm(10);
    before.parameters[10 * 10] = -9.0;
    for i in 0..10 {
        before.grad_norm_sums[i] = 0.1 * (i * 3 % 10) as f32 + 0.1;
    }
    // Nine stay; their gradients but one's rank as 3, 7, 1, 4, 8, 2, 5, 9, 6 times 0.1 + 0.1.
    let (after, report) =
        before.densify(&gpu, DensifySettings { max_gaussians: 11, ..SETTINGS }, LAST);
    assert_eq!(
        report,
        DensifyReport { cloned: 2, pruned: 1, count: 11, refused: 7, ..Default::default() }
    );
    // Gaussians 3 (rank 9) and 6 (rank 8) have their copies behind them.
    let rows: Vec<_> = (0..11).map(|i| after.row(&after.parameters, i)[3..].to_vec()).collect();
    let twins: Vec<usize> = (0..10).filter(|&i| rows[i] == rows[i + 1]).collect();
    assert_eq!(twins, [2, 6]);
}

#[test]
fn the_limit_holds_where_all_gradients_are_equal_and_where_it_is_passed_already() {
    let gpu = gpu();
    let mut before = Host::calm(100);
    before.grad_norm_sums.fill(0.3);
    for (limit, most) in [(150, 150), (100, 100), (60, 100), (0, 100), (200, 200)] {
        let settings = DensifySettings { max_gaussians: limit, ..SETTINGS };
        let (_, report) = before.densify(&gpu, settings, LAST);
        assert!((100..=most).contains(&report.count), "limit {limit}: {report:?}");
    }
}

#[test]
fn the_same_pass_leaves_the_same_bits_and_another_step_or_seed_other_ones() {
    let gpu = gpu();
    let before = Host::mixed(500);
    let bits = |seed: u64, step: u64| -> Vec<u32> {
        let (after, _) =
            before.densify(&gpu, DensifySettings { seed, ..SETTINGS }, Round { step, ..LAST });
        after.parameters.iter().map(|p| p.to_bits()).collect()
    };
    let first = bits(10, 600);
    assert!(first == bits(10, 600));
    assert!(first != bits(10, 800));
    assert!(first != bits(11, 600));
    // Seeds that differ above 32 bits are other seeds.
    assert!(first != bits(10 | 1 << 40, 600));
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let gpu = gpu();
    for settings in [
        DensifySettings { gradient_threshold: f64::NAN, ..SETTINGS },
        DensifySettings { gradient_threshold: -1.0, ..SETTINGS },
        DensifySettings { split_scale: f64::INFINITY, ..SETTINGS },
        DensifySettings { min_opacity: 1.0, ..SETTINGS },
    ] {
        assert!(Densifier::new(&gpu, settings).is_err(), "{settings:?}");
    }
}

/// A kernel that ran on would read beyond its buffers.
#[test]
fn a_buffer_that_is_too_short_is_refused() {
    let gpu = gpu();
    let mut densifier = Densifier::new(&gpu, SETTINGS).unwrap();
    for (short, columns) in [(0, 14), (1, 14), (2, 14), (3, 14), (4, 14), (5, 13)] {
        let len = |index: usize, len: usize| if index == short { len - 1 } else { len };
        let planes = |index| gpu.zeros("planes", len(index, 28)).unwrap();
        let mut gaussians = DeviceGaussians {
            count: 2,
            column_count: columns,
            feature_count: 0,
            rest: Bits::Single,
            parameters: planes(0),
            moments: Moments::Single { first: planes(1), second: planes(2) },
        };
        let inputs = DensifyInputs {
            grad_norm_sums: &mut gpu.zeros("grad_norm_sums", len(3, 2)).unwrap(),
            visit_counts: &mut gpu.zeros("visit_counts", len(4, 2)).unwrap(),
            gradients: &mut planes(6),
        };
        assert!(densifier.densify(&mut gaussians, inputs, LAST).is_err(), "{short}");
    }
}

#[test]
fn a_gaussian_under_a_large_gradient_is_halved_along_its_longest_axis_whatever_its_size() {
    let gpu = gpu();
    for scale in [0.2_f32, 0.001] {
        let mut before = Host::calm(3);
        before.pull_at(1);
        before.quat_mut(1).fill(0.0);
        before.log_scales_mut(1).copy_from_slice(&[
            (0.5 * scale).ln(),
            scale.ln(),
            (0.1 * scale).ln(),
        ]);
        let (after, report) = before.densify(&gpu, CONSERVING, LAST);
        assert_eq!(report, DensifyReport { split: 1, count: 4, ..Default::default() });
        let offsets = [1, 2].map(|i| after.mean(i) - before.mean(1));
        for offset in offsets {
            assert!((offset.y.abs() - 0.5 * scale).abs() < 1e-3 * scale, "{offset}");
            assert!(offset.x.abs().max(offset.z.abs()) < 1e-6);
        }
        assert!(offsets[0].y * offsets[1].y < 0.0);
        for i in [1, 2] {
            assert!(after.row(&after.first, i).iter().all(|moment| *moment == 0.0));
            let (row, parent) =
                (after.row(&after.parameters, i), before.row(&before.parameters, 1));
            assert_eq!((&row[3..7], &row[11..]), (&parent[3..7], &parent[11..]));
        }
        assert_eq!(before.row(&before.second, 2), after.row(&after.second, 3));
    }
}

#[test]
fn a_round_takes_its_share_of_the_room_and_the_last_one_the_rest() {
    let gpu = gpu();
    let mut before = Host::calm(100);
    for (i, sum) in before.grad_norm_sums.iter_mut().enumerate() {
        *sum = 0.1 + i as f32;
    }
    for (rounds_left, count) in [(1, 130), (2, 115), (4, 108), (30, 101), (1000, 101)] {
        let settings = DensifySettings { max_gaussians: 130, ..CONSERVING };
        let (_, report) = before.densify(&gpu, settings, Round { rounds_left, ..LAST });
        assert_eq!(report.count, count, "{rounds_left} rounds left");
        assert_eq!(report.refused, 200 - count);
    }
}

#[test]
fn growth_ends_where_the_views_leave_no_more_room() {
    let mut before = Host::calm(100);
    for (i, sum) in before.grad_norm_sums.iter_mut().enumerate() {
        *sum = 0.1 + i as f32;
    }
    for (most, count) in [(usize::MAX, 200), (130, 130), (100, 100), (0, 100)] {
        let (_, report) = before.densify(&gpu(), CONSERVING, Round { most, ..LAST });
        assert_eq!((report.count, report.refused), (count, 200 - count), "at most {most}");
    }
}

#[test]
fn buffers_that_suffice_are_kept_and_others_grow_with_headroom() {
    let gpu = gpu();
    let mut host = Host::calm(100);
    (0..10).for_each(|i| host.pull_at(i));
    let plane = |name: &str| gpu.zeros(name, 200 * COLUMNS).unwrap();
    let mut gaussians = room_for(&gpu, 200);
    gaussians.count = 100;
    gpu.write(&mut gaussians.parameters, &host.parameters).unwrap();
    let mut gradients = plane("gradients");
    let mut visit_counts = gpu.buffer("visit_counts", &[1; 300]).unwrap();
    let mut densifier = Densifier::new(&gpu, CONSERVING).unwrap();
    for (pulled, count, capacity) in [(10, 110, 200), (110, 220, 330)] {
        let mut sums = vec![0.0; 300];
        sums[..pulled].fill(1.0);
        let inputs = DensifyInputs {
            grad_norm_sums: &mut gpu.buffer("grad_norm_sums", &sums).unwrap(),
            visit_counts: &mut visit_counts,
            gradients: &mut gradients,
        };
        let report = densifier.densify(&mut gaussians, inputs, LAST).unwrap();
        assert_eq!(report.count, count);
        let DeviceGaussians { parameters, moments, .. } = &gaussians;
        let Moments::Single { first, second } = moments else { panic!("{moments:?}") };
        for buffer in [parameters, first, second, &gradients] {
            assert_eq!(buffer.len(), capacity * COLUMNS);
        }
    }
}
