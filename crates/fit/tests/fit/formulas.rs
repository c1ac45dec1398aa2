//! Fits of a formula of one's own.

use nightsplat_fit::{FitOptions, Pair, fit};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::{CurveChoice, Statistics, Tone};

#[test]
fn a_fit_recovers_the_constants_within_their_bounds() {
    let truth: CurveChoice = "a*t^g/(t^g+b); a = 1.1; b = 0.4; g = 0.8".parse().unwrap();
    let truth = truth.settings().unwrap();
    let pairs: Vec<Pair> = (1..4)
        .map(|seed: u32| {
            let dark = Image::from_fn(48, 48, |x, y| {
                let value = ((x * 48 + y + seed * 7) % 2304) as f32 / 2304.0;
                [value, value * value, 0.5 * value].map(|value| 0.05 * value * seed as f32)
            });
            let statistics = Statistics::new(&dark.data);
            let p90 = f64::from(statistics.p90);
            let y = dark.data.iter().map(|&x| truth.value(f64::from(x) / p90, &statistics) as f32);
            let bright = Image { data: y.collect(), ..dark };
            Pair::new(format!("{seed}.png"), &dark, &bright).unwrap()
        })
        .collect();
    let pairs: Vec<&Pair> = pairs.iter().collect();
    let open: Tone = "a*t^g/(t^g+b)".parse().unwrap();
    let found = fit(&open, &pairs, &FitOptions::default()).unwrap();
    for (found, truth) in found.settings.constants.iter().zip(&truth.constants) {
        assert!((found / truth - 1.0).abs() < 0.02, "{found}, not {truth}");
    }
    assert!(found.psnr.fitted > found.psnr.frozen + 10.0, "{:?}", found.psnr);
    // At a bound, and of the stored value.
    let bounded: Tone = "a*t^g/(t^g+b); g = 0.5 in 0.3..0.6".parse().unwrap();
    let at_bound = fit(&bounded, &pairs, &FitOptions::default()).unwrap();
    let g = at_bound.constants.iter().find(|constant| constant.name == "g").unwrap();
    assert!(g.at_bound && (0.3..=0.6).contains(&g.value), "{g:?}");
    let stored: Tone = "(a*x)^g; a = 2 in 0.1..50; g = 0.5 in 0.1..2".parse().unwrap();
    let of_stored = fit(&stored, &pairs, &FitOptions::default()).unwrap();
    assert!(of_stored.psnr.fitted > of_stored.psnr.frozen, "{:?}", of_stored.psnr);
    // Only rows of the table have a black level to adapt.
    let adapted = fit(&open, &pairs, &FitOptions { adapt: true, ..FitOptions::default() });
    assert!(adapted.unwrap_err().to_string().contains("constants of the formula"));
    assert!(fit(&"t^2".parse().unwrap(), &pairs, &FitOptions::default()).is_err());
}
