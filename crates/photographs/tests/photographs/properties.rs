//! Properties for arbitrary input: curves, and datasets that are written and read back.

use std::path::Path;

use glam::{DAffine3, DVec3};
use nightsplat_photographs::dataset::{Dataset, LoadOptions};
use nightsplat_photographs::tone::{FAMILIES, Table, ToneSettings};
use proptest::prelude::*;

use crate::arbitrary::{cases, pose, position};
use crate::common::Folder;
use crate::formats::synthetic::{self, Model, SIZE};

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
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn poses_and_points_survive_every_layout(
        poses in prop::collection::vec(pose(), 1..5),
        points in prop::collection::vec(position(1e4), 1..8),
    ) {
        let folder = Folder::empty();
        let parameters = vec![35.5, 36.25, 18.0, 16.0];
        let image = |(index, pose): (usize, &DAffine3)| (index as u32 + 7, *pose, 3, format!("v{index}.png"));
        let model = Model {
            cameras: vec![(3, "PINHOLE", 1, parameters)],
            images: poses.iter().enumerate().map(image).collect(),
            points: (0..).zip(&points).map(|(id, &at)| (id, at, vec![7])).collect(),
        };
        let json = folder.join("json");
        let file = |index| format!("images/v{index}.png");
        let frames =
            poses.iter().enumerate().map(|(index, pose)| synthetic::frame_of(pose, &file(index)));
        let roots = [folder.join("binary"), folder.join("text"), json];
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
