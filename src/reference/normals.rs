//! The loss of one normal of the rendered depth, in any number type.

use glam::{UVec2, Vec2};
use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, chain, sum_tolerance, write, write_sum};
use crate::gpu::Reference;
use crate::kernels::map_normal::NO_NORMAL;
use crate::kernels::normals::{Constants, Kernel, MOST_TRANSMITTANCE, Params, Slices, Tolerances};

/// A vector in the view.
type Vector<T> = [T; 3];

fn cross<T: Real>([a, b, c]: Vector<T>, [x, y, z]: Vector<T>) -> Vector<T> {
    [b * z - c * y, c * x - a * z, a * y - b * x]
}

pub(super) fn dot<T: Real>([a, b, c]: Vector<T>, [x, y, z]: Vector<T>) -> T {
    a * x + b * y + c * z
}

/// The direction in which a pinhole sees a pixel, of depth 1.
pub fn pixel_ray<T: Real>(pixel: UVec2, focal: Vec2, principal_point: Vec2) -> Vector<T> {
    let [x, y] = [0, 1].map(|axis| {
        let [center, of] = [pixel[axis] as f64 + 0.5, f64::from(principal_point[axis])];
        (T::from_f64(center) - T::from_f64(of)) / T::from_f64(focal[axis].into())
    });
    [x, y, T::from_f64(1.0)]
}

/// The normal of a map, of length 1.
pub fn map_normal<T: Real>(bits: u32) -> Vector<T> {
    let numbers = [22, 12, 2].map(|left| T::from_f64(f64::from((bits << left) as i32 >> 22)));
    let length = dot(numbers, numbers).sqrt();
    numbers.map(|number| number / length)
}

/// 1 - n g of the surface with the differences `u` and `v` of points and the normal `g`, and the gradients of both;
/// `None` if the differences are parallel.
pub fn normal_loss<T: Real>(
    u: Vector<T>,
    v: Vector<T>,
    g: Vector<T>,
) -> Option<(T, [Vector<T>; 2])> {
    let m = cross(v, u);
    let area = dot(m, m).sqrt();
    if area == T::from_f64(0.0) {
        return None;
    }
    let n = m.map(|value| value / area);
    let cosine = dot(n, g);
    let d = [0, 1, 2].map(|c| (n[c] * cosine - g[c]) / area);
    Some((T::from_f64(1.0) - cosine, [cross(d, v), cross(u, d)]))
}

/// The loss of every pixel that counts, and the gradients of its differences.
fn losses(
    params: &Params,
    slices: &Slices<'_>,
) -> impl Iterator<Item = (Rounded, [Vector<Rounded>; 2])> {
    let Params { size, focal, principal_point, first } = *params;
    let at = move |pixel: UVec2| (pixel.y * size.x + pixel.x) as usize;
    let (render, transmittances, normals) = (slices.render, slices.transmittances, slices.normals);
    let point = move |pixel: UVec2| {
        let depth = Rounded::exact(render[first as usize + at(pixel)]);
        pixel_ray::<Rounded>(pixel, focal, principal_point).map(|ray| depth * ray)
    };
    let nothing = (Rounded::default(), [[Rounded::default(); 3]; 2]);
    (0..size.element_product()).map(move |i| {
        let pixel = UVec2::new(i % size.x, i / size.x);
        let is_inside = pixel.min_element() > 0 && (pixel + 1).cmplt(size).all();
        if !is_inside || normals[i as usize] == NO_NORMAL {
            return nothing;
        }
        let [right, down] = [UVec2::X, UVec2::Y];
        let around = [pixel - right, pixel + right, pixel - down, pixel + down, pixel];
        let is_opaque = |pixel| transmittances[at(pixel)] <= MOST_TRANSMITTANCE as f32;
        if !around.into_iter().all(is_opaque) {
            return nothing;
        }
        let difference = |to, from| {
            let [to, from]: [Vector<Rounded>; 2] = [to, from].map(point);
            [0, 1, 2].map(|c| to[c] - from[c])
        };
        let [left, right, above, below, _] = around;
        let (u, v) = (difference(right, left), difference(below, above));
        normal_loss(u, v, map_normal(normals[i as usize])).unwrap_or(nothing)
    })
}

/// The differences' gradients as they are stored, with the zeros that fill up their vectors.
fn stored([u, v]: [Vector<Rounded>; 2]) -> [Rounded; 8] {
    let zero = Rounded::default();
    [u[0], u[1], u[2], zero, v[0], v[1], v[2], zero]
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let (values, gradients): (Vec<_>, Vec<_>) = losses(params, &slices).unzip();
        let numbers = gradients.into_iter().flat_map(stored);
        write(numbers, slices.d_differences);
        write_sum(values.into_iter().map(|value| value.value), slices.partials);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (values, gradients): (Vec<_>, Vec<_>) = losses(params, &slices).unzip();
        let chain = chain(0) + f64::from(constants.values_per_thread);
        Tolerances {
            d_differences: gradients.into_iter().flat_map(stored).collect(),
            partials: sum_tolerance(chain, values),
        }
    }
}
