//! A lamp that moves with the camera is told apart from everything else that makes a point differ between its views.

use std::fs;
use std::path::Path;

use nightsplat_diagnose::{Diagnosis, LampDiagnosis, SceneDiagnosis};
use nightsplat_photographs::dataset::{Dataset, LoadOptions};
use nightsplat_synth::{Capture, SyntheticOptions};
use serde_json::Value;

use crate::sets::{captured, lamp_set, relit, varying, written};

fn scene(folder: &Path) -> SceneDiagnosis {
    let options = LoadOptions::default();
    Diagnosis::new(&Dataset::load(folder, &options).unwrap(), &options).unwrap().scene
}

fn lamp_of(options: &SyntheticOptions, capture: &Capture) -> LampDiagnosis {
    let scene = scene(&captured(options, capture));
    scene.lamp.unwrap_or_else(|| panic!("{:?}", scene.lamp_unknown))
}

/// A pixel's distance from the middle, 0 to 1 in a corner.
fn off([x, y]: [u32; 2]) -> f64 {
    (f64::from(x) - 48.0).hypot(f64::from(y) - 36.0) / 60.0
}

#[test]
fn a_lamp_alone_is_found_and_has_the_inverse_square_law() {
    for (seed, degrees) in [(1, 16.0), (2, 30.0)] {
        let lamp =
            lamp_of(&SyntheticOptions { seed, ..lamp_set(Some(degrees)) }, &Capture::default());
        println!("{degrees}: {lamp:?}");
        assert!(lamp.is_found(), "{lamp:?}");
        assert!((lamp.exponent - 2.0).abs() < 0.5, "{lamp:?}");
        assert!(lamp.lamp_r_squared > 0.5 && lamp.exposure_spread < 0.2, "{lamp:?}");
        // Half the light at the angle of half the light.
        let u = 1.0 - degrees.to_radians().cos();
        let half = (-lamp.falloff[0] * u - lamp.falloff[1] * u * u).exp();
        assert!((half - 0.5).abs() < 0.15, "{half} at {degrees} degrees: {lamp:?}");
        assert!((2.0..4.0).contains(&lamp.d_ref) && lamp.ambient < 0.1, "{lamp:?}");
    }
}

#[test]
fn a_lamp_with_other_exposures_is_found_beside_them() {
    let lamp = lamp_of(&lamp_set(Some(16.0)), &varying());
    println!("{lamp:?}");
    assert!(lamp.is_found() && (lamp.exponent - 2.0).abs() < 0.5, "{lamp:?}");
    assert!(lamp.r_squared > lamp.lamp_r_squared + 0.2, "{lamp:?}");
    assert!((lamp.exposure_spread - 0.65).abs() < 0.15, "{lamp:?}");
}

#[test]
fn exposures_alone_are_no_lamp() {
    let lamp = lamp_of(&lamp_set(None), &varying());
    println!("{lamp:?}");
    assert!(!lamp.is_found() && lamp.stops < 0.1, "{lamp:?}");
    assert!(lamp.exposure_r_squared > 0.8, "{lamp:?}");
}

#[test]
fn noise_alone_is_no_lamp() {
    for (seed, full_well) in [(1, 9000.0), (2, 900.0), (3, 200.0)] {
        let grainy = Capture { full_well, ..Capture::default() };
        let scene = scene(&captured(&SyntheticOptions { seed, ..lamp_set(None) }, &grainy));
        println!("{:?} {:?}", scene.lamp, scene.lamp_unknown);
        let lamp = scene.lamp.filter(|lamp| lamp.is_found() || lamp.stops > 0.1);
        assert_eq!(lamp, None);
    }
}

#[test]
fn light_that_falls_on_a_place_is_no_lamp() {
    // The light of this street falls eightfold from one end to the other.
    let street = SyntheticOptions::street(4);
    let lamp = lamp_of(&street, &Capture::default());
    println!("{lamp:?}");
    assert!(!lamp.is_found() && lamp.stops < 0.1, "{lamp:?}");
    let lit = lamp_of(&SyntheticOptions { lamp: Some(16.0), ..street }, &Capture::default());
    println!("{lit:?}");
    assert!(lit.is_found(), "{lit:?}");
}

#[test]
fn a_vignette_is_no_lamp() {
    let folder = written(&lamp_set(None));
    relit(&folder, |_, at, light| light * (-2.0 * off(at) * off(at)).exp2());
    let lamp = scene(&folder).lamp.unwrap();
    println!("{lamp:?}");
    assert!(lamp.stops > 0.15, "the vignette is to be seen: {lamp:?}");
    assert!(!lamp.is_found() && lamp.distance_stops < 0.08, "{lamp:?}");
}

#[test]
fn clipped_photographs_few_views_and_one_position_measure_no_lamp() {
    let unknown = |folder: &Path, why: &str| {
        let scene = scene(folder);
        assert_eq!(scene.lamp, None);
        let told = scene.lamp_unknown.unwrap();
        assert!(told.contains(why), "{told}");
    };
    let folder = written(&lamp_set(Some(16.0)));
    let path = folder.join("transforms_train.json");
    let whole = fs::read(&path).unwrap();
    let list = || -> Value { serde_json::from_slice(&whole).unwrap() };

    let mut fewer = list();
    fewer["frames"].as_array_mut().unwrap().truncate(4);
    fs::write(&path, fewer.to_string()).unwrap();
    unknown(&folder, "in 4 views");

    fs::write(&path, &whole).unwrap();
    relit(&folder, |_, _, light| 1e4 * light);
    unknown(&folder, "are unclipped");

    let folder = written(&lamp_set(Some(16.0)));
    let path = folder.join("transforms_train.json");
    let points = Dataset::load(&folder, &LoadOptions::default()).unwrap().points;
    fs::remove_dir_all(folder.join("colmap_sparse")).unwrap();
    unknown(&folder, "0 points in 0 views");
    let mut still = list();
    let pose = still["frames"][0]["transform_matrix"].clone();
    for frame in still["frames"].as_array_mut().unwrap() {
        frame["transform_matrix"] = pose.clone();
    }
    fs::write(&path, still.to_string()).unwrap();
    let lines: String = points
        .iter()
        .map(|point| point.position.to_array())
        .fold(String::new(), |lines, [x, y, z]| lines + &format!("{x} {y} {z}\n"));
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        points.len()
    );
    fs::write(folder.join("points3D.ply"), header + &lines).unwrap();
    unknown(&folder, "differ by 0.0 %");
}
