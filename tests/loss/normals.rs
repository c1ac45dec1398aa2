//! The term of normals.

use nightsplat::kernels::map_normal::NO_NORMAL;
use nightsplat::kernels::{Camera, normals, normals_backward};
use nightsplat::loss::{LossTerm as _, NormalLoss, Term};
use nightsplat::reference::normals::{map_normal, normal_loss, pixel_ray};
use nightsplat_photographs::dataset::NormalMap;

use super::{
    Logged, NOT_FINITE, assert_close, assert_gradient, bits, central_differences, largest,
    log_step, noise, term_inputs, widen,
};

use crate::common::prelude::*;

const SIZES: [[u32; 2]; 6] = [[1, 1], [3, 3], [2, 40], [7, 5], [33, 17], [64, 48]];
const FOCAL: Vec2 = Vec2::new(50.0, 55.0);

/// What the term reads of a view: mean depth, transmittance and normals.
#[derive(Clone)]
struct Seen {
    size: UVec2,
    depths: Vec<f32>,
    transmittances: Vec<f32>,
    normals: Vec<u32>,
}

impl Seen {
    /// A bumpy surface, seen with some light through it, and the normals of another.
    fn bumpy(size: [u32; 2]) -> Self {
        let pixels = (size[0] * size[1]) as usize;
        let bumps = noise(2, pixels, -0.02, 0.02);
        let depth = |i: usize| {
            let (x, y) = ((i % size[0] as usize) as f32, (i / size[0] as usize) as f32);
            2.0 + 0.02 * x - 0.01 * y + bumps[i]
        };
        let tilts = noise(3, 2 * pixels, -0.7, 0.7);
        let normal = |i: usize| match i % 11 {
            10 => Vec3::ZERO,
            _ => Vec3::new(tilts[2 * i], tilts[2 * i + 1], -1.0),
        };
        let mut transmittances = noise(4, pixels, 0.0, 0.15);
        transmittances.iter_mut().step_by(17).for_each(|it| *it = 0.6);
        Self {
            size: size.into(),
            depths: (0..pixels).map(depth).collect(),
            transmittances,
            normals: NormalMap::new(size[0], size[1], (0..pixels).map(normal)).packed().to_vec(),
        }
    }

    /// The plane through (0, 0, 2) with this normal, opaque, and its own normals.
    fn plane(size: [u32; 2], normal: Vec3) -> Self {
        let pixels = (size[0] * size[1]) as usize;
        let seen = Self { transmittances: vec![0.0; pixels], ..Self::bumpy(size) };
        let depth = |i: usize| {
            let pixel = UVec2::new(i as u32 % size[0], i as u32 / size[0]);
            let ray = pixel_ray::<f64>(pixel, FOCAL, seen.center());
            (2.0 * f64::from(normal.z) / dot(ray, normal.as_dvec3().to_array())) as f32
        };
        let depths = (0..pixels).map(depth).collect();
        let normals = NormalMap::new(size[0], size[1], vec![normal; pixels]).packed().to_vec();
        Self { depths, normals, ..seen }
    }

    fn center(&self) -> Vec2 {
        0.45 * self.size.as_vec2()
    }

    fn camera(&self) -> Camera {
        Camera {
            focal: FOCAL,
            principal_point: self.center(),
            size: self.size,
            ..bytemuck::Zeroable::zeroed()
        }
    }

    /// The mean of 1 - n g over the map's normals, of these depths.
    fn loss(&self, depths: &[f64]) -> f64 {
        let Self { size, transmittances, normals, .. } = self;
        let at = |pixel: UVec2| (pixel.y * size.x + pixel.x) as usize;
        let point = |pixel: UVec2| {
            pixel_ray::<f64>(pixel, FOCAL, self.center()).map(|ray| depths[at(pixel)] * ray)
        };
        let mut sum = 0.0;
        for y in 1..size.y.max(1) - 1 {
            for x in 1..size.x.max(1) - 1 {
                let pixel = UVec2::new(x, y);
                let ends = [UVec2::X, UVec2::Y].map(|axis| [pixel + axis, pixel - axis]);
                let opaque = |pixel: &UVec2| transmittances[at(*pixel)] <= 0.2;
                let counts = ends.iter().flatten().chain([&pixel]).all(opaque);
                if !counts || normals[at(pixel)] == NO_NORMAL {
                    continue;
                }
                let [u, v] = ends.map(|[to, from]| {
                    let (to, from) = (point(to), point(from));
                    [0, 1, 2].map(|c| to[c] - from[c])
                });
                sum += normal_loss(u, v, map_normal::<f64>(normals[at(pixel)])).unwrap().0;
            }
        }
        sum / normals.iter().filter(|&&it| it != NO_NORMAL).count().max(1) as f64
    }

    /// The term of a step of weight 1: what it logs, and the gradient of the render.
    fn step(&self) -> (Logged, Vec<f32>) {
        let gpu = gpu();
        let colors = vec![9.0; 3 * self.depths.len()];
        let render = gpu.buffer("render", &[&colors, &*self.depths].concat()).unwrap();
        let transmittances = gpu.buffer("transmittances", &self.transmittances).unwrap();
        let mut d_render = gpu.buffer("d_render", &vec![f32::NAN; render.len()]).unwrap();
        let mut loss = NormalLoss::new(&gpu, 1.0, 10).unwrap();
        loss.add(self.camera(), Some(&self.normals)).unwrap();
        let inputs = term_inputs(self.size, Features::NONE, &render, 1);
        let inputs = nightsplat::loss::TermInputs { transmittances: &transmittances, ..inputs };
        let logged =
            log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log));
        (logged.unwrap(), gpu.read(&d_render).unwrap())
    }

    /// [`Seen::step`], checked; of the gradient, that of the mean depth over alpha.
    fn evaluate(&self) -> (Logged, Vec<f32>) {
        let (logged, mut d_render) = agreeing(|| self.step()).0;
        (logged, d_render.split_off(3 * self.depths.len()))
    }
}

fn dot([a, b, c]: [f64; 3], [x, y, z]: [f64; 3]) -> f64 {
    a * x + b * y + c * z
}

#[test]
fn the_kernels_match_their_references_and_the_value_is_the_mean() {
    for size in SIZES {
        let seen = Seen::bumpy(size);
        let (logged, _) = seen.evaluate();
        let (actual, expected) =
            (f64::from(logged.losses.get(Term::NORMALS)), seen.loss(&widen(&seen.depths)));
        assert!((actual - expected).abs() < 1e-4 * expected.max(0.1), "{size:?} {actual}");
    }
}

#[test]
fn the_gradient_agrees_with_central_differences() {
    for size in [[3, 3], [7, 5], [12, 9]] {
        let seen = Seen::bumpy(size);
        let Seen { depths: render, transmittances, normals, .. } = seen.clone();
        let pixels = render.len();
        let (size, focal, principal_point, first) = (seen.size, FOCAL, seen.center(), 0);
        let params = normals::Params { size, focal, principal_point, first };
        let (d_differences, partials) = (vec![f32::NAN; 8 * pixels], vec![0.0; pixels]);
        let constants = normals::Constants::default();
        let (d_differences, _) = run_reference!(
            normals,
            constants,
            params,
            [render, transmittances, normals],
            [d_differences, partials]
        );
        let count = normals.iter().filter(|&&it| it != NO_NORMAL).count();
        let scale = 1.0 / count as f32;
        let params = normals_backward::Params { size, focal, principal_point, first, scale };
        let d_render = vec![f32::NAN; pixels];
        let d_render = run_reference!(
            normals_backward,
            normals_backward::Constants {},
            params,
            [transmittances, d_differences],
            [d_render]
        );
        let analytic: Vec<f32> =
            d_render.iter().zip(&transmittances).map(|(d, t)| d * (1.0 - t)).collect();
        let numeric = central_differences(&widen(&render), |depths| seen.loss(depths));
        assert!(largest(&analytic) > 1e-3);
        assert_gradient("normals", &analytic, &numeric);
    }
}

#[test]
fn a_plane_has_its_normal_and_a_tilted_one_not() {
    for normal in [Vec3::NEG_Z, Vec3::new(0.3, 0.2, -0.9), Vec3::new(-0.5, 0.4, -0.7)] {
        let normal = normal.normalize();
        let plane = Seen::plane([33, 17], normal);
        assert!(plane.evaluate().0.losses.get(Term::NORMALS) < 1e-5, "{normal}");
        let tilted = Vec3::new(-normal.x, normal.y, normal.z) + 0.3;
        let other = Seen { normals: Seen::plane([33, 17], tilted).normals, ..plane };
        assert!(other.evaluate().0.losses.get(Term::NORMALS) > 0.01, "{normal}");
    }
}

#[test]
fn pixels_without_a_normal_or_with_light_through_them_have_no_part() {
    let seen = Seen::bumpy([33, 17]);
    for nothing in [
        Seen { normals: vec![NO_NORMAL; 33 * 17], ..seen.clone() },
        Seen { transmittances: vec![0.5; 33 * 17], ..seen.clone() },
        Seen { depths: vec![0.0; 33 * 17], ..seen.clone() },
    ] {
        let has_map = nothing.normals.iter().any(|&it| it != NO_NORMAL);
        let (logged, d_depths) = nothing.evaluate();
        assert_eq!((logged.losses.get(Term::NORMALS), logged.status), (0.0, 0));
        // Without a normal the term records nothing.
        assert!(d_depths.iter().all(|&d| if has_map { d == 0.0 } else { d.is_nan() }));
    }
}

#[test]
fn a_depth_that_is_not_finite_reaches_the_log() {
    for value in [f32::NAN, f32::INFINITY] {
        let mut seen = Seen::bumpy([33, 17]);
        seen.depths[8 * 33 + 12] = value;
        seen.transmittances.fill(0.0);
        assert_eq!(seen.step().0.status, NOT_FINITE, "{value}");
    }
}

#[test]
fn the_same_view_leaves_the_same_bits() {
    let seen = Seen::bumpy([64, 48]);
    let step = || {
        let (logged, d_depths) = seen.evaluate();
        (logged.losses.get(Term::NORMALS).to_bits(), bits(&d_depths))
    };
    let first = step();
    assert!((0..3).all(|_| step() == first));
    let shown: Vec<f32> = first.1.iter().map(|&bits| f32::from_bits(bits)).collect();
    assert_close("finite", &shown, &shown, 0.0);
}

#[test]
fn a_view_that_does_not_fit_is_refused() {
    let gpu = gpu();
    let seen = Seen::bumpy([12, 9]);
    let mut loss = NormalLoss::new(&gpu, 1.0, 10).unwrap();
    loss.add(seen.camera(), Some(&seen.normals)).unwrap();
    let render = gpu.zeros("render", 4 * 64 * 64).unwrap();
    let mut d_render = gpu.zeros("d_render", 4 * 64 * 64).unwrap();
    let inputs = term_inputs(UVec2::splat(64), Features::NONE, &render, 1);
    let refused = log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log));
    assert!(refused.is_err());
}
