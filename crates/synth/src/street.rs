//! A long street of houses, trees and cars, its ray tracer, and the cameras that fly along it.
//!
//! World axes: x along the street, a unit a plot, y across, z up; the ground is z = 0. Colours are linear radiance,
//! RGB.

use glam::{DMat3, DVec2, DVec3};
use nightsplat_core::random::Stream;

use super::Scene;
use super::lamp;
use super::night::ViewLights;
use super::shapes::{
    RayHit, SceneSurface, SurfaceShape, TextureNoise, nearest, open_beside, smoothstep,
};

/// How much darker the last plot's light is than the first one's, on the photographs.
const FALL: f64 = 8.0;

/// Plots before the first and after the last one, which cameras at the ends see.
const BEYOND: usize = 4;

/// Nothing is higher.
const TOP: f64 = 1.2;

/// The longest distance at which a ray meets something, plots.
const REACH: f64 = 12.0;

const SUN: DVec3 = DVec3::new(0.36, -0.48, 0.8);
const SUN_RADIANCE: DVec3 = DVec3::new(0.80, 0.74, 0.64);
const SKY_RADIANCE: DVec3 = DVec3::new(0.22, 0.25, 0.30);
const GROUND_RADIANCE: DVec3 = DVec3::new(0.10, 0.09, 0.07);

/// Linear reflectance at a position in a shape's own axes.
type Albedo = fn(&Street, DVec3, &StreetMaterial) -> DVec3;

/// The look of a surface.
struct StreetMaterial {
    albedo: Albedo,
    colors: [DVec3; 2],
    /// Where it is in the texture of its kind.
    offset: f64,
}

/// The scene.
pub(super) struct Street {
    /// By plot, [`BEYOND`] before the first one.
    plots: Vec<Vec<SceneSurface<StreetMaterial>>>,
    ground: [SceneSurface<StreetMaterial>; 1],
    noise: TextureNoise,
    length: f64,
    /// Whether the cameras see the sky: they are above the houses and look level across the street, whose light then
    /// is the same everywhere.
    is_open: bool,
}

impl Street {
    /// The street of this many plots whose houses and textures are drawn from `seed`.
    pub(super) fn new(plots: u32, seed: u64, is_open: bool) -> Self {
        let stream = Stream::new(seed, 0);
        let ground = SceneSurface {
            shape: SurfaceShape::Plane { normal: DVec3::Z, offset: 0.0 },
            material: StreetMaterial { albedo: Self::ground, colors: [DVec3::ONE; 2], offset: 0.0 },
        };
        let plot = |index: usize| {
            plot(index as f64 - BEYOND as f64, |draw| {
                stream.uniform(1 << 48 | (index as u64) << 8 | draw)
            })
        };
        Self {
            plots: (0..plots as usize + 2 * BEYOND).map(plot).collect(),
            ground: [ground],
            noise: TextureNoise(stream),
            length: plots.into(),
            is_open,
        }
    }

    /// The first surface along a ray: of the plots that the ray crosses below the top, and of their neighbours, into
    /// which their surfaces reach.
    fn nearest(
        &self,
        origin: DVec3,
        direction: DVec3,
    ) -> Option<(&SceneSurface<StreetMaterial>, RayHit)> {
        let at = |height: f64| ((height - origin.z) / direction.z).clamp(0.0, REACH);
        let along = [at(0.0), at(TOP)].map(|distance| origin.x + distance * direction.x);
        let plot = |x: f64| (x + BEYOND as f64).max(0.0) as usize;
        let first = plot(along[0].min(along[1])).saturating_sub(1);
        let last = plot(along[0].max(along[1])).saturating_add(2).min(self.plots.len());
        let plots = self.plots[first.min(last)..last].iter().flatten();
        nearest(self.ground.iter().chain(plots), origin, direction)
    }

    /// The share of the sky that is visible above a position: each solid of its plot occludes as its bounding sphere.
    fn openness(&self, position: DVec3, normal: DVec3) -> f64 {
        let Some(plot) = self.plots.get((position.x + BEYOND as f64).max(0.0) as usize) else {
            return 1.0;
        };
        plot.iter().map(|surface| open_beside(surface, position, normal)).product()
    }

    fn ground(&self, position: DVec3, _look: &StreetMaterial) -> DVec3 {
        let rough = self.noise.fractal(position * 6.0);
        match position.y.abs() {
            across if across < 0.03 && position.x.rem_euclid(0.5) < 0.28 => DVec3::splat(0.75),
            across if across < 0.5 => DVec3::new(0.24, 0.24, 0.26) * (0.6 + 0.8 * rough),
            across if across < 0.56 => DVec3::splat(0.62),
            across if across < 0.8 => {
                let slab = DVec2::new(position.x, position.y) / 0.12;
                let joint = (slab - slab.floor() - 0.5).abs().max_element();
                let tone = self.noise.value((slab.floor() * 3.7).extend(0.5));
                DVec3::new(0.56, 0.50, 0.43)
                    * (0.7 + 0.4 * tone)
                    * (1.0 - 0.4 * smoothstep(0.42, 0.47, joint))
            }
            _ => {
                let patch = self.noise.fractal(position * 1.7 + 40.0);
                let grass = DVec3::new(0.16, 0.34, 0.10).lerp(DVec3::new(0.48, 0.46, 0.18), patch);
                grass * (0.5 + rough)
            }
        }
    }

    /// Bricks in two tones, with rows of windows.
    fn facade(&self, position: DVec3, material: &StreetMaterial) -> DVec3 {
        let along = if position.x.abs() > position.y.abs() { position.y } else { position.x }
            + material.offset;
        let window = DVec2::new(along / 0.19, (position.z + material.offset) / 0.24);
        let inside = (window - window.floor() - 0.5).abs();
        if inside.x < 0.24 && inside.y < 0.3 {
            let frame = inside.x > 0.2 || inside.y > 0.26 || inside.x < 0.03;
            return if frame { DVec3::splat(0.7) } else { DVec3::new(0.06, 0.09, 0.14) };
        }
        let row = (position.z / 0.06).floor();
        let brick = ((along / 0.12 + 0.5 * row.rem_euclid(2.0)).floor(), row);
        let tone =
            self.noise.value(DVec3::new(brick.0 * 5.3, brick.1 * 3.1, 9.0 * material.offset));
        material.colors[0].lerp(material.colors[1], tone)
    }

    /// Rows of tiles.
    fn tiles(&self, position: DVec3, material: &StreetMaterial) -> DVec3 {
        let row = (position.y / 0.09 + 1e-4).floor();
        let tile = ((position.x / 0.11 + 0.5 * row.rem_euclid(2.0)).floor(), row);
        let tone = self.noise.value(DVec3::new(tile.0 * 4.1, tile.1 * 2.7, 7.0 * material.offset));
        material.colors[0].lerp(material.colors[1], tone) * (0.75 + 0.4 * (position.y / 0.09 - row))
    }

    fn leaves(&self, position: DVec3, material: &StreetMaterial) -> DVec3 {
        let tone = self.noise.fractal(position * 3.2 + 11.0 * material.offset);
        material.colors[0].lerp(material.colors[1], smoothstep(0.3, 0.7, tone))
    }

    /// A painted body with dark windows around its upper half.
    fn car(&self, position: DVec3, material: &StreetMaterial) -> DVec3 {
        let upper = position.z > 0.02 && position.z < 0.065;
        if upper { DVec3::new(0.05, 0.06, 0.08) } else { material.colors[0] }
    }

    /// Vertical boards.
    fn fence(&self, position: DVec3, material: &StreetMaterial) -> DVec3 {
        let board = (position.x / 0.08).floor();
        let tone = self.noise.value(DVec3::new(board * 2.3, material.offset * 13.0, 0.5));
        material.colors[0].lerp(material.colors[1], tone)
    }
}

impl Scene for Street {
    fn radiance(&self, origin: DVec3, direction: DVec3, lights: &ViewLights) -> [DVec3; 2] {
        let Some((surface, hit)) = self.nearest(origin, direction) else {
            let share = lights.carried.as_ref().map_or(1.0, |_| lamp::AMBIENT);
            return lights
                .sky(direction)
                .map_or([SKY_RADIANCE, share * SKY_RADIANCE], |sky| [sky; 2]);
        };
        let position = origin + hit.distance * direction;
        let albedo = (surface.material.albedo)(self, hit.position, &surface.material);
        let up = 0.5 + 0.5 * hit.normal.z;
        let ambient = GROUND_RADIANCE.lerp(SKY_RADIANCE, up) * self.openness(position, hit.normal);
        let cosine = hit.normal.dot(SUN);
        let lit = cosine > 0.0 && self.nearest(position + 1e-6 * hit.normal, SUN).is_none();
        let sun = if lit { SUN_RADIANCE * cosine } else { DVec3::ZERO };
        let radiance = albedo * (ambient + sun);
        let is_clear = |start, direction, distance| {
            let first = self.nearest(start, direction);
            first.is_none_or(|(_, hit)| hit.distance > distance)
        };
        let Some(carried) = &lights.carried else {
            let nearby = albedo * lights.irradiance(position, hit.normal, is_clear);
            let fall = if self.is_open { 0.0 } else { 0.5 - position.x / self.length };
            return [radiance + nearby, radiance * FALL.powf(fall) + nearby];
        };
        let light = carried.light(position, hit.normal, is_clear);
        let light = light.map_or(DVec3::ZERO, |light| light.radiance * light.cosine);
        [lamp::EVEN * albedo, lamp::AMBIENT * radiance + albedo * light]
    }

    fn first_point(&self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        self.nearest(origin, direction).map(|(_, hit)| origin + hit.distance * direction)
    }

    fn first_normal(&self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        Some(self.nearest(origin, direction)?.1.normal)
    }

    /// Three lanes of cameras above the street, in turn, which look down at its middle and to the other side; every 8th
    /// is of each lane.
    fn camera_position(&self, view: usize, views: usize) -> [DVec3; 2] {
        let fraction = |step: f64| 2.0 * (0.5 + step * view as f64).fract() - 1.0;
        let [a, b, c] = [0.754_877_666, 0.569_840_291, 0.381_966_011].map(fraction);
        let side = (view % 3) as f64 - 1.0;
        let x = self.length * (view as f64 + 0.5) / views as f64;
        if self.is_open {
            let across = a.signum();
            let center = DVec3::new(x, across * 3.1 + 0.3 * a, 1.25 + 0.1 * b);
            return [center, DVec3::new(-0.3 * c, across, -0.02).normalize()];
        }
        let center = DVec3::new(x, 1.15 * side + 0.15 * a, 1.95 + 0.2 * b);
        let target = DVec3::new(x + 0.55 * c, -0.55 * side, 0.25);
        [center, (center - target).normalize()]
    }

    fn lamp_size(&self) -> f64 {
        0.04
    }

    /// Beside the road, every third plot.
    fn street_lamps(&self) -> Vec<DVec3> {
        let x = (0..self.plots.len()).step_by(3).map(|plot| plot as f64 + 1.5 - BEYOND as f64);
        x.map(|x| DVec3::new(x, 0.62, 0.72)).collect()
    }

    /// On the far lane, above the cars that are parked there.
    fn headlights(&self, center: DVec3, along: f64) -> [DVec3; 2] {
        let x = center.x + 1.6 * along - 0.8;
        [0.24, 0.36].map(|y| DVec3::new(x, -y * center.y.signum(), 0.2))
    }
}

/// The solids of the plot that begins at `x`, from draws in [0, 1).
fn plot(x: f64, draw: impl Fn(u64) -> f64) -> Vec<SceneSurface<StreetMaterial>> {
    let mut surfaces = vec![];
    for side in 0..2 {
        let across = 2.0 * side as f64 - 1.0;
        let uniform =
            |index: u64, low: f64, high: f64| low + (high - low) * draw(32 * side + index);
        let color = |index: u64| {
            DVec3::new(
                uniform(index, 0.2, 0.8),
                uniform(index + 1, 0.15, 0.65),
                uniform(index + 2, 0.1, 0.55),
            )
        };
        let material = |albedo: Albedo, color: DVec3, index: u64| StreetMaterial {
            albedo,
            colors: [color, 0.55 * color],
            offset: uniform(index, 0.0, 1.0),
        };
        let block = |center: DVec3, half: DVec3, yaw: f64, material: StreetMaterial| {
            let turn = DMat3::from_rotation_z(-yaw);
            SceneSurface { shape: SurfaceShape::Block { center, half, turn }, material }
        };
        let height = uniform(0, 0.35, 0.9);
        let middle = DVec2::new(x + uniform(1, 0.42, 0.58), across * uniform(2, 1.3, 1.5));
        let half = DVec2::new(uniform(3, 0.24, 0.33), uniform(4, 0.22, 0.32));
        let yaw = uniform(5, -0.2, 0.2);
        let house = middle.extend(0.5 * height);
        let facade = material(Street::facade, color(6), 9);
        surfaces.push(block(house, half.extend(0.5 * height), yaw, facade));
        let (roof, tiles) = (middle.extend(height + 0.05), material(Street::tiles, color(10), 13));
        surfaces.push(block(roof, (half + 0.04).extend(0.05), yaw, tiles));
        let chimney = roof + DVec3::new(0.6 * half.x, 0.2 * across, 0.1);
        let bricks = material(Street::facade, color(14), 17);
        surfaces.push(block(chimney, DVec3::new(0.05, 0.05, 0.07), yaw, bricks));
        let radius = uniform(18, 0.11, 0.19);
        let center =
            DVec3::new(x + uniform(19, 0.0, 1.0), across * uniform(20, 0.8, 0.95), 0.9 * radius);
        let green = DVec3::new(uniform(21, 0.2, 0.6), 0.5, 0.14);
        let tree = SurfaceShape::Sphere { center, radius };
        surfaces.push(SceneSurface { shape: tree, material: material(Street::leaves, green, 22) });
        if draw(32 * side + 23) < 0.6 {
            let center = DVec3::new(x + uniform(24, 0.2, 0.8), across * 0.3, 0.08);
            let car = material(Street::car, 0.9 * color(25), 28);
            surfaces.push(block(center, DVec3::new(0.18, 0.085, 0.08), 0.0, car));
        }
        let center = DVec3::new(x + 0.5, across * 2.15, 0.13);
        let fence = material(Street::fence, DVec3::new(0.5, 0.36, 0.22), 29);
        surfaces.push(block(center, DVec3::new(0.5, 0.03, 0.13), 0.0, fence));
    }
    surfaces
}
