//! What lens and shutter do to the light of a photograph, and how it is undone in linear light before anything is
//! measured.
//!
//! ```text
//! light = even light x exp(-a u - b u^2) x (1 + c cos(2 pi n y) + s sin(2 pi n y))
//! ```
//!
//! u = 1 - cos of the angle off the axis, y the position in the height, 0 to 1. Lamps on mains flicker as a sine, and a
//! rolling shutter exposes one row after another; a longer exposure lowers the wave and keeps its form.

use std::collections::BTreeMap;

use glam::DVec2;
use nightsplat_core::camera::Camera;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::image::{Image, linear_from_srgb, srgb_from_linear};

/// Bands of rows of the photographs of a set, under lamps on mains.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RowBands {
    /// n: how many there are in the height of a photograph.
    pub count: f64,
    /// c and s of each photograph, by the name of its view; the others are even.
    pub waves: BTreeMap<String, [f64; 2]>,
}

/// The shading of one photograph; the default is none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Shading {
    /// a and b.
    falloff: [f64; 2],
    /// n, c and s.
    bands: [f64; 3],
}

impl Shading {
    /// The largest height of a wave: rows without light cannot be restored.
    const HIGHEST: f64 = 0.95;

    /// That of a view's photograph.
    pub(super) fn new(falloff: Option<[f64; 2]>, bands: Option<&RowBands>, view: &str) -> Self {
        let wave = |bands: &RowBands| {
            let &[c, s] = bands.waves.get(view)?;
            let lower = (Self::HIGHEST / c.hypot(s)).min(1.0);
            (c != 0.0 || s != 0.0).then_some([bands.count, lower * c, lower * s])
        };
        Self {
            falloff: falloff.unwrap_or_default(),
            bands: bands.and_then(wave).unwrap_or_default(),
        }
    }

    /// The gain that evens out a row, at this part of the height.
    fn gain_of_row(&self, y: f64) -> f64 {
        let [count, c, s] = self.bands;
        let (sine, cosine) = (std::f64::consts::TAU * count * y).sin_cos();
        1.0 / (1.0 + c * cosine + s * sine)
    }

    /// Undoes the shading of a camera's photograph. White stays white: its light is not known.
    pub(super) fn even_out(&self, image: &mut Image, camera: &Camera) {
        if *self == Self::default() {
            return;
        }
        let [first, second] = self.falloff;
        let (width, height) = (image.width as usize, image.height as usize);
        let pixels = image.pixel_count();
        let gains = (0..height).into_par_iter().flat_map_iter(|y| {
            let of_row = self.gain_of_row((y as f64 + 0.5) / height as f64);
            (0..width).map(move |x| {
                let at = DVec2::new(x as f64, y as f64) + 0.5;
                let u = |ray: glam::DVec3| 1.0 - ray.z / ray.length();
                let fall =
                    camera.in_view(at, 1.0).map(u).map_or(0.0, |u| first * u + second * u * u);
                (of_row * fall.exp()) as f32
            })
        });
        let gains: Vec<f32> = gains.collect();
        for plane in image.data.chunks_mut(pixels.max(1)) {
            for (value, gain) in plane.iter_mut().zip(&gains) {
                let evened = srgb_from_linear(gain * linear_from_srgb(*value));
                *value = if *value < 1.0 { evened.min(1.0) } else { *value };
            }
        }
    }
}
