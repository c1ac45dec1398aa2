//! Pairs of a dark photograph and its reference.

use nightsplat_core::random::Stream;
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::{Family, Statistics, ToneCurve, ToneSettings};

/// A dark photograph of independent colours; brightness decreases exponentially, so that t reaches about 4, from a
/// black level of `floor`.
pub(crate) fn dark(size: u32, scale: f64, floor: f64, seed: u64) -> Image {
    let stream = Stream::new(seed, 1);
    Image::from_fn(size, size, |x, y| {
        let index = u64::from(y * size + x);
        [0, 1, 2].map(|channel| {
            (floor + scale * -(1.0 - stream.uniform(3 * index + channel)).ln()).min(1.0) as f32
        })
    })
}

/// A photograph under the curve, with normal noise.
pub(crate) fn reference(settings: &ToneSettings, dark: &Image, noise: f64, seed: u64) -> Image {
    let stream = Stream::new(seed, 2);
    let parameters = settings.parameters(&Statistics::new(&dark.data));
    let plane = dark.pixel_count();
    let data = dark.data.iter().enumerate().map(|(index, &x)| {
        let y = if settings.curve == ToneCurve::PerChannel {
            (x / parameters.constants[index / plane]).min(1.0)
        } else {
            settings.curve.apply(x, &parameters)
        };
        (f64::from(y) + noise * stream.normal(index as u64)) as f32
    });
    Image { data: data.collect(), ..*dark }
}

/// The table's start, with every constant 6 % smaller: within the bounds, and as monotone as the start.
pub(crate) fn truth(family: &Family) -> ToneSettings {
    let mut settings = ToneSettings::new(family.curve);
    settings.constants = family.constants.iter().map(|constant| 0.94 * constant.start).collect();
    settings
}
