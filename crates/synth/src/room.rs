//! The analytic scene: a corner of a room with textured planes, spheres and boxes, and its ray tracer.
//!
//! World axes: x right, y away from the viewer, z up; the floor is z = 0. Colours are linear radiance, RGB.

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec2, DVec3};
use nightsplat_core::random::Stream;

use super::Scene;
use super::lamp;
use super::night::ViewLights;
use super::shapes::{
    RayHit, SceneSurface, SurfaceShape, TextureNoise, nearest, open_beside, smoothstep,
};

/// The look of a surface.
struct RoomMaterial {
    /// Linear reflectance at a position: in the world for planes, in the shape's own axes otherwise.
    albedo: fn(&Room, DVec3) -> DVec3,
    /// Strength of the highlight.
    gloss: f64,
}

/// The scene.
pub(super) struct Room {
    surfaces: Vec<SceneSurface<RoomMaterial>>,
    /// Positions on the lamp, the same for every position that it lights, so that all views agree on the shadows.
    lamp: Vec<DVec3>,
    noise: TextureNoise,
    /// Whether the cameras come close and turn, as those of who carries a lamp.
    is_walked: bool,
    /// Whether it is a yard under the sky: its walls end at [`WALL`], and the cameras are low and look up.
    is_open: bool,
}

/// The height of the walls of a yard, which no camera is above.
const WALL: f64 = 1.2;

/// The point that the cameras look at.
const FOCUS: DVec3 = DVec3::new(0.0, 0.3, 0.5);

/// The centre of the lamp, a square that faces the focus.
const LAMP: DVec3 = DVec3::new(-1.5, -2.3, 3.4);
const LAMP_HALF_WIDTH: f64 = 0.55;
const LAMP_RADIANCE: DVec3 = DVec3::new(0.84, 0.77, 0.66);
const LAMP_SAMPLES_PER_SIDE: usize = 4;
const SKY_RADIANCE: DVec3 = DVec3::new(0.12, 0.135, 0.165);
const GROUND_RADIANCE: DVec3 = DVec3::new(0.07, 0.055, 0.04);

impl Room {
    /// The room, or a yard, whose textures are drawn from `seed`; its cameras are at about one distance, or walk.
    pub(super) fn new(seed: u64, is_walked: bool, is_open: bool) -> Self {
        let plane = |normal, offset, albedo| SceneSurface {
            shape: SurfaceShape::Plane { normal, offset },
            material: RoomMaterial { albedo, gloss: 0.0 },
        };
        let sphere = |center, radius, albedo| SceneSurface {
            shape: SurfaceShape::Sphere { center, radius },
            material: RoomMaterial { albedo, gloss: 0.25 },
        };
        let block = |center, half, yaw: f64, albedo| {
            let shape = SurfaceShape::Block { center, half, turn: DMat3::from_rotation_z(-yaw) };
            SceneSurface { shape, material: RoomMaterial { albedo, gloss: 0.0 } }
        };
        let surfaces = vec![
            plane(DVec3::Z, 0.0, Self::planks),
            plane(DVec3::NEG_Y, -2.0, Self::back_wall),
            plane(DVec3::X, -3.0, Self::plaster),
            plane(DVec3::NEG_X, -3.0, Self::plaster),
            sphere(DVec3::new(-0.85, 0.35, 0.58), 0.58, Self::beach_ball),
            sphere(DVec3::new(0.0, -0.5, 0.34), 0.34, Self::marble),
            sphere(DVec3::new(0.98, 0.48, 1.04), 0.2, Self::apple),
            block(DVec3::new(0.95, 0.45, 0.42), DVec3::new(0.5, 0.4, 0.42), 0.45, Self::checker),
            block(DVec3::new(0.12, 1.1, 0.62), DVec3::new(0.32, 0.2, 0.62), -0.3, Self::bands),
        ];
        let noise = TextureNoise(Stream::new(seed, 0));
        Self { surfaces, lamp: lamp_places(), noise, is_walked, is_open }
    }

    /// The first surface along a ray.
    fn nearest(
        &self,
        origin: DVec3,
        direction: DVec3,
    ) -> Option<(&SceneSurface<RoomMaterial>, RayHit)> {
        let height = |hit: &RayHit| origin.z + hit.distance * direction.z;
        nearest(self.surfaces.iter(), origin, direction)
            .filter(|(_, hit)| !self.is_open || height(hit) < WALL || hit.normal.z > 0.0)
    }

    /// The lamp's diffuse light (1 if perpendicular and unoccluded) and its highlight at a position.
    fn lamp(&self, position: DVec3, normal: DVec3, direction: DVec3, gloss: f64) -> (f64, f64) {
        let start = position + 1e-6 * normal;
        let (mut lit, mut highlight) = (0.0, 0.0);
        for sample in &self.lamp {
            let distance = sample.distance(start);
            let to_lamp = (sample - start) / distance;
            let cosine = normal.dot(to_lamp);
            if cosine > 0.0 && self.is_clear(start, to_lamp, distance) {
                lit += cosine;
                if gloss > 0.0 {
                    highlight += gloss * shine(to_lamp, normal, direction);
                }
            }
        }
        (lit / self.lamp.len() as f64, highlight / self.lamp.len() as f64)
    }

    fn is_clear(&self, origin: DVec3, direction: DVec3, distance: f64) -> bool {
        let solids = self
            .surfaces
            .iter()
            .filter(|surface| !matches!(surface.shape, SurfaceShape::Plane { .. }));
        solids
            .filter_map(|surface| surface.shape.hit(origin, direction))
            .all(|hit| hit.distance > distance)
    }

    /// The share of the sky that is visible above a position.
    ///
    /// Each plane darkens nearby positions.
    fn openness(&self, position: DVec3, normal: DVec3) -> f64 {
        const REACH: f64 = 0.4;
        let open = |surface: &SceneSurface<RoomMaterial>| match surface.shape {
            SurfaceShape::Plane { normal: facing, offset } => {
                let distance = position.dot(facing) - offset;
                let away = 0.5 - 0.5 * normal.dot(facing);
                1.0 - away * (-distance / REACH).exp() * 0.6
            }
            _ => open_beside(surface, position, normal),
        };
        self.surfaces.iter().map(open).product()
    }

    fn planks(&self, position: DVec3) -> DVec3 {
        const WIDTH: f64 = 0.42;
        let plank = (position.x / WIDTH).floor();
        let shade = self.noise.value(DVec3::new(plank * 7.3, 0.5, 0.5));
        let grain =
            self.noise.fractal(DVec3::new(position.x * 16.0, position.y * 1.8 + plank * 5.0, 3.0));
        let across = (position.x / WIDTH - plank - 0.5).abs();
        let gap = 1.0 - 0.55 * smoothstep(0.46, 0.49, across);
        let light = DVec3::new(0.66, 0.44, 0.26);
        let dark = DVec3::new(0.34, 0.19, 0.10);
        dark.lerp(light, 0.25 + 0.35 * shade + 0.6 * (grain - 0.35)) * gap
    }

    fn back_wall(&self, position: DVec3) -> DVec3 {
        const PICTURE_CENTER: DVec2 = DVec2::new(-0.55, 1.56);
        const PICTURE_HALF: DVec2 = DVec2::new(0.62, 0.42);
        const FRAME: f64 = 0.07;
        let in_picture = DVec2::new(position.x, position.z) - PICTURE_CENTER;
        let outside = in_picture.abs() - PICTURE_HALF;
        if outside.max_element() < 0.0 {
            return self.sunset(in_picture / PICTURE_HALF);
        }
        if outside.max_element() < FRAME {
            return DVec3::new(0.16, 0.09, 0.05);
        }
        // Wallpaper: diamonds in two tones.
        let (u, v) = (position.x / 0.36, position.z / 0.5);
        let diamond = ((u + v).rem_euclid(1.0) - 0.5).abs() + ((u - v).rem_euclid(1.0) - 0.5).abs();
        let tone = smoothstep(0.42, 0.58, diamond);
        let paper = DVec3::new(0.50, 0.60, 0.55).lerp(DVec3::new(0.76, 0.74, 0.62), tone);
        paper * (0.86 + 0.28 * self.noise.fractal(position * 5.0))
    }

    /// The image on the wall, at coordinates in [-1, 1], y up.
    fn sunset(&self, position: DVec2) -> DVec3 {
        let ridge =
            -0.25 + 0.7 * (self.noise.fractal(DVec3::new(position.x * 2.2 + 9.0, 0.0, 7.0)) - 0.5);
        if position.y < ridge {
            return DVec3::new(0.06, 0.10, 0.16)
                .lerp(DVec3::new(0.16, 0.24, 0.22), (ridge - position.y).min(1.0));
        }
        if (position - DVec2::new(0.3, 0.22)).length() < 0.26 {
            return DVec3::new(0.95, 0.80, 0.45);
        }
        DVec3::new(0.90, 0.42, 0.20)
            .lerp(DVec3::new(0.22, 0.26, 0.50), smoothstep(-0.4, 1.0, position.y))
    }

    fn plaster(&self, position: DVec3) -> DVec3 {
        DVec3::new(0.62, 0.50, 0.40) * (0.7 + 0.5 * self.noise.fractal(position * 2.5))
    }

    fn beach_ball(&self, position: DVec3) -> DVec3 {
        const WEDGES: [DVec3; 3] = [
            DVec3::new(0.05, 0.36, 0.42),
            DVec3::new(0.82, 0.78, 0.66),
            DVec3::new(0.78, 0.30, 0.10),
        ];
        let position = DMat3::from_rotation_x(0.6) * position;
        if position.z > 0.93 {
            return WEDGES[1];
        }
        let wedge =
            ((position.y.atan2(position.x) / TAU).rem_euclid(1.0) * 9.0) as usize % WEDGES.len();
        WEDGES[wedge] * (0.88 + 0.24 * self.noise.fractal(position * 6.0))
    }

    fn marble(&self, position: DVec3) -> DVec3 {
        let turbulence = self.noise.fractal(position * 2.6);
        let vein = (PI * (1.6 * position.x + 2.0 * position.z + 3.2 * turbulence)).sin().abs();
        DVec3::new(0.80, 0.74, 0.70).lerp(DVec3::new(0.34, 0.05, 0.10), (1.0 - vein).powi(2))
    }

    fn apple(&self, position: DVec3) -> DVec3 {
        let blush = smoothstep(0.3, 0.75, self.noise.fractal(position * 2.0) + 0.2 * position.x);
        DVec3::new(0.26, 0.46, 0.08).lerp(DVec3::new(0.70, 0.16, 0.06), blush)
    }

    fn checker(&self, position: DVec3) -> DVec3 {
        const CELL: f64 = 0.21;
        // Slightly off the faces, so that rounding does not choose the cell.
        let cells = ((position + 1e-4) / CELL).floor().element_sum() as i64;
        let tone = if cells & 1 == 0 {
            DVec3::new(0.78, 0.56, 0.14)
        } else {
            DVec3::new(0.10, 0.14, 0.30)
        };
        tone * (0.85 + 0.3 * self.noise.fractal(position * 9.0))
    }

    fn bands(&self, position: DVec3) -> DVec3 {
        const BANDS: [DVec3; 4] = [
            DVec3::new(0.62, 0.16, 0.14),
            DVec3::new(0.80, 0.76, 0.68),
            DVec3::new(0.16, 0.34, 0.20),
            DVec3::new(0.86, 0.62, 0.22),
        ];
        let wave = 0.04 * (position.x * 14.0 + position.y * 9.0).sin();
        let band = ((position.z + wave + 1.0) / 0.155).floor() as usize;
        BANDS[band % BANDS.len()] * (0.9 + 0.2 * self.noise.fractal(position * 8.0))
    }
}

impl Scene for Room {
    fn radiance(&self, origin: DVec3, direction: DVec3, lights: &ViewLights) -> [DVec3; 2] {
        let Some((surface, hit)) = self.nearest(origin, direction) else {
            return [lights.sky(direction).unwrap_or(SKY_RADIANCE); 2];
        };
        let position = origin + hit.distance * direction;
        let albedo = (surface.material.albedo)(self, hit.position);
        let up = 0.5 + 0.5 * hit.normal.z;
        let ambient = GROUND_RADIANCE.lerp(SKY_RADIANCE, up) * self.openness(position, hit.normal);
        let (lit, highlight) = self.lamp(position, hit.normal, direction, surface.material.gloss);
        let is_clear = |start, direction, distance| self.is_clear(start, direction, distance);
        let nearby = lights.irradiance(position, hit.normal, is_clear);
        let radiance =
            albedo * (ambient + LAMP_RADIANCE * lit + nearby) + LAMP_RADIANCE * highlight;
        let Some(carried) = &lights.carried else { return [radiance; 2] };
        let light = carried.light(position, hit.normal, is_clear).map(|light| {
            let shine = surface.material.gloss * shine(light.to_lamp, hit.normal, direction);
            light.radiance * (albedo * light.cosine + shine)
        });
        [lamp::EVEN * albedo, lamp::AMBIENT * radiance + light.unwrap_or(DVec3::ZERO)]
    }

    fn first_point(&self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        self.nearest(origin, direction).map(|(_, hit)| origin + hit.distance * direction)
    }

    fn first_normal(&self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        Some(self.nearest(origin, direction)?.1.normal)
    }

    /// Cameras on a part of a sphere in front of the scene, spread evenly by a low-discrepancy sequence (Roberts' R2),
    /// so that every 8th is among the others. Those that walk come close, and look beside the focus.
    fn camera_position(&self, view: usize, _views: usize) -> [DVec3; 2] {
        const AZIMUTH: f64 = 0.75; // radians to either side
        const ELEVATION: (f64, f64) = (0.24, 0.62); // radians
        const ELEVATION_OPEN: (f64, f64) = (0.02, 0.18);
        const UPWARD: f64 = 0.1; // radians, of the cameras of a yard
        const BESIDE: DVec3 = DVec3::new(1.3, 0.0, 0.7);
        let fraction = |step: f64| (0.5 + step * view as f64).fract();
        let between = |(low, high): (f64, f64), step| low + (high - low) * fraction(step);
        let azimuth = AZIMUTH * (2.0 * fraction(0.754_877_666) - 1.0);
        let range = if self.is_open { ELEVATION_OPEN } else { ELEVATION };
        let elevation = between(range, 0.569_840_291);
        let distance = match self.is_walked {
            true => between((1.8, 4.0), 0.671_043_607),
            false => between((2.95, 3.45), 0.381_966_011),
        };
        let (sin, cos) = azimuth.sin_cos();
        let back = DVec3::new(sin * elevation.cos(), -cos * elevation.cos(), elevation.sin());
        let center = FOCUS + distance * back;
        if self.is_open {
            let level = DVec2::new(sin, -cos) * UPWARD.cos();
            return [center, level.extend(-UPWARD.sin())];
        }
        if !self.is_walked {
            return [center, back];
        }
        let beside = DVec3::new(fraction(0.430_159_709) - 0.5, 0.0, fraction(0.381_966_011) - 0.5);
        [center, (center - FOCUS - BESIDE * beside).normalize()]
    }

    fn lamp_size(&self) -> f64 {
        0.07
    }

    fn street_lamps(&self) -> Vec<DVec3> {
        vec![DVec3::new(0.4, 0.7, 1.45)]
    }

    fn headlights(&self, _center: DVec3, along: f64) -> [DVec3; 2] {
        [-1.32, -1.08].map(|x| DVec3::new(2.4 * along + x, -0.1, 0.9))
    }
}

/// The highlight of a surface by a light in a direction, seen along another.
fn shine(to_light: DVec3, normal: DVec3, direction: DVec3) -> f64 {
    const SHININESS: f64 = 60.0;
    normal.dot((to_light - direction).normalize()).max(0.0).powf(SHININESS)
}

/// A regular grid on the square lamp.
fn lamp_places() -> Vec<DVec3> {
    let (right, up) = (FOCUS - LAMP).normalize().any_orthonormal_pair();
    let offset = |cell: usize| {
        LAMP_HALF_WIDTH * (2.0 * (cell as f64 + 0.5) / LAMP_SAMPLES_PER_SIDE as f64 - 1.0)
    };
    let row = |y: usize| {
        (0..LAMP_SAMPLES_PER_SIDE).map(move |x| LAMP + offset(x) * right + offset(y) * up)
    };
    (0..LAMP_SAMPLES_PER_SIDE).flat_map(row).collect()
}
