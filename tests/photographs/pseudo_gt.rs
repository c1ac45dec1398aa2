//! The curve on the device against the host, for whole photographs and in tiles.

use nightsplat::Error;
use nightsplat::gpu::testing::gpu_that_binds;
use nightsplat::kernels::ToneParameters;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::MeasuredPhotograph;

use crate::common::fixture;
use crate::common::prelude::*;

#[test]
fn a_curve_agrees_with_the_host_from_tiny_to_huge_values() {
    let gpu = gpu();
    let mut grid: Vec<f32> = (0..=20_000).map(|i| i as f32 / 5000.0).collect();
    grid.extend([0.0, 1e-12, 1e-9, 1e-6, 0.009_999, 0.01, 0.010_001, 65.0, 1e6, f32::MAX]);
    grid.extend([f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, -1e-9]);
    grid.resize(grid.len().next_multiple_of(3), 0.0);
    for curve in [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::None] {
        let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(curve)).unwrap();
        let image = gpu.buffer("image", &grid).unwrap();
        for (white, offset, gain) in [(1.0, 0.0, 1.0), (0.0816, 0.0754, 1.16), (1e-6, 0.12, 4.0)] {
            let tone = ToneParameters { white, offset, gain, weight: 1.0, constants: [0.0; 8] };
            let parameters = [ToneParameters::default(), tone];
            let parameters = gpu.buffer("parameters", &parameters).unwrap();
            let mut target = gpu.zeros("target", grid.len()).unwrap();
            gpu.run("target", |pass| pseudo_gt.map(pass, &image, &parameters, 1, &mut target))
                .unwrap();
            for (&x, found) in grid.iter().zip(gpu.read(&target).unwrap()) {
                let expected = curve.apply(x, &tone);
                // exp may be off by 3 + 2 |x| ulp; tiny values keep their relative precision.
                let bound =
                    if offset == 0.0 && x / white < 1e-3 { 4e-7 * expected.abs() } else { 5e-7 };
                assert!(
                    (found - expected).abs() <= bound,
                    "{curve}({x}) = {found}, not {expected}"
                );
            }
        }
    }
}

/// The curve of a single photograph, and its target on the device.
fn tone_mapped(gpu: &Gpu, settings: &ToneSettings, photograph: &Image) -> (ToneParameters, Image) {
    let measured = MeasuredPhotograph::measure(&photograph.data);
    let parameters = SceneTone::new(settings).curve_of(&measured);
    let pseudo_gt = PseudoGt::new(gpu, settings).unwrap();
    (parameters, pseudo_gt.tone_mapped(photograph, &parameters).unwrap())
}

#[test]
fn unsuitable_buffers_are_refused() {
    let gpu = gpu();
    let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(ToneCurve::Ap3)).unwrap();
    let image = gpu.zeros("image", 36).unwrap();
    let parameters = gpu.zeros("tone parameters", 1).unwrap();
    let mut target = gpu.zeros("target", 36).unwrap();
    let mut short = gpu.zeros("target", 35).unwrap();
    for (what, view, target) in [("no such view", 1, &mut target), ("short target", 0, &mut short)]
    {
        let refused =
            gpu.run("refused", |pass| pseudo_gt.map(pass, &image, &parameters, view, target));
        assert!(matches!(refused, Err(Error::Usage(_))), "{what}: {refused:?}");
    }
    let bad = ToneSettings { theta: 0.0, ..ToneSettings::new(ToneCurve::Ap3) };
    assert!(matches!(PseudoGt::new(&gpu, &bad), Err(Error::Setting { .. })));
}

#[test]
fn a_photograph_maps_on_the_device_as_on_the_host() {
    let committed = ["000", "001", "002"].map(|name| fixture(&format!("lom/low/{name}.png")));
    for path in committed.into_iter().chain(shared("data/lom/chair/low/1.JPG")) {
        let photograph = Image::load(path).unwrap();
        for curve in [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::Hybrid] {
            let (parameters, target) = tone_mapped(&gpu(), &ToneSettings::new(curve), &photograph);
            let values = photograph.data.iter();
            let mapped: Vec<f32> = values.map(|&x| curve.apply(x, &parameters)).collect();
            assert_close(curve.name(), &target.data, &mapped, |_, _| 5e-6);
        }
    }
}

#[test]
fn a_photograph_beyond_a_binding_is_mapped_in_tiles_to_the_same_bits() {
    let photograph = Image::load(fixture("lom/low/000.png")).unwrap();
    let settings = ToneSettings::new(ToneCurve::Ap3);
    let (_, whole) = tone_mapped(&gpu(), &settings, &photograph);
    // The last tile is shorter.
    let bytes = size_of_val(&*photograph.data) as u64 / 3 + 48;
    let (_, in_tiles) = tone_mapped(&gpu_that_binds(bytes), &settings, &photograph);
    assert_eq!(whole, in_tiles);
}
