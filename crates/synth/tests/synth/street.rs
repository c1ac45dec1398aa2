//! The synthetic street: its light falls along it, and a view sees a part of it.

use nightsplat_photographs::dataset::{Dataset, Split};
use nightsplat_synth::{DARKENING, SyntheticOptions};

use crate::common::Folder;
use crate::{image, light, loaded, written};

/// The plots of the street.
const PLOTS: u32 = 12;

fn street(plots: u32) -> Folder {
    let street = SyntheticOptions::street(plots);
    written(&SyntheticOptions { width: 64, height: 48, seed: 3, ..street })
}

/// The share of views with at least `least` of their points between two places along the street.
fn share_of_views(dataset: &Dataset, from: f64, to: f64, least: f64) -> f64 {
    let mut counts = vec![[0.0; 2]; dataset.views.len()];
    for point in &dataset.points {
        for &view in &point.views {
            counts[view as usize][0] += f64::from((from..to).contains(&point.position.x));
            counts[view as usize][1] += 1.0;
        }
    }
    let sees = counts.iter().filter(|[inside, all]| *inside >= least * all).count();
    sees as f64 / counts.len() as f64
}

#[test]
fn half_a_street_is_seen_by_little_more_than_half_of_its_views_and_a_quarter_by_a_third() {
    let dataset = loaded(&street(24));
    assert_eq!(dataset.views.len(), 144);
    for (parts, most) in [(2, 0.60), (4, 0.36)] {
        let length = 24.0 / f64::from(parts);
        let shares = (0..parts).map(|part| {
            let from = f64::from(part) * length;
            share_of_views(&dataset, from, from + length, 0.15)
        });
        let mean = shares.sum::<f64>() / f64::from(parts);
        assert!((1.0 / f64::from(parts)..most).contains(&mean), "{parts} parts: {mean}");
    }
}

#[test]
fn every_part_of_the_street_has_points_that_many_views_see() {
    let dataset = loaded(&street(PLOTS));
    for plot in 0..PLOTS {
        let plot = f64::from(plot);
        let of_part =
            dataset.points.iter().filter(|point| (plot..plot + 1.0).contains(&point.position.x));
        let tracks: Vec<usize> = of_part.map(|point| point.views.len()).collect();
        let views = tracks.iter().sum::<usize>() as f64 / tracks.len() as f64;
        assert!(
            tracks.len() > 150 && views > 5.0,
            "plot {plot}: {} points, {views} views",
            tracks.len()
        );
    }
}

#[test]
fn the_light_falls_eightfold_and_that_of_the_references_does_not() {
    let dir = street(PLOTS);
    let mean = |folder: &str, view: usize| light(&image(&dir, &format!("{folder}/{view:03}.png")));
    let views = 6 * PLOTS as usize;
    let factor = |view: usize| mean("high", view) / mean("low", view);
    for view in (0..views).step_by(5) {
        let at = (view as f64 + 0.5) / views as f64;
        let expected = DARKENING * 8_f64.powf(at - 0.5);
        let ratio = factor(view) / expected;
        assert!((0.8..1.25).contains(&ratio), "view {view}: {ratio}");
    }
    let ends = [0, views - 9].map(|first| (first..first + 9).map(|view| mean("high", view)).sum());
    let [first, last]: [f64; 2] = ends;
    assert!((0.7..1.4).contains(&(last / first)), "{first} {last}");
}

#[test]
fn every_eighth_view_is_a_test_view_and_they_are_all_along_the_street_and_in_every_lane() {
    let dataset = loaded(&street(PLOTS));
    let centers = dataset.test_views().map(|view| view.camera.center());
    let centers: Vec<_> = centers.collect();
    assert_eq!(centers.len(), 9);
    assert!(
        dataset
            .views
            .iter()
            .enumerate()
            .all(|(index, view)| { (view.split == Split::Test) == (index % 8 == 0) })
    );
    for lane in [-1.0, 0.0, 1.0] {
        let in_lane = centers.iter().filter(|center| (center.y - 1.15 * lane).abs() < 0.2).count();
        assert_eq!(in_lane, 3, "lane {lane}");
    }
    assert!(centers[0].x < 0.5 && centers[8].x > 10.0, "{centers:?}");
}
