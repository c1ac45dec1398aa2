//! What makes a scene one at night: a black sky with stars, lamps in view, and light scattered in the air.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::lamp::CameraLamp;
use super::{Scene, SyntheticOptions, is_test};
use crate::base::random::Stream;
use crate::camera::Camera;

/// What a scene has at night. Photographs and references have it alike.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
pub struct Night {
    /// Outdoors: half of each photograph is black sky with stars, the same in all views
    #[cfg_attr(feature = "cli", arg(long))]
    pub sky: bool,
    /// Lamps at fixed positions, white in the photographs, with a wide glow
    #[cfg_attr(feature = "cli", arg(long))]
    pub street_lamp: bool,
    /// Two lamps close to each other, such as headlights, elsewhere in each photograph and in no test view
    #[cfg_attr(feature = "cli", arg(long))]
    pub headlights: bool,
    /// Light scattered in the air: a veil that grows with depth, and a glow
    #[cfg_attr(feature = "cli", arg(long))]
    pub haze: bool,
}

impl Night {
    /// Nothing of it.
    pub const NONE: Self = Self { sky: false, street_lamp: false, headlights: false, haze: false };
}

/// A small sphere that shines.
#[derive(Clone, Copy)]
pub(super) struct NightLamp {
    pub(super) position: DVec3,
    pub(super) radius: f64,
    pub(super) radiance: DVec3,
}

/// The streams of random numbers of the seed: of the stars, and of what moves.
const STAR_STREAM: u64 = 4;
const MOVING_STREAM: u64 = 5;

/// The radiance of a street lamp and of a headlight: white also in the dark photographs.
const STREET_LAMP: DVec3 = DVec3::new(50.0, 42.5, 30.0);
const HEADLIGHT: DVec3 = DVec3::new(50.0, 50.0, 47.0);

impl NightLamp {
    /// A street lamp of this radius.
    pub(super) fn street(position: DVec3, radius: f64) -> Self {
        Self { position, radius, radiance: STREET_LAMP }
    }

    /// A pair of headlights around a position.
    pub(super) fn pair(middle: DVec3, half: DVec3, radius: f64) -> [Self; 2] {
        [middle - half, middle + half].map(|position| Self {
            position,
            radius,
            radiance: HEADLIGHT,
        })
    }
}

/// A star: its direction and radiance.
struct Star {
    direction: DVec3,
    radiance: f64,
}

/// The lights of a view beside the scene's.
pub(super) struct ViewLights {
    /// The lamp of the camera, if it carries one.
    pub(super) carried: Option<CameraLamp>,
    /// The lamps nearby, and whether the camera sees their middle.
    lamps: Vec<(NightLamp, bool)>,
    /// Of the sky of a night; none without one.
    stars: Vec<Star>,
    haze: bool,
}

impl ViewLights {
    /// The lights of a view.
    pub(super) fn new(
        options: &SyntheticOptions,
        scene: &dyn Scene,
        camera: &Camera,
        view: usize,
    ) -> Self {
        /// The longest distance at which a lamp counts, world units.
        const REACH: f64 = 8.0;
        let &SyntheticOptions { night, seed, lamp, .. } = options;
        let center = camera.center();
        let fixed = if night.street_lamp { scene.street_lamps() } else { vec![] };
        let along = Stream::new(seed, MOVING_STREAM << 32).uniform(view as u64);
        let moving = (night.headlights && !is_test(view)).then(|| scene.headlights(center, along));
        let seen = |lamp: NightLamp| {
            let direction = (lamp.position - center).normalize();
            let distance = center.distance(lamp.position);
            let first = scene.first_point(center, direction);
            (lamp, first.is_none_or(|point| point.distance(center) > distance))
        };
        let lamps = fixed.into_iter().chain(moving.into_iter().flatten());
        let lamps = lamps.filter(|lamp| lamp.position.distance(center) < REACH).map(seen);
        Self {
            carried: lamp.map(|degrees| CameraLamp::new(camera, degrees)),
            lamps: lamps.collect(),
            stars: if night.sky { stars(seed) } else { vec![] },
            haze: night.haze,
        }
    }

    /// The light of the lamps on a surface, divided by pi: what a white one reflects. `is_clear` says whether nothing
    /// is between a position and another one at a distance in a direction.
    pub(super) fn irradiance(
        &self,
        position: DVec3,
        normal: DVec3,
        is_clear: impl Fn(DVec3, DVec3, f64) -> bool,
    ) -> DVec3 {
        let start = position + 1e-6 * normal;
        let light = |(lamp, _): &(NightLamp, bool)| {
            let distance = start.distance(lamp.position);
            let to_lamp = (lamp.position - start) / distance;
            let cosine = normal.dot(to_lamp);
            let is_lit = cosine > 0.0 && is_clear(start, to_lamp, distance);
            let share = (lamp.radius / distance).min(0.5).powi(2);
            if is_lit { share * cosine * lamp.radiance } else { DVec3::ZERO }
        };
        self.lamps.iter().map(light).sum()
    }

    /// The sky in a direction, if it is that of a night: all but black, with stars. The size is a standard deviation,
    /// radians.
    pub(super) fn sky(&self, direction: DVec3) -> Option<DVec3> {
        const BLACK: DVec3 = DVec3::new(0.000_7, 0.000_8, 0.001_1);
        const SIZE: f64 = 0.2 * TAU / 360.0;
        let light = |star: &Star| {
            let off = (1.0 - direction.dot(star.direction)) / (SIZE * SIZE);
            if off < 8.0 { star.radiance * (-off).exp() } else { 0.0 }
        };
        (!self.stars.is_empty()).then(|| BLACK + self.stars.iter().map(light).sum::<f64>())
    }

    /// What a ray sees that would see `radiance` at its end: nearer lamps, their glow in the lens, and the air.
    pub(super) fn seen(
        &self,
        scene: &dyn Scene,
        origin: DVec3,
        direction: DVec3,
        radiance: [DVec3; 2],
    ) -> [DVec3; 2] {
        /// The light that the air of a depth of infinity scatters towards the camera, and its extinction.
        const AIR: DVec3 = DVec3::new(0.16, 0.14, 0.11);
        const EXTINCTION: f64 = 0.22;
        /// The glow at the rim of a lamp, as a share of its radiance.
        const GLOW: f64 = 0.12;
        if self.lamps.is_empty() && !self.haze {
            return radiance;
        }
        let end = scene.first_point(origin, direction);
        let mut distance = end.map_or(f64::INFINITY, |end| end.distance(origin));
        let (mut disc, mut glow) = (None, DVec3::ZERO);
        for &(lamp, is_seen) in &self.lamps {
            let to_lamp = lamp.position - origin;
            let off = to_lamp.angle_between(direction) / (lamp.radius / to_lamp.length());
            if off < 1.0 && to_lamp.length() < distance {
                (disc, distance) = (Some(lamp.radiance), to_lamp.length());
            } else if is_seen {
                glow += GLOW * lamp.radiance / (1.0 + off * off).powf(1.1);
            }
        }
        let clear = if self.haze { (-EXTINCTION * distance).exp() } else { 1.0 };
        radiance.map(|light| disc.unwrap_or(light).lerp(AIR, 1.0 - clear) + glow)
    }

    /// Spreads a part of an image's light over its surroundings, as haze does.
    pub(super) fn scattered(&self, light: Vec<DVec3>, camera: &Camera) -> Vec<DVec3> {
        /// The part, and the standard deviation of its spread as a share of the image's width.
        const PART: f64 = 0.25;
        const SPREAD: f64 = 0.05;
        if !self.haze {
            return light;
        }
        let size = [camera.width as usize, camera.height as usize];
        let deviation = SPREAD * f64::from(camera.width);
        let along = |light: &[DVec3], axis: usize| -> Vec<DVec3> {
            let reach = (3.0 * deviation) as usize;
            let mean = |index: usize| {
                let position = [index % size[0], index / size[0]];
                let range = position[axis].saturating_sub(reach)
                    ..(position[axis] + reach + 1).min(size[axis]);
                let sum = range.fold((DVec3::ZERO, 0.0), |(sum, all), other| {
                    let offset = (other as f64 - position[axis] as f64) / deviation;
                    let weight = (-0.5 * offset * offset).exp();
                    let index = if axis == 0 {
                        position[1] * size[0] + other
                    } else {
                        other * size[0] + position[0]
                    };
                    (sum + weight * light[index], all + weight)
                });
                sum.0 / sum.1
            };
            (0..light.len()).into_par_iter().map(mean).collect()
        };
        let spread = along(&along(&light, 0), 1);
        light.into_iter().zip(spread).map(|(light, spread)| light.lerp(spread, PART)).collect()
    }
}

/// The stars above the horizon, as drawn from the seed: few of them bright.
fn stars(seed: u64) -> Vec<Star> {
    const COUNT: u64 = 300;
    let stream = Stream::new(seed, STAR_STREAM << 32);
    let star = |index: u64| {
        let draw = |which| stream.uniform(3 * index + which);
        let (height, azimuth) = (draw(0), TAU * draw(1));
        let around = (1.0 - height * height).sqrt() * DVec2::from_angle(azimuth);
        Star { direction: around.extend(height), radiance: (0.06 / draw(2)).min(6.0) }
    };
    (0..COUNT).map(star).collect()
}
