//! Properties for arbitrary input: curves, cameras, lenses, sort and scan, and files that are written and read back.

use glam::{DMat2, EulerRot};
use nightsplat::splats::sort::{Count, RadixSort, Scan};
use nightsplat_core::camera::{Distortion, TrainingFrame};
use nightsplat_photographs::dataset::LoadOptions;
use nightsplat_photographs::tone::{FAMILIES, Table};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use crate::common::prelude::*;
use crate::formats::synthetic::{self, Model, SIZE};

/// The same cases in every run; a failure prints its input.
fn cases(cases: u32) -> ProptestConfig {
    let (failure_persistence, rng_seed) = (None, RngSeed::Fixed(7));
    ProptestConfig { cases, failure_persistence, rng_seed, ..ProptestConfig::default() }
}

fn position(size: f64) -> impl Strategy<Value = DVec3> {
    [-size..size, -size..size, -size..size].prop_map(DVec3::from_array)
}

fn pose() -> impl Strategy<Value = DAffine3> {
    ([-3.1..3.1, -1.5..1.5, -3.1..3.1], position(10.0)).prop_map(|([a, b, c], translation)| {
        DAffine3::from_rotation_translation(DQuat::from_euler(EulerRot::XYZ, a, b, c), translation)
    })
}

fn camera() -> impl Strategy<Value = Camera> {
    (1..4000_u32, 1..4000_u32, 1.0..5000.0, 1.0..5000.0, pose()).prop_map(
        |(width, height, fx, fy, view_from_world)| Camera {
            width,
            height,
            focal: DVec2::new(fx, fy),
            principal_point: DVec2::new(0.4 * f64::from(width), 0.6 * f64::from(height)),
            model: CameraModel::Pinhole,
            view_from_world,
        },
    )
}

proptest! {
    #![proptest_config(cases(256))]

    #[test]
    fn a_curve_stays_within_0_and_1_and_falls_only_where_its_row_says_so(
        family in 0..FAMILIES.len(), a in 0.0..8.0_f64, step in 0.0..4.0_f64, wild in any::<f64>(),
    ) {
        let family = &FAMILIES[family];
        let settings = ToneSettings::new(family.curve);
        let statistics = settings.plain_statistics();
        let value = |t| settings.value(t, &statistics);
        for t in [a, a + step, wild] {
            prop_assert!((0.0..=1.0).contains(&value(t)), "{}({t}) = {}", family.name, value(t));
        }
        let shape = |t| family.curve.value(t, 0.0, 1.0, &family.defaults());
        prop_assert!(!family.monotone || shape(a + step) >= shape(a) - 1e-12, "{} falls at {a}", family.name);
    }

    #[test]
    fn a_table_interpolates_between_its_neighbours_and_passes_through_its_knots(
        steps in prop::collection::vec((1e-3..1.0_f64, 0.0..1.0_f64), 1..20), at in 0.0..1.2_f64,
    ) {
        let (mut x, mut y, mut text) = (0.0, vec![0.0], "t,y\n0,0\n".to_owned());
        let rise: f64 = steps.iter().map(|(_, rise)| rise).sum::<f64>().max(1e-9);
        let mut knots = vec![0.0];
        for (width, step) in steps {
            x += width;
            knots.push(x);
            y.push((y[y.len() - 1] + step / rise).min(1.0));
            text += &format!("{x},{}\n", y[y.len() - 1]);
        }
        let table = Table::from_csv(&text).map_err(TestCaseError::fail)?;
        for (x, y) in knots.iter().zip(&y) {
            prop_assert!((table.value(*x, 0) - y).abs() < 1e-9, "{text}");
        }
        let (low, high) = (table.value(at * x, 0), table.value(at * x + 1e-3, 0));
        prop_assert!((0.0..=1.0).contains(&low) && high >= low - 1e-12, "{text}");
    }

    #[test]
    fn a_point_that_is_put_behind_a_pixel_appears_at_that_pixel(
        camera in camera(), x in -0.5..1.5_f64, y in -0.5..1.5_f64, depth in 1e-3..1e4_f64,
    ) {
        let pixel = DVec2::new(x * f64::from(camera.width), y * f64::from(camera.height));
        let ray = (pixel - camera.principal_point) / camera.focal;
        let point = camera.view_from_world.inverse().transform_point3((ray * depth).extend(depth));
        let back = camera.project(point);
        // Rounding of a distant point that is seen from close by.
        let bound = 1e-12 * (1.0 + point.length() / depth) * (camera.focal.max_element() + pixel.length()) * 16.0;
        prop_assert!(back.is_some_and(|back| back.distance(pixel) <= bound), "{back:?}, not {pixel}");
        let half = camera.resized(2 * camera.width, 2 * camera.height);
        prop_assert!(half.project(point).is_some_and(|twice| twice.distance(2.0 * pixel) <= 2.0 * bound));
    }

    #[test]
    fn a_frame_shows_the_same_pixels_and_leads_back(
        camera in camera(), center in position(1e6), extent in 1e-6..1e6_f64, at in position(5.0),
    ) {
        let frame = TrainingFrame::new(center, extent);
        let world = center + extent * at;
        let back = frame.unframed(frame.framed(world));
        prop_assert!(back.distance(world) <= 1e-9 * (world.length() + extent), "{back}, not {world}");
        let view_from_world = camera.view_from_world * DAffine3::from_translation(-center);
        let camera = Camera { view_from_world, ..camera };
        let (projected, framed) = (camera.project(world), frame.camera(&camera).project(frame.framed(world)));
        prop_assert_eq!(projected.is_some(), framed.is_some());
        if let Some((projected, framed)) = projected.zip(framed) {
            let depth = camera.view_from_world.transform_point3(world).z;
            let scale = world.length() + extent * 5.0 + 10.0;
            let bound = 1e-13 * scale / depth * (projected.length() + camera.focal.max_element()) + 1e-9;
            prop_assert!(projected.distance(framed) <= 64.0 * bound, "{projected} and {framed}");
        }
    }

    #[test]
    fn the_determinant_of_a_lens_is_that_of_its_differences(
        k in [-0.1..0.1, -0.05..0.05, -0.01..0.01, -0.01..0.01_f64], p in [-0.01..0.01, -0.01..0.01_f64],
        is_fisheye in any::<bool>(), x in -0.7..0.7_f64, y in -0.7..0.7_f64,
    ) {
        let [k1, k2, k3, k4] = k;
        let [p1, p2] = if is_fisheye { [0.0; 2] } else { p };
        let lens = Distortion { k1, k2, k3, k4, p1, p2, is_fisheye, ..Distortion::default() };
        let (at, h) = (DVec2::new(x, y), 1e-6);
        let slope = |by: DVec2| (lens.distort(at + by) - lens.distort(at - by)) / (2.0 * h);
        let differences = DMat2::from_cols(slope(DVec2::X * h), slope(DVec2::Y * h));
        prop_assert!((differences.determinant() - lens.determinant(at)).abs() < 1e-6);
    }
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn keys_are_sorted_stably_and_counts_summed_up_whatever_their_number(
        keys in prop::collection::vec(any::<u32>(), 0..3000), bits in 0..33_u32, left_out in 0..50_usize,
    ) {
        let gpu = gpu();
        let count = keys.len().saturating_sub(left_out);
        let counts = gpu.buffer("counts", &[count as u32]).unwrap();
        let counted = Count { counts: &counts, index: 0 };
        let (mut sort, mut scan) = (RadixSort::new(&gpu, 0).unwrap(), Scan::new(&gpu, 0).unwrap());
        let mut values = gpu.buffer("values", &(0..keys.len() as u32).collect::<Vec<_>>()).unwrap();
        let mut sorted = gpu.buffer("keys", &keys).unwrap();
        let small: Vec<u32> = keys.iter().map(|key| key % 1000).collect();
        let summed = gpu.buffer("summed", &small).unwrap();
        let mut offsets = gpu.uninit("offsets", keys.len()).unwrap();
        let mut total = gpu.uninit("total", 1).unwrap();
        gpu.run("sort", |pass| {
            sort.record(pass, counted, &mut sorted, &mut values, bits)?;
            scan.record(pass, counted, &summed, &mut offsets, &mut total)
        }).unwrap();
        let mask = if bits == 0 { 0 } else { u32::MAX >> (32 - bits) };
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.sort_by_key(|&index| keys[index as usize] & mask);
        prop_assert_eq!(&gpu.read(&values).unwrap()[..count], &order[..]);
        let sums: Vec<u32> = small[..count].iter().scan(0, |sum, value| {
            *sum += value;
            Some(*sum - value)
        }).collect();
        prop_assert_eq!(&gpu.read(&offsets).unwrap()[..count], &sums[..]);
        prop_assert_eq!(gpu.read(&total).unwrap(), [small[..count].iter().sum::<u32>()]);
    }

    #[test]
    fn gaussians_survive_their_ply(
        sh_degree in 0..4_u32, numbers in prop::collection::vec(prop::num::f32::NORMAL | prop::num::f32::ZERO, 59 * 5),
        count in 0..6_usize,
    ) {
        let mut gaussians = Gaussians::zeros(count, sh_degree);
        gaussians.parameters.iter_mut().zip(numbers).for_each(|(parameter, number)| *parameter = number);
        let folder = tempfile::tempdir().unwrap();
        ply::save(&gaussians, folder.path().join("a.ply")).unwrap();
        prop_assert_eq!(ply::load(folder.path().join("a.ply")).unwrap(), gaussians);
    }

    #[test]
    fn a_configuration_is_read_back_from_its_toml(
        steps in 1..u64::from(u32::MAX), seed in 0..i64::MAX as u64, near in 1e-6..1.0_f64, rate in 0.0..1.0_f64,
        max_gaussians in 1..1_000_000_000_usize, vram in 1..1_u64 << 50,
    ) {
        let mut config = TrainConfig { steps, seed, near, max_gaussians, ..TrainConfig::bare() };
        config.max_vram = vram.to_string().parse().ok();
        config.density.min_opacity = 0.99 * rate;
        config.schedule.initial_rates.0[1] = rate;
        let text = config.to_toml().unwrap();
        prop_assert_eq!(TrainConfig::from_toml(&text).unwrap(), config);
    }

    #[test]
    fn poses_and_points_survive_every_layout(
        poses in prop::collection::vec(pose(), 1..5),
        points in prop::collection::vec(position(1e4), 1..8),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let parameters = vec![35.5, 36.25, 18.0, 16.0];
        let image = |(index, pose): (usize, &DAffine3)| (index as u32 + 7, *pose, 3, format!("v{index}.png"));
        let model = Model {
            cameras: vec![(3, "PINHOLE", 1, parameters)],
            images: poses.iter().enumerate().map(image).collect(),
            points: (0..).zip(&points).map(|(id, &at)| (id, at, vec![7])).collect(),
        };
        let json = folder.path().join("json");
        let file = |index| format!("images/v{index}.png");
        let frames =
            poses.iter().enumerate().map(|(index, pose)| synthetic::frame_of(pose, &file(index)));
        let roots = [folder.path().join("binary"), folder.path().join("text"), json];
        for root in &roots {
            for index in 0..poses.len() {
                synthetic::photograph(&root.join(format!("images/v{index}.png")), SIZE, 0.5);
            }
        }
        model.write_binary(&roots[0].join("sparse/0"));
        model.write_text(&roots[1].join("sparse/0"));
        synthetic::write_json(roots[2].join("transforms.json"), &synthetic::transforms(frames.collect()));
        for root in &roots {
            let dataset = loaded(root)?;
            prop_assert_eq!(dataset.views.len(), poses.len());
            for (index, pose) in poses.iter().enumerate() {
                let view = dataset.views.iter().find(|view| view.name == format!("v{index}")).unwrap();
                prop_assert!(view.camera.view_from_world.abs_diff_eq(*pose, 1e-8), "{}", root.display());
            }
            let found: Vec<DVec3> = dataset.points.iter().map(|point| point.position).collect();
            prop_assert!(found.is_empty() == root.ends_with("json"));
            prop_assert!(found.iter().all(|at| points.iter().any(|point| point.abs_diff_eq(*at, 1e-8))));
        }
    }
}

fn loaded(root: &Path) -> Result<Dataset, TestCaseError> {
    let options = LoadOptions { test_every: Some(0), ..LoadOptions::default() };
    Dataset::load(root, &options).map_err(|error| TestCaseError::fail(error.to_string()))
}
