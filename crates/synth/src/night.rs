//! What makes a scene one at night: a black sky with stars, lamps in view, and light scattered in the air.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use nightsplat_core::camera::Camera;
use nightsplat_core::random::Stream;

use super::lamp::CameraLamp;
use super::{Scene, SyntheticOptions, is_test};

/// What a scene has at night. Photographs and references have it alike.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Night {
    /// Outdoors: half of each photograph is black sky with stars, the same in all views
    #[cfg_attr(feature = "clap", arg(long))]
    pub sky: bool,
    /// Lamps at fixed positions, white in the photographs, with a wide glow
    #[cfg_attr(feature = "clap", arg(long))]
    pub street_lamp: bool,
    /// Two lamps close to each other, such as headlights, elsewhere in each photograph and in no test view
    #[cfg_attr(feature = "clap", arg(long))]
    pub headlights: bool,
    /// Light scattered in the air: a veil that grows with depth, and a wider glow of lamps
    #[cfg_attr(feature = "clap", arg(long))]
    pub haze: bool,
}

impl Night {
    /// Nothing of it.
    pub const NONE: Self = Self { sky: false, street_lamp: false, headlights: false, haze: false };
}

/// The streams of random numbers of the seed: of the stars, and of what moves.
const STAR_STREAM: u64 = 4;
const MOVING_STREAM: u64 = 5;

/// The radiance of a street lamp and of a headlight: white also in the dark photographs.
const STREET_LAMP: DVec3 = DVec3::new(50.0, 42.5, 30.0);
const HEADLIGHT: DVec3 = DVec3::new(50.0, 50.0, 47.0);

/// A small sphere that shines.
struct NightLamp {
    position: DVec3,
    radius: f64,
    radiance: DVec3,
    /// Whether the camera sees its middle.
    is_seen: bool,
}

/// The lights of a view beside the scene's.
pub(super) struct ViewLights {
    /// The lamp of the camera, if it carries one.
    pub(super) carried: Option<CameraLamp>,
    /// The lamps nearby.
    lamps: Vec<NightLamp>,
    /// The directions and radiances of the stars; none without a sky.
    stars: Vec<(DVec3, f64)>,
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
        let along = Stream::new(seed, MOVING_STREAM << 32).uniform(view as u64);
        let size = scene.lamp_size();
        let fixed = scene.street_lamps().into_iter().map(|at| (at, size, STREET_LAMP));
        let moving = scene.headlights(center, along).map(|at| (at, 0.6 * size, HEADLIGHT));
        let all = fixed.filter(|_| night.street_lamp);
        let all = all.chain(moving.into_iter().filter(|_| night.headlights && !is_test(view)));
        let lamp_at = |(position, radius, radiance): (DVec3, f64, DVec3)| {
            let distance = center.distance(position);
            let first = scene.first_point(center, (position - center) / distance);
            let is_seen = first.is_none_or(|point| point.distance(center) > distance);
            NightLamp { position, radius, radiance, is_seen }
        };
        Self {
            carried: lamp.map(|degrees| CameraLamp::new(camera, degrees)),
            lamps: all.filter(|(at, ..)| at.distance(center) < REACH).map(lamp_at).collect(),
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
        let light = |lamp: &NightLamp| {
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
        let light = |&(star, radiance): &(DVec3, f64)| {
            let off = (1.0 - direction.dot(star)) / (SIZE * SIZE);
            if off < 8.0 { radiance * (-off).exp() } else { 0.0 }
        };
        (!self.stars.is_empty()).then(|| BLACK + self.stars.iter().map(light).sum::<f64>())
    }

    /// What a ray sees that would see `radiance` at its end: nearer lamps, their glow, and the air.
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
        // The air scatters light farther than the lens.
        let fall = if self.haze { 0.8 } else { 1.1 };
        let (mut disc, mut glow) = (None, DVec3::ZERO);
        for lamp in &self.lamps {
            let to_lamp = lamp.position - origin;
            let off = to_lamp.angle_between(direction) / (lamp.radius / to_lamp.length());
            if off < 1.0 && to_lamp.length() < distance {
                (disc, distance) = (Some(lamp.radiance), to_lamp.length());
            } else if lamp.is_seen {
                glow += GLOW * lamp.radiance / (1.0 + off * off).powf(fall);
            }
        }
        let clear = if self.haze { (-EXTINCTION * distance).exp() } else { 1.0 };
        radiance.map(|light| disc.unwrap_or(light).lerp(AIR, 1.0 - clear) + glow)
    }
}

/// The stars above the horizon, as drawn from the seed: few of them bright.
fn stars(seed: u64) -> Vec<(DVec3, f64)> {
    const COUNT: u64 = 300;
    let stream = Stream::new(seed, STAR_STREAM << 32);
    let star = |index: u64| {
        let draw = |which| stream.uniform(3 * index + which);
        let (height, azimuth) = (draw(0), TAU * draw(1));
        let around = (1.0 - height * height).sqrt() * DVec2::from_angle(azimuth);
        (around.extend(height), (0.06 / draw(2)).min(6.0))
    };
    (0..COUNT).map(star).collect()
}
