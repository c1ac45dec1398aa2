//! Shapes of the analytic scenes, their intersection with rays, and the noise of their textures.

use glam::{DMat3, DVec3};
use nightsplat_core::random::Stream;

/// The shape of a surface.
pub(super) enum SurfaceShape {
    /// The points whose dot product with the unit normal is the offset; visible from the side of the normal.
    Plane { normal: DVec3, offset: f64 },
    /// A sphere.
    Sphere { center: DVec3, radius: f64 },
    /// A box; `turn` maps directions from the world to the box's axes.
    Block { center: DVec3, half: DVec3, turn: DMat3 },
}

/// A shape with its look.
pub(super) struct SceneSurface<L> {
    pub(super) shape: SurfaceShape,
    pub(super) material: L,
}

/// The intersection of a ray and a surface.
pub(super) struct RayHit {
    pub(super) distance: f64,
    pub(super) normal: DVec3,
    /// The position at which the albedo is evaluated.
    pub(super) position: DVec3,
}

/// The first surface along a ray.
pub(super) fn nearest<'a, L>(
    surfaces: impl Iterator<Item = &'a SceneSurface<L>>,
    origin: DVec3,
    direction: DVec3,
) -> Option<(&'a SceneSurface<L>, RayHit)> {
    let hits =
        surfaces.filter_map(|surface| Some((surface, surface.shape.hit(origin, direction)?)));
    hits.min_by(|(_, a), (_, b)| a.distance.total_cmp(&b.distance))
}

impl SurfaceShape {
    /// The first point of a ray on the shape's outside, if any.
    pub(super) fn hit(&self, origin: DVec3, direction: DVec3) -> Option<RayHit> {
        match *self {
            Self::Plane { normal, offset } => {
                let speed = direction.dot(normal);
                let distance = (offset - origin.dot(normal)) / speed;
                let position = origin + distance * direction;
                (speed < 0.0 && distance > 0.0).then_some(RayHit { distance, normal, position })
            }
            Self::Sphere { center, radius } => {
                let from_center = origin - center;
                let half_b = from_center.dot(direction);
                let root = half_b * half_b - from_center.length_squared() + radius * radius;
                let distance = -half_b - root.sqrt();
                let normal = (from_center + distance * direction) / radius;
                // A negative root makes the distance NaN, which is not greater than zero either.
                (distance > 0.0).then_some(RayHit { distance, normal, position: normal })
            }
            Self::Block { center, half, turn } => {
                let (origin, direction) = (turn * (origin - center), turn * direction);
                let (a, b) = ((-half - origin) / direction, (half - origin) / direction);
                let (enter, exit) = (a.min(b), a.max(b));
                let distance = enter.max_element();
                let axis = [DVec3::X, DVec3::Y, DVec3::Z][enter.max_position()];
                let normal = turn.transpose() * (-axis * direction.dot(axis).signum());
                let position = origin + distance * direction;
                (distance > 0.0 && distance < exit.min_element()).then_some(RayHit {
                    distance,
                    normal,
                    position,
                })
            }
        }
    }
}

/// The noise of textures.
pub(super) struct TextureNoise(pub(super) Stream);

impl TextureNoise {
    /// Value noise in [0, 1] with quintic interpolation, one feature per unit.
    pub(super) fn value(&self, position: DVec3) -> f64 {
        let cell = position.floor();
        let t = position - cell;
        let t = t * t * t * (t * (6.0 * t - 15.0) + 10.0);
        let [x, y, z] = cell.to_array().map(|coordinate| coordinate as i64);
        let corner = |dx: i64, dy: i64, dz: i64| {
            let [x, y, z] = [x + dx, y + dy, z + dz].map(|coordinate| (coordinate & 0xffff) as u64);
            self.0.uniform(x << 32 | y << 16 | z)
        };
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let edge = |dy, dz| lerp(corner(0, dy, dz), corner(1, dy, dz), t.x);
        lerp(lerp(edge(0, 0), edge(1, 0), t.y), lerp(edge(0, 1), edge(1, 1), t.y), t.z)
    }

    /// Three octaves of noise, in [0, 1].
    pub(super) fn fractal(&self, position: DVec3) -> f64 {
        let octave = |k: i32| {
            0.5f64.powi(k) * self.value(position * f64::from(1 << k) + 17.0 * f64::from(k))
        };
        (octave(0) + octave(1) + octave(2)) / 1.75
    }
}

/// The share of the light from above, cosine-weighted, that a sphere hides (sphere occlusion after Quilez).
fn hidden_by_sphere(position: DVec3, normal: DVec3, center: DVec3, radius: f64) -> f64 {
    let to_center = center - position;
    let distance = to_center.length().max(radius);
    (normal.dot(to_center) / distance).max(0.0) * (radius / distance).powi(2)
}

/// The share of the sky above a position that a solid leaves visible: it hides what its bounding sphere hides.
pub(super) fn open_beside<L>(solid: &SceneSurface<L>, position: DVec3, normal: DVec3) -> f64 {
    let hidden = |center, radius| hidden_by_sphere(position, normal, center, radius);
    match solid.shape {
        SurfaceShape::Plane { .. } => 1.0,
        SurfaceShape::Sphere { center, radius } => 1.0 - hidden(center, radius),
        SurfaceShape::Block { center, half, .. } => {
            1.0 - 0.8 * hidden(center, half.element_sum() / 3.0)
        }
    }
}

/// 0 up to `low`, 1 from `high` on, and a cubic between them.
pub(super) fn smoothstep(low: f64, high: f64, value: f64) -> f64 {
    let t = ((value - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
