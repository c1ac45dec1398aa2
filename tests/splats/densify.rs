//! Density control: the kernels against their references, the outcome for each kind of Gaussian, the limit, the edge
//! cases.

mod host;

use glam::Quat;
use nightsplat::splats::densify::{
    Densifier, DensifyInputs, DensifyReport, DensifySettings, DensityControl, Round,
};
use nightsplat::splats::device::DeviceGaussians;

use host::{COLUMNS, CONSERVING, Host, LAST, SETTINGS, camera_at, room_for, shape};

use crate::common::prelude::*;

#[test]
fn density_control_matches_its_references() {
    let gpu = gpu();
    let limited = DensifySettings { max_gaussians: 1100, ..CONSERVING };
    let sizes = [0, 1, 2, 63, 64, 65, 1000];
    let opaque = DensifySettings { min_opacity: 0.4, ..CONSERVING };
    let cases = [SETTINGS, CONSERVING, limited, opaque];
    let cases = cases.into_iter().flat_map(|s| sizes.map(|n| (s, n)));
    let cameras = [DVec3::new(0.3, -0.2, 0.6), DVec3::new(-0.9, 0.4, -0.3)].map(camera_at);
    for (settings, count) in cases {
        let before = Host::mixed(count);
        let round = Round { rounds_left: 3, ..LAST };
        let ((_, report), passes) =
            gpu.checked(|| before.densify_seen_from(&cameras, settings, round));
        passes.agree().unwrap_or_else(|error| panic!("{count} Gaussians, {settings:?}: {error}"));
        for kernel in ["densify_score", "densify_decide", "densify_scatter", "densify_moments"] {
            let ran = passes.passes.iter().any(|pass| pass.kernel == kernel);
            assert!(ran || count == 0, "{count} Gaussians: no {kernel}");
        }
        if settings == SETTINGS && count == 1000 {
            assert!(report.cloned > 100 && report.split > 50 && report.pruned > 100, "{report:?}");
        }
    }
}

#[test]
fn a_small_gaussian_with_a_large_gradient_is_cloned() {
    let mut before = Host::calm(3);
    before.pull_at(1);
    let (after, report) = before.densify(SETTINGS, LAST);
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
    assert!(distance > 0.0 && distance < 0.06, "{distance}: not a sample at scale 0.01");
    assert!(
        after.row(&after.first, 2).iter().chain(&after.row(&after.second, 2)).all(|m| *m == 0.0)
    );
}

#[test]
fn a_large_gaussian_with_a_large_gradient_is_split_into_two_smaller_ones() {
    let mut before = Host::calm(2);
    before.pull_at(0);
    before.log_scales_mut(0).copy_from_slice(&[0.2f32.ln(), 0.1f32.ln(), 0.01f32.ln()]);
    let (after, report) = before.densify(SETTINGS, LAST);
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
fn sampled_positions_have_the_covariance_of_their_parent() {
    let count = 4000;
    let mut before = Host::calm(count);
    let rotation = Quat::from_euler(glam::EulerRot::XYZ, 0.3, 0.7, -0.4);
    let scales = Vec3::new(0.04, 0.02, 0.005);
    for i in 0..count {
        before.pull_at(i);
        // Twice unit length: stored quaternions are not normalised.
        let [x, y, z, w] = (rotation * 2.0).to_array();
        before.quat_mut(i).copy_from_slice(&[w, x, y, z]);
        before.log_scales_mut(i).copy_from_slice(&scales.to_array().map(f32::ln));
    }
    let (after, report) = before.densify(SETTINGS, LAST);
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
fn a_faint_gaussian_is_pruned_even_if_its_gradient_is_large() {
    let mut before = Host::calm(3);
    before.parameters[10 * 3 + 1] = -5.4;
    before.pull_at(1);
    let (after, report) = before.densify(SETTINGS, LAST);
    assert_eq!(report, DensifyReport { pruned: 1, count: 2, ..Default::default() });
    assert_eq!(after.row(&after.first, 1), before.row(&before.first, 2));
}

#[test]
fn all_gaussians_can_be_pruned() {
    let mut before = Host::calm(70);
    before.parameters[10 * 70..11 * 70].fill(-9.0);
    let (after, report) = before.densify(SETTINGS, LAST);
    assert_eq!(report, DensifyReport { pruned: 70, ..Default::default() });
    assert_eq!(after.count, 0);
}

#[test]
fn a_gaussian_that_is_not_finite_is_pruned() {
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
        let (after, report) = before.densify(SETTINGS, LAST);
        assert_eq!(
            (report.pruned, report.count - report.cloned),
            (1, 4),
            "column {column}: {report:?}"
        );
        assert!(after.parameters.iter().all(|p| p.is_finite()));
    }
}

#[test]
fn a_quaternion_of_zero_length_samples_along_the_axes() {
    let mut before = Host::calm(1);
    before.pull_at(0);
    before.quat_mut(0).fill(0.0);
    before.log_scales_mut(0).copy_from_slice(&[0.04f32.ln(), -30.0, -30.0]);
    let (after, _) = before.densify(SETTINGS, LAST);
    let offset = after.mean(1) - before.mean(0);
    assert!(offset.x != 0.0 && offset.y == 0.0 && offset.z == 0.0, "{offset}");
}

/// At this step the first uniform sample of this clone has all its bits zero; its logarithm must stay finite.
#[test]
fn a_sample_of_all_zero_bits_is_finite() {
    let mut before = Host::calm(1);
    before.pull_at(0);
    let (after, report) = before.densify(SETTINGS, Round { step: 14_117_035, ..LAST });
    assert_eq!(report.cloned, 1);
    // 5.8 standard deviations: sqrt(2 ln 2^24).
    let distance = after.mean(1).distance(before.mean(0));
    assert!(distance > 0.05 && distance < 0.08, "{distance}");
}

#[test]
fn a_gaussian_without_a_finite_gradient_is_not_cloned_or_split() {
    let mut before = Host::calm(3);
    before.grad_norm_sums = vec![f32::NAN, 1.0, 7e-4];
    before.visit_counts = vec![1, 0, 4];
    let (_, report) = before.densify(SETTINGS, LAST);
    assert_eq!(report, DensifyReport { count: 3, ..Default::default() });
}

#[test]
fn growth_up_to_the_limit_goes_to_the_largest_gradients() {
    let mut before = Host::calm(10);
    before.parameters[10 * 10] = -9.0;
    for i in 0..10 {
        before.grad_norm_sums[i] = 0.1 * (i * 3 % 10) as f32 + 0.1;
    }
    // Nine remain; the gradients of all but one rank as 3, 7, 1, 4, 8, 2, 5, 9, 6 times 0.1 + 0.1.
    let (after, report) = before.densify(DensifySettings { max_gaussians: 11, ..SETTINGS }, LAST);
    assert_eq!(
        report,
        DensifyReport { cloned: 2, pruned: 1, count: 11, refused: 7, ..Default::default() }
    );
    // The copies of Gaussians 3 (rank 9) and 6 (rank 8) follow them.
    let rows: Vec<_> = (0..11).map(|i| after.row(&after.parameters, i)[3..].to_vec()).collect();
    let twins: Vec<usize> = (0..10).filter(|&i| rows[i] == rows[i + 1]).collect();
    assert_eq!(twins, [2, 6]);
}

#[test]
fn the_limit_applies_with_equal_gradients_and_when_it_is_already_exceeded() {
    let mut before = Host::calm(100);
    before.grad_norm_sums.fill(0.3);
    for (limit, most) in [(150, 150), (100, 100), (60, 100), (0, 100), (200, 200)] {
        let settings = DensifySettings { max_gaussians: limit, ..SETTINGS };
        let (_, report) = before.densify(settings, LAST);
        assert!((100..=most).contains(&report.count), "limit {limit}: {report:?}");
    }
}

#[test]
fn the_same_pass_gives_the_same_bits_and_another_step_or_seed_gives_others() {
    let before = Host::mixed(500);
    let bits = |seed: u64, step: u64| -> Vec<u32> {
        let (after, _) =
            before.densify(DensifySettings { seed, ..SETTINGS }, Round { step, ..LAST });
        after.parameters.iter().map(|p| p.to_bits()).collect()
    };
    let first = bits(10, 600);
    assert!(first == bits(10, 600));
    assert!(first != bits(10, 800));
    assert!(first != bits(11, 600));
    // Seeds that differ only above bit 32 are different seeds, even if the lower bits are set.
    assert!(first != bits(10 | 1 << 40, 600));
    assert!(first != bits(10 | 10 << 32, 600));
}

#[test]
fn a_density_control_is_parsed_from_its_name() {
    for (name, control) in
        [("conserving", DensityControl::Conserving), ("paper", DensityControl::Paper)]
    {
        assert_eq!(name.parse::<DensityControl>().unwrap(), control);
    }
    let refused = "Paper".parse::<DensityControl>().unwrap_err().to_string();
    assert_eq!(refused, "unknown density control `Paper`; conserving or paper");
}

#[test]
fn invalid_settings_are_refused() {
    let gpu = gpu();
    for settings in [
        DensifySettings { gradient_threshold: f64::NAN, ..SETTINGS },
        DensifySettings { gradient_threshold: -1.0, ..SETTINGS },
        DensifySettings { split_scale: f64::INFINITY, ..SETTINGS },
        DensifySettings { min_opacity: 1.0, ..SETTINGS },
    ] {
        assert!(Densifier::new(&gpu, settings, &[]).is_err(), "{settings:?}");
    }
}

/// A kernel that ran anyway would read out of bounds.
#[test]
fn a_buffer_that_is_too_short_is_refused() {
    let gpu = gpu();
    let mut densifier = Densifier::new(&gpu, SETTINGS, &[]).unwrap();
    let needs = |has, needed| format!("holds {has} elements, not {needed}");
    for (short, why) in [
        (0, needs(27, 28)),
        (1, needs(27, 28)),
        (2, needs(27, 28)),
        (3, needs(1, 2)),
        (4, needs(1, 2)),
    ] {
        let len = |index: usize, len: usize| if index == short { len - 1 } else { len };
        let planes = |index| gpu.zeros("planes", len(index, 28)).unwrap();
        let layout = Layout::new(2, 0, StorageFormat::Single);
        let (parameters, origin) = (planes(0), DVec3::ZERO);
        let mut gaussians = DeviceGaussians { layout, parameters, origin, bounds: None };
        let mut moments = Moments::Single { first: planes(1), second: planes(2) };
        let inputs = DensifyInputs {
            moments: &mut moments,
            grad_norm_sums: &mut gpu.zeros("grad_norm_sums", len(3, 2)).unwrap(),
            visit_counts: &mut gpu.zeros("visit_counts", len(4, 2)).unwrap(),
            gradients: &mut planes(6),
        };
        let refused =
            densifier.densify(&mut gaussians, inputs, LAST, |_| Ok(1.0)).unwrap_err().to_string();
        assert!(refused.contains(&why), "{short}: {refused}");
    }
}

#[test]
fn a_gaussian_with_a_large_gradient_of_any_size_is_split_along_its_longest_axis() {
    for scale in [0.2_f32, 0.001] {
        let mut before = Host::calm(3);
        before.pull_at(1);
        before.quat_mut(1).fill(0.0);
        before.log_scales_mut(1).copy_from_slice(&[
            (0.5 * scale).ln(),
            scale.ln(),
            (0.1 * scale).ln(),
        ]);
        let (after, report) = before.densify(CONSERVING, LAST);
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
fn a_round_uses_its_share_of_the_remaining_gaussians_and_the_last_round_uses_the_rest() {
    let before = Host::ranked(100);
    for (rounds_left, count) in [(1, 130), (2, 115), (4, 108), (30, 101), (1000, 101)] {
        let settings = DensifySettings { max_gaussians: 130, ..CONSERVING };
        let (_, report) = before.densify(settings, Round { rounds_left, ..LAST });
        assert_eq!(report.count, count, "{rounds_left} rounds left");
        assert_eq!(report.refused, 200 - count);
    }
}

#[test]
fn growth_stops_at_the_limit_that_the_views_set() {
    let before = Host::ranked(100);
    for (most, count) in [(usize::MAX, 200), (130, 130), (100, 100), (0, 100)] {
        let (_, report) = before.densify(CONSERVING, Round { most, ..LAST });
        assert_eq!((report.count, report.refused), (count, 200 - count), "at most {most}");
    }
}

#[test]
fn large_enough_buffers_are_kept_and_others_grow_with_headroom() {
    let gpu = gpu();
    let mut host = Host::calm(100);
    (0..10).for_each(|i| host.pull_at(i));
    let plane = |name: &str| gpu.zeros(name, 200 * COLUMNS).unwrap();
    let mut gaussians = room_for(200);
    gaussians.layout.count = 100;
    let mut moments =
        Moments::Single { first: plane("first_moments"), second: plane("second_moments") };
    gpu.write(&mut gaussians.parameters, &host.parameters).unwrap();
    let mut gradients = plane("gradients");
    let mut visit_counts = gpu.buffer("visit_counts", &[1; 300]).unwrap();
    let mut densifier = Densifier::new(&gpu, CONSERVING, &[]).unwrap();
    for (pulled, count, capacity) in [(10, 110, 200), (110, 220, 330)] {
        let mut sums = vec![0.0; 300];
        sums[..pulled].fill(1.0);
        let inputs = DensifyInputs {
            moments: &mut moments,
            grad_norm_sums: &mut gpu.buffer("grad_norm_sums", &sums).unwrap(),
            visit_counts: &mut visit_counts,
            gradients: &mut gradients,
        };
        let report = densifier.densify(&mut gaussians, inputs, LAST, |_| Ok(1.0)).unwrap();
        assert_eq!(report.count, count);
        let Moments::Single { first, second } = &moments else { panic!("{moments:?}") };
        for buffer in [&gaussians.parameters, first, second, &gradients] {
            assert_eq!(buffer.len(), capacity * COLUMNS);
        }
    }
}

#[test]
fn a_refused_round_is_retried_with_fewer_splits_and_finally_with_none() {
    let mut before = Host::ranked(100);
    before.parameters[10 * 100] = -9.0;
    let round =
        |keeps: &mut dyn FnMut(usize) -> f64| before.densify_as_kept(&[], CONSERVING, LAST, keeps);
    let mut tried = vec![];
    let (after, report) = round(&mut |count| {
        tried.push(count);
        if count > 120 { 0.3 } else { 1.0 }
    });
    // 99 splits, then three tenths of them, then three tenths of those.
    assert_eq!(tried, [198, 99 + 29, 99 + 8]);
    assert_eq!((report.split, report.pruned, report.count), (8, 1, 107));
    // The largest gradients remain, and nothing that a refused attempt wrote is left.
    let limited = DensifySettings { max_gaussians: 107, ..CONSERVING };
    assert_eq!(after, before.densify(limited, LAST).0);
    let mut tried = 0;
    let (_, report) = round(&mut |_| {
        tried += 1;
        0.9
    });
    assert_eq!((tried, report.split, report.pruned, report.count), (4, 0, 1, 99));
}

/// A Gaussian in front of a camera at the origin.
fn in_depth(opacity: f32, scales: [f32; 3]) -> Host {
    let mut host = Host::calm(1);
    host.pull_at(0);
    host.parameters[..3].copy_from_slice(&[0.0, 0.0, 3.0]);
    host.quat_mut(0).copy_from_slice(&[1.0, 0.0, 0.0, 0.0]);
    host.log_scales_mut(0).copy_from_slice(&scales.map(f32::ln));
    host.parameters[10] = (opacity / (1.0 - opacity)).ln();
    host
}

#[test]
fn a_gaussian_whose_halves_would_look_different_to_a_camera_is_not_split() {
    let cameras = [DVec3::new(90.0, 0.0, 0.0), DVec3::ZERO].map(camera_at);
    for (opacity, scales, split) in [
        // Wide in depth: decided by its coverage and opacity.
        (0.9, [0.3, 0.3, 1.0], 0),
        (0.9, [0.01, 0.01, 1.0], 1),
        (0.01, [0.3, 0.3, 1.0], 1),
        (0.9, [0.3, 0.3, 400.0], 0),
        // As wide across the view: its halves look the same.
        (0.9, [1.0, 0.3, 0.3], 1),
    ] {
        let before = in_depth(opacity, scales);
        let round = |settings, cameras: &[Camera]| {
            before.densify_seen_from(cameras, settings, LAST).1.split
        };
        assert_eq!(round(CONSERVING, &cameras), split, "{opacity} {scales:?}");
        // For the first camera it is far out of view, unless it is everywhere.
        assert_eq!(round(CONSERVING, &cameras[..1]), u32::from(scales[2] < 400.0) as usize);
        assert_eq!((round(CONSERVING, &[]), round(SETTINGS, &cameras)), (1, 1));
    }
}

/// The largest change by splits within the bound, and the change by splits beyond it.
#[test]
fn a_split_within_the_bound_changes_every_view_only_a_little() {
    let gpu = gpu();
    let camera = camera_at(DVec3::ZERO);
    let settings = RenderSettings { shape: shape(), ..RenderSettings::default() };
    let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
    let mut renderer = Renderer::new(&gpu, settings).unwrap();
    let mut image = |host: &Host| {
        let mut planes = room_for(host.count);
        planes.write(&gpu, &host.parameters).unwrap();
        renderer.reserve(host.count, [&camera]).unwrap();
        renderer.render_image(&planes, &camera, &options).unwrap().data
    };
    let mut mean_square = |before: &Host, cameras: &[Camera]| {
        let (after, report) = before.densify_seen_from(cameras, CONSERVING, LAST);
        let (before, after) = (image(before), image(&after));
        let squares = before.iter().zip(&after).map(|(a, b)| f64::from(a - b).powi(2));
        (report.split, squares.sum::<f64>() / before.len() as f64)
    };
    let (mut max_passed, mut max_refused) = (0.0_f64, 0.0_f64);
    for opacity in [0.05, 0.3, 0.9] {
        for across in [0.02_f32, 0.1, 0.5, 2.0] {
            for depth in [0.5_f32, 1.0, 2.0, 4.0] {
                let before =
                    in_depth(opacity, [across.min(0.9 * depth), 0.7 * across.min(depth), depth]);
                let (split, passed) = mean_square(&before, &[camera]);
                let (_, unguarded) = mean_square(&before, &[]);
                assert_eq!(passed, if split == 1 { unguarded } else { 0.0 });
                if split == 1 {
                    max_passed = max_passed.max(passed);
                } else {
                    max_refused = max_refused.max(unguarded);
                }
            }
        }
    }
    // 30 dB correspond to a mean squared error of 1e-3; a tenth of a decibel is 2e-5 of it.
    assert!(max_passed < 2e-4, "{max_passed}");
    assert!(max_refused > 1e-2, "{max_refused}");
}
