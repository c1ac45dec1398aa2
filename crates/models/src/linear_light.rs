//! Images in the light of the photographs.

use glam::DVec3;
use nightsplat_photographs::image::{Image, linear_from_srgb, srgb_from_linear};
use nightsplat_photographs::tone::InverseTone;
use rayon::prelude::*;

use crate::gaussians::{Gaussians, rest_coefficients};
use crate::harmonics::{quadrature, sh_basis};

/// The number in the header of an EXR: the stops by which its light is raised to the brightness of the target.
pub const STOPS: &str = "nightsplatStops";

/// An image as a photograph, sRGB-encoded, and the number of its pixels that the curve does not determine.
pub fn photograph_of(target: &Image, inverse: &InverseTone) -> (Image, usize) {
    let pixels = target.pixel_count();
    let at = |pixel: usize| [0, 1, 2].map(|plane| target.data[plane * pixels + pixel].into());
    let inverted: Vec<[f64; 3]> =
        (0..pixels).into_par_iter().map(|pixel| inverse.invert(at(pixel))).collect();
    let plane = |plane: usize| inverted.iter().map(move |pixel| pixel[plane] as f32);
    let data = (0..3).flat_map(plane).collect();
    let clipped = (0..pixels).filter(|&pixel| inverse.is_clipped(at(pixel))).count();
    (Image { data, ..*target }, clipped)
}

/// An image whose linear light is multiplied by `unit`.
pub fn in_unit(mut image: Image, unit: f32) -> Image {
    if unit != 1.0 {
        let scale = |x: &mut f32| *x = srgb_from_linear(unit * linear_from_srgb(*x));
        image.data.par_iter_mut().for_each(scale);
    }
    image
}

/// The target of a photograph under this curve.
pub fn target_of(photograph: &Image, curve: &InverseTone) -> Image {
    let Image { width, height, .. } = *photograph;
    let target = |x, y| curve.target(photograph.pixel(x, y).map(f64::from));
    Image::from_fn(width, height, |x, y| target(x, y).map(|value| value.min(1.0) as f32))
}

/// The slope of the tone curve at the values of a target: the inverse of the root mean square slope of the inverse
/// curve, over the values that the curve determines. The PSNR of photographs is higher than that of their targets by
/// 20 log10 of it.
pub fn slope_at(target: &Image, inverse: &InverseTone) -> f64 {
    /// Half a code of 8 bits.
    const STEP: f64 = 0.5 / 255.0;
    let pixels = target.pixel_count();
    let squares = |pixel: usize| {
        let value = [0, 1, 2].map(|plane| f64::from(target.data[plane * pixels + pixel]));
        let ends = [-STEP, STEP].map(|step| value.map(|value| value + step));
        let [below, above] = ends.map(|end| inverse.invert(end));
        let rise = |c: usize| ((above[c] - below[c]) / (2.0 * STEP)).powi(2);
        (!inverse.is_clipped(ends[1])).then(|| rise(0) + rise(1) + rise(2))
    };
    let all: Vec<f64> = (0..pixels).into_par_iter().filter_map(squares).collect();
    (3.0 * all.len() as f64 / all.iter().sum::<f64>()).sqrt()
}

/// The Gaussians with colours in the linear light of the photographs, raised by `stops`, and the number of them with a
/// colour that the curve does not determine.
///
/// The colours of a Gaussian are converted in the directions of a quadrature, and harmonics of the same degree are
/// fitted to them. A renderer then blends light, not display values: soft edges become slightly brighter.
pub fn linear_gaussians(
    gaussians: &Gaussians,
    inverse: &InverseTone,
    stops: f64,
) -> (Gaussians, usize) {
    let (mut linear, raised) = (gaussians.clone(), stops.exp2());
    let degree = gaussians.shape.sh_degree;
    let rest = rest_coefficients(degree);
    let directions: Vec<([f64; 16], f64)> =
        quadrature().map(|(direction, weight)| (sh_basis(degree, direction), weight)).collect();
    let converted = |i: usize| {
        let coefficients = &gaussians.rest()[rest * i..][..rest];
        let coefficients: Vec<DVec3> = std::iter::once(&gaussians.dc()[i])
            .chain(coefficients)
            .map(|value| value.as_dvec3())
            .collect();
        let mut fitted = vec![DVec3::ZERO; coefficients.len()];
        let mut is_clipped = false;
        for (basis, weight) in &directions {
            let color: DVec3 =
                coefficients.iter().zip(basis).map(|(value, basis)| *value * *basis).sum();
            // Renderers cut colours at black.
            let target = inverse.shown((color + 0.5).to_array());
            is_clipped |= inverse.is_clipped(target);
            let light =
                inverse.invert(target).map(|x| raised * f64::from(linear_from_srgb(x as f32)));
            for (sum, basis) in fitted.iter_mut().zip(basis) {
                *sum += (DVec3::from_array(light) - 0.5) * *basis * *weight;
            }
        }
        (fitted, is_clipped)
    };
    let all: Vec<_> = (0..gaussians.count).into_par_iter().map(converted).collect();
    for (i, (fitted, _)) in all.iter().enumerate() {
        linear.dc_mut()[i] = fitted[0].as_vec3();
        for (to, coefficient) in linear.rest_mut()[rest * i..][..rest].iter_mut().zip(&fitted[1..])
        {
            *to = coefficient.as_vec3();
        }
    }
    (linear, all.iter().filter(|(_, is_clipped)| *is_clipped).count())
}

/// The stops by which one image of linear light is brighter than another, over all pixels; NaN if one is black.
pub fn stops_between(first: &Image, other: &Image) -> f64 {
    let light = |image: &Image| image.data.iter().map(|&x| f64::from(linear_from_srgb(x))).sum();
    let [first, other]: [f64; 2] = [first, other].map(light);
    (first / other).log2()
}

/// Counts the pixels where a curve is flat.
#[derive(Clone, Copy, Debug, Default)]
pub struct Clipped {
    clipped: usize,
    pixels: usize,
}

impl Clipped {
    /// Counts those of an image, which it returns.
    pub fn add(&mut self, (image, clipped): (Image, usize)) -> Image {
        self.clipped += clipped;
        self.pixels += image.pixel_count();
        image
    }

    /// Warns if there are any.
    pub fn warn(&self) {
        let Self { clipped, pixels } = self;
        if *clipped > 0 {
            let share = 100.0 * *clipped as f64 / *pixels as f64;
            tracing::warn!(
                "{clipped} of {pixels} pixels ({share:.2} %) are as bright as the tone curve gets: their light is \
                 at least what is written"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_photographs::metrics::psnr_of_counted;
    use nightsplat_photographs::scene_tone::SceneTone;
    use nightsplat_photographs::tone::{MeasuredPhotograph, Tone, ToneSettings};

    #[test]
    fn the_colours_of_gaussians_become_their_light_in_every_direction() {
        let settings = ToneSettings::new(Tone::Auto);
        let dark = MeasuredPhotograph::measure(&[0.05; 300]);
        let scene = SceneTone::from_photographs(&settings, &[dark]).unwrap();
        let inverse = scene.inverse_of_scene().unwrap();
        for degree in [0, 3] {
            let mut gaussians = Gaussians::zeros(2, degree);
            gaussians.dc_mut()[0] = glam::Vec3::new(0.2, -0.3, 0.0);
            gaussians.dc_mut()[1] = glam::Vec3::splat(9.0);
            let varied = gaussians.rest_mut().iter_mut().take(15).enumerate();
            varied.for_each(|(k, value)| *value = glam::Vec3::splat(0.01 * (k as f32 - 7.0)));
            let (linear, clipped) = linear_gaussians(&gaussians, &inverse, 3.0);
            assert_eq!(clipped, 1);
            for (direction, _) in quadrature() {
                let basis = sh_basis(degree, direction);
                let of = |model: &Gaussians| {
                    let rest = &model.rest()[..rest_coefficients(degree)];
                    let all = std::iter::once(&model.dc()[0]).chain(rest).zip(basis);
                    (all.map(|(c, b)| c.as_dvec3() * b).sum::<DVec3>() + 0.5).to_array()
                };
                let expected = inverse.invert(of(&gaussians));
                let expected = expected.map(|x| 8.0 * f64::from(linear_from_srgb(x as f32)));
                for (found, expected) in of(&linear).into_iter().zip(expected) {
                    assert!(
                        (found - expected).abs() < 0.03 * expected + 1e-4,
                        "{found} {expected}"
                    );
                }
            }
        }
    }

    /// The automatic curve's target of a dark photograph, and the inverse.
    fn brightened(dark: &Image) -> (InverseTone, Image) {
        let settings = ToneSettings::new(Tone::Auto);
        let photograph = MeasuredPhotograph::measure(&dark.data);
        let scene = SceneTone::from_photographs(&settings, &[photograph]).unwrap();
        let inverse = scene.inverse_of_scene().unwrap();
        let target = target_of(dark, &inverse);
        (inverse, target)
    }

    #[test]
    fn the_psnr_of_photographs_is_that_of_their_targets_divided_by_the_slope() {
        let dark = Image::from_fn(40, 30, |x, y| [0.01 + 0.004 * x as f32, 0.006 * y as f32, 0.05]);
        let (inverse, target) = brightened(&dark);
        // A difference of one sign in all channels of a pixel, and of the other in its neighbours.
        let off = Image::from_fn(40, 30, |x, y| {
            let sign = if (x + y).is_multiple_of(2) { 1.0 } else { -1.0 };
            target.pixel(x, y).map(|value| value + 0.002 * sign)
        });
        let [exact, other] = [&target, &off].map(|image| photograph_of(image, &inverse).0);
        let psnr = |a: &Image, b: &Image| psnr_of_counted(a, b, None).unwrap();
        let slope = slope_at(&target, &inverse);
        let gained = psnr(&other, &exact) - psnr(&off, &target);
        assert!(slope > 2.0, "{slope}");
        assert!((gained - 20.0 * slope.log10()).abs() < 0.2, "{gained} dB, {slope}");
    }

    #[test]
    fn a_target_becomes_its_photograph_and_clipped_pixels_are_counted() {
        let dark = Image::from_fn(16, 9, |x, y| [0.01 + 0.01 * x as f32, 0.02 * y as f32, 0.05]);
        let (inverse, mut target) = brightened(&dark);
        let mut clipped = Clipped::default();
        let back = clipped.add(photograph_of(&target, &inverse));
        assert_eq!(clipped.clipped, 0);
        let off = |(a, b): (&f32, &f32)| (a - b).abs();
        assert!(back.data.iter().zip(&dark.data).map(off).fold(0.0, f32::max) < 1e-5);
        assert!(stops_between(&back, &dark).abs() < 1e-3);
        target.data[7] = 1.0;
        clipped.add(photograph_of(&target, &inverse));
        assert_eq!((clipped.clipped, clipped.pixels), (1, 2 * 144));
        // Grey of 18 % is raised to 18 %.
        let grey = 0.18 * (-inverse.stops_to_target()).exp2();
        let encoded = srgb_from_linear(grey as f32);
        let shown = inverse.target([encoded.into(); 3])[1] as f32;
        assert!((linear_from_srgb(shown) - 0.18).abs() < 1e-4, "{shown}");
    }
}
