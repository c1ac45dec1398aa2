//! The synthetic sets whose cameras carry a lamp.

use std::path::Path;

use nightsplat_photographs::image::{Image, linear_from_srgb};
use nightsplat_synth::{Capture, SyntheticOptions};

use crate::{captured, image, loaded, written};

fn set() -> SyntheticOptions {
    let lamp = Some(16.0);
    SyntheticOptions { views: 17, width: 80, height: 60, seed: 2, lamp, ..Default::default() }
}

fn street() -> SyntheticOptions {
    SyntheticOptions { width: 80, height: 60, ..SyntheticOptions::street(3) }
}

fn green(image: &Image) -> Vec<f64> {
    let pixels = (0..image.width * image.height).map(|i| (i % image.width, i / image.width));
    pixels.map(|(x, y)| f64::from(linear_from_srgb(image.pixel(x, y)[1]))).collect()
}

/// The irradiance of the pixels of a test view in stops below the reference's light, ascending.
fn stops(folder: &Path, view: &str) -> Vec<f64> {
    let [lit, even] = ["lit", "high"].map(|of| green(&image(folder, &format!("{of}/{view}.png"))));
    let pairs = lit.into_iter().zip(even).filter(|&(_, even)| even > 0.02 && even < 1.0);
    let mut stops: Vec<f64> = pairs.map(|(lit, even)| (lit.max(1e-4) / even).log2()).collect();
    stops.sort_unstable_by(f64::total_cmp);
    stops
}

#[test]
fn a_view_is_lit_over_about_six_stops() {
    let folder = captured(&set(), &Capture::clean());
    let street = captured(&SyntheticOptions { lamp: Some(16.0), ..street() }, &Capture::clean());
    for (folder, views) in [(&folder, ["000", "008", "016"]), (&street, ["000", "008", "016"])] {
        let spread = views.map(|view| {
            let stops = stops(folder, view);
            stops[stops.len() - 1 - stops.len() / 200] - stops[stops.len() / 200]
        });
        println!("{spread:?}");
        let mean = spread.iter().sum::<f64>() / 3.0;
        assert!((5.0..7.5).contains(&mean), "{spread:?}");
    }
}

#[test]
fn a_lit_test_view_is_what_its_photograph_would_be_without_darkening_and_noise() {
    let folder = captured(&set(), &Capture::clean());
    for view in ["000", "008", "016"] {
        let [low, lit] = ["low", "lit"].map(|of| image(&folder, &format!("{of}/{view}.png")));
        assert!(low.data == lit.data, "{view}");
        let mean = lit.data.iter().sum::<f32>() / lit.data.len() as f32;
        assert!((0.2..0.6).contains(&mean), "{view}: {mean}");
        let white = lit.data.iter().filter(|&&value| value >= 1.0).count();
        assert!(white < lit.data.len() / 50, "{view}: {white} values are white");
    }
    assert!(!folder.join("lit/001.png").exists());
    let dark = written(&set());
    for view in ["000", "008"] {
        let [low, lit] = ["low", "lit"].map(|of| green(&image(&dark, &format!("{of}/{view}.png"))));
        let [low, lit] = [low, lit].map(|light| light.iter().sum::<f64>());
        assert!(
            (lit / low / nightsplat_synth::DARKENING - 1.0).abs() < 0.1,
            "{view}: {}",
            lit / low
        );
    }
}

/// A reference is the reflectance of the surfaces times one number: neither the lamp nor the scene's own light, whose
/// shadows no photograph shows, is in it.
#[test]
fn the_references_are_in_even_light() {
    for set in [set(), SyntheticOptions { lamp: Some(16.0), ..street() }] {
        let [narrow, wide] =
            [Some(16.0), Some(30.0)].map(|lamp| written(&SyntheticOptions { lamp, ..set }));
        let without = written(&SyntheticOptions { lamp: None, ..set });
        assert!(!without.join("lit").exists());
        for view in ["000", "007"] {
            let [a, b, unlit] =
                [&narrow, &wide, &without].map(|set| image(set, &format!("high/{view}.png")));
            assert!(a.data == b.data, "{view}");
            // Shading and shadows make the darkest surfaces darker.
            let dark = |image: &Image| green(image).into_iter().filter(|&x| x < 0.03).count();
            assert!(dark(&a) < dark(&unlit), "{view}: {} pixels, {}", dark(&a), dark(&unlit));
        }
    }
}

#[test]
fn a_point_is_brighter_from_nearby_and_on_the_axis() {
    let set = captured(&SyntheticOptions { lamp: Some(30.0), ..set() }, &Capture::clean());
    let dataset = loaded(&set);
    let images: Vec<Image> =
        (dataset.views.iter()).map(|view| image(&set, &format!("low/{}.png", view.name))).collect();
    let (mut as_expected, mut pairs) = (0, 0);
    for point in &dataset.points {
        let seen = point.views.iter().filter_map(|&view| {
            let camera = &dataset.views[view as usize].camera;
            let pixel = camera.project(point.position)?;
            let [x, y] = [pixel.x as u32, pixel.y as u32];
            let image = &images[view as usize];
            let light = (x < image.width && y < image.height).then(|| image.pixel(x, y)[1])?;
            let in_view = camera.view_from_world.transform_point3(point.position);
            Some((light, in_view.length(), in_view.z / in_view.length()))
        });
        let seen: Vec<_> = seen.collect();
        for (a, b) in seen.iter().flat_map(|a| seen.iter().map(move |b| (a, b))) {
            if a.1 < 0.8 * b.1 && a.2 >= b.2 {
                pairs += 1;
                as_expected += u32::from(a.0 > b.0);
            }
        }
    }
    assert!(pairs > 1000, "{pairs}");
    assert!(f64::from(as_expected) > 0.9 * f64::from(pairs), "{as_expected} of {pairs}");
}
