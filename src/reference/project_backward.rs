//! From the records of a splat to the gradients of its Gaussian, in f64.

use glam::{DMat3, DVec2, DVec3, DVec4, UVec2};
use nightsplat_models::attributes::{Attribute, column_count};

use super::camera::ReferenceCamera;
use super::gaussian::{Gaussian, Planes, Words, sigmoid};
use super::lamp::ReferenceLamp;
use super::rotation::{rotation, unit_quat};
use super::rounding::{Rounded, UNIT, chain, sensitivity};
use super::sh::{sh_basis, sh_basis_gradient};
use super::splat::{Splat, stored_color, stored_record};
use crate::gpu::{Reference, Tolerance};
use crate::kernels;
use crate::kernels::project_backward::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::shared_intersections::SHARED_INTERSECTIONS;
use crate::kernels::splat::{DILATION, RECORD_HEAD};
use crate::kernels::status::STATUS_GRADIENT;
use crate::splats::batches::frozen_floats;

/// The gradients that arrive at one splat.
#[derive(Clone, Debug)]
pub struct DSplat {
    /// 1 / pixels.
    pub mean2d: DVec2,
    /// (xx, xy, yy), pixels^2.
    pub conic: DVec3,
    /// With respect to the opacity after the sigmoid.
    pub opacity: f64,
    /// RGB; zero if the colour was clamped.
    pub color: DVec3,
    /// With respect to the features.
    pub features: Vec<f64>,
    /// With respect to the depth in the view, where that is a channel.
    pub depth: f64,
    /// The sum over the pixels of |dL/dsigma|.
    pub magnitudes: f64,
}

impl DSplat {
    /// The statistic of density control: the norm of the gradient of the mean, in units of `1 / half_view`; or the sum
    /// of the norms of all pixels, with the root of the mean square of conic times offset.
    pub fn norm(&self, splat: &Splat, half_view: DVec2, adds_pixels: bool) -> f64 {
        let DVec3 { x, z, .. } = splat.conic;
        let of_pixels = self.magnitudes * DVec2::new(x.sqrt(), z.sqrt());
        (half_view * if adds_pixels { of_pixels } else { self.mean2d }).length()
    }
}

/// A colour that a lamp lights.
#[derive(Clone, Copy, Debug)]
pub struct Lit {
    /// The lamp.
    pub lamp: ReferenceLamp,
    /// RGB, lit.
    pub color: DVec3,
}

/// The gradients of a splat's mean, conic and opacity from the moments of dL/dsigma that are first in its record.
pub fn splat_gradient(splat: &Splat, record: &[f64]) -> (DVec2, DVec3, f64) {
    let [a, b, c] = splat.conic.to_array();
    let &[moment, x, y, xx, xy, yy, ..] = record else { panic!("a record has six moments") };
    let mean2d = DVec2::new(a * x + b * y, b * x + c * y);
    (mean2d, DVec3::new(0.5 * xx, xy, 0.5 * yy), -moment / splat.opacity)
}

/// The gradients of a Gaussian's attributes from those of its splat.
pub fn project_gaussian_backward(
    camera: &ReferenceCamera,
    sh_degree: u32,
    antialiased: bool,
    gaussian: &Gaussian,
    (splat, lit): (&Splat, Option<Lit>),
    d_splat: &DSplat,
) -> Gaussian {
    let mean_in_view = camera.view(gaussian.mean);
    let unit = unit_quat(gaussian.quat);
    let scale = gaussian.log_scale.exp();
    let scaled_axes = rotation(unit) * DMat3::from_diagonal(scale);
    let world_from_view = camera.rotation.transpose();
    let [t0, t1] = camera.jacobian(mean_in_view).map(|row| world_from_view * row);
    let (u0, u1) = (scaled_axes.transpose() * t0, scaled_axes.transpose() * t1);

    let d_dimming = if antialiased { d_splat.opacity * splat.opacity } else { 0.0 };
    let (d_u0, d_u1, d_log_scale) =
        rows_backward(splat.conic, [u0, u1], (d_splat.conic, d_dimming));

    let d_scaled_axes = outer_product(t0, d_u0) + outer_product(t1, d_u1);
    let d_unit = rotation_backward(unit, d_scaled_axes * DMat3::from_diagonal(scale));
    let norm = gaussian.quat.length();
    let d_quat = if norm > 1e-12 { (d_unit - unit * unit.dot(d_unit)) / norm } else { DVec4::ZERO };

    let d_rows = [d_u0, d_u1].map(|d_u| camera.rotation * (scaled_axes * d_u));
    let mut d_mean_in_view = camera.backward(mean_in_view, d_splat.mean2d, d_rows);
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    d_mean_in_view +=
        d_splat.depth * DVec3::from_array(axes.map(|axis| camera.depth_change(mean_in_view, axis)));
    let unlit = |Lit { lamp, color }| lamp.lit_backward(color, d_splat.color, mean_in_view);
    let (d_color, d_point) = lit.map_or((d_splat.color, DVec3::ZERO), unlit);
    d_mean_in_view += d_point;

    let (d_mean_sh, d_sh) =
        sh_backward(sh_degree, &gaussian.sh, gaussian.mean - camera.center(), d_color);
    let opacity = if antialiased { splat.opacity } else { sigmoid(gaussian.raw_opacity) };
    Gaussian {
        mean: world_from_view * d_mean_in_view + d_mean_sh,
        quat: d_quat,
        log_scale: d_log_scale,
        raw_opacity: d_splat.opacity * opacity * sigmoid(-gaussian.raw_opacity),
        features: d_splat.features.clone(),
        sh: d_sh,
    }
}

/// From the gradients of a conic and of the logarithm of the compensation to those of the rows of U, where cov2d =
/// U U^T + 0.3 I, and of the logarithms of the scales.
fn rows_backward(
    conic: DVec3,
    [u0, u1]: [DVec3; 2],
    (d_conic, d_dimming): (DVec3, f64),
) -> (DVec3, DVec3, DVec3) {
    let [a, b, c] = conic.to_array();
    let normal = u0.cross(u1);
    let trace = u0.dot(u0) + u1.dot(u1);
    let undilated = normal.dot(normal);
    let det = undilated + DILATION * trace + DILATION * DILATION;
    let w0 = (u1.cross(normal) + DILATION * u0) / det;
    let w1 = (normal.cross(u0) + DILATION * u1) / det;
    let g0 = d_conic.x * w0 + 0.5 * d_conic.y * w1;
    let g1 = 0.5 * d_conic.y * w0 + d_conic.z * w1;
    let (mut d_u0, mut d_u1) = (-2.0 * (a * g0 + b * g1), -2.0 * (b * g0 + c * g1));
    let mut d_log_scale = -2.0 * (w0 * g0 + w1 * g1);
    if d_dimming != 0.0 {
        let by = [u1.cross(normal) / undilated - w0, normal.cross(u0) / undilated - w1];
        let [by_u0, by_u1] = by.map(|by| d_dimming * by);
        (d_u0, d_u1) = (d_u0 + by_u0, d_u1 + by_u1);
        d_log_scale += u0 * by_u0 + u1 * by_u1;
    }
    (d_u0, d_u1, d_log_scale)
}

/// The gradient of the mean through the viewing direction, and those of the SH coefficients.
pub(super) fn sh_backward(
    degree: u32,
    sh: &[DVec3],
    offset: DVec3,
    d_color: DVec3,
) -> (DVec3, Vec<DVec3>) {
    let distance = offset.length().max(1e-12);
    let direction = offset / distance;
    let basis = sh_basis(degree, direction);
    let basis_gradient = sh_basis_gradient(degree, direction);
    let d_direction: DVec3 =
        sh.iter().zip(basis_gradient).map(|(c, gradient)| c.dot(d_color) * gradient).sum();
    let d_mean = (d_direction - direction * direction.dot(d_direction)) / distance;
    (d_mean, basis[..sh.len()].iter().map(|b| b * d_color).collect())
}

/// The gradient of a unit quaternion's rotation matrix: each entry is dR/dq, summed over the matrix.
fn rotation_backward(q: DVec4, d: DMat3) -> DVec4 {
    let [w, x, y, z] = q.to_array();
    let d = d.to_cols_array_2d();
    2.0 * DVec4::new(
        x * (d[1][2] - d[2][1]) + y * (d[2][0] - d[0][2]) + z * (d[0][1] - d[1][0]),
        w * (d[1][2] - d[2][1]) - 2.0 * x * (d[1][1] + d[2][2])
            + y * (d[0][1] + d[1][0])
            + z * (d[0][2] + d[2][0]),
        w * (d[2][0] - d[0][2]) + x * (d[0][1] + d[1][0]) - 2.0 * y * (d[0][0] + d[2][2])
            + z * (d[1][2] + d[2][1]),
        w * (d[0][1] - d[1][0]) + x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1])
            - 2.0 * z * (d[0][0] + d[1][1]),
    )
}

/// `column` times the transpose of `row`.
fn outer_product(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

/// Numbers of a record before its channels.
const HEAD: usize = RECORD_HEAD as usize;

/// A view and its Gaussians.
struct BackwardInputs<'a> {
    params: &'a Params,
    constants: &'a Constants,
    camera: ReferenceCamera,
    lamp: Option<ReferenceLamp>,
    planes: Planes,
}

impl<'a> BackwardInputs<'a> {
    fn new(
        params: &'a Params,
        constants: &'a Constants,
        cameras: &[kernels::Camera],
        lamp: &[f32],
    ) -> Self {
        let Constants { channels, sh_degree, view_depths, .. } = *constants;
        let (count, channels) = (params.gaussian_count, channels - view_depths);
        let planes = Planes::new(count, channels, sh_degree, constants.rest_by_column);
        let camera = ReferenceCamera::from(&cameras[params.camera_index as usize]);
        let lamp = constants.lamp.then(|| ReferenceLamp::from_numbers(lamp));
        Self { params, constants, camera, lamp, planes }
    }

    /// The gradients in the `record` of Gaussian `i`; clamped colours have none.
    fn d_splat(&self, splat: &Splat, colors: &[f32], record: &[f64], i: usize) -> DSplat {
        let (mean2d, conic, opacity) = splat_gradient(splat, record);
        let color = &colors[stored_color(self.constants.channels) * i..];
        let is_free = |c: usize| self.constants.raw_colors || color[c] > 0.0;
        let passes = |c: usize| if is_free(c) { record[HEAD + c] } else { 0.0 };
        DSplat {
            mean2d,
            conic,
            opacity,
            color: DVec3::from_array([0, 1, 2].map(passes)),
            features: record[HEAD + 3..][..self.planes.feature_count].to_vec(),
            depth: if self.constants.view_depths == 0 { 0.0 } else { record[record.len() - 1] },
            magnitudes: record[6],
        }
    }

    /// `color`: of the forward pass.
    fn backward(
        &self,
        gaussian: &Gaussian,
        splat: &Splat,
        color: DVec3,
        d_splat: &DSplat,
    ) -> Gaussian {
        let (degree, antialiased) = (self.params.sh_degree, self.constants.antialiased);
        let splat = (splat, self.lamp.map(|lamp| Lit { lamp, color }));
        let of = |gaussian: &Gaussian| {
            project_gaussian_backward(&self.camera, degree, antialiased, gaussian, splat, d_splat)
        };
        if !self.constants.color_gradients {
            return of(gaussian);
        }
        // Of a colour that does not depend on the direction; in place of the coefficients, the gradient of the colour.
        let mut gradient = of(&Gaussian { sh: vec![gaussian.sh[0]], ..gaussian.clone() });
        let d_color = self.d_color(gaussian, d_splat.color, color);
        gradient.sh.extend((gaussian.sh.len() > 1).then_some(d_color));
        gradient
    }

    /// Calls `take` with the index of each gradient of Gaussian `i` in the planes of all parameters, and its value.
    fn store(&self, gradient: &Gaussian, i: usize, mut take: impl FnMut(usize, f64)) {
        let Planes { count, feature_count, rest_by_column, .. } = self.planes;
        let columns = self.written_columns();
        let indices = Words { count, feature_count, columns, rest_by_column }.of_gaussian(i);
        indices.zip(gradient.values()).for_each(|(at, value)| take(at, value));
    }

    /// The colour of Gaussian `i` in the forward pass.
    fn color(&self, colors: &[f32], i: usize) -> DVec3 {
        let color = &colors[stored_color(self.constants.channels) * i..];
        DVec3::from_array([0, 1, 2].map(|c| f64::from(color[c])))
    }

    /// The gradient of a colour without the lamp, from that of the lit one.
    fn d_color(&self, gaussian: &Gaussian, d_lit: DVec3, lit: DVec3) -> DVec3 {
        let point = self.camera.view(gaussian.mean);
        self.lamp.map_or(d_lit, |lamp| lamp.lit_backward(lit, d_lit, point).0)
    }

    /// Columns of gradients that are written; those of the colour are the first ones of their plane.
    fn written_columns(&self) -> usize {
        let Planes { feature_count, sh_degree, .. } = self.planes;
        let (columns, rest) =
            (column_count(feature_count, sh_degree), Attribute::Rest.column(feature_count));
        if self.constants.color_gradients { columns.min(rest + 3) } else { columns }
    }

    /// Floats of the planes before those of the gradients.
    fn left_out(&self) -> usize {
        frozen_floats(self.constants.frozen_columns, self.planes.count)
    }

    /// The rounding error of a quaternion's gradient, whose terms can cancel, as for a sphere, which has no gradient:
    /// its entries are sums of products with these magnitudes.
    fn quat_error(&self, gaussian: &Gaussian, splat: &Splat, d_splat: &DSplat) -> f64 {
        let ([a, b, c], d) = (splat.conic.abs().to_array(), d_splat.conic.abs());
        let d_xx = a * a * d.x + a * b * d.y + b * b * d.z;
        let d_xy = 2.0 * a * b * d.x + (a * c + b * b) * d.y + 2.0 * b * c * d.z;
        let d_yy = b * b * d.x + b * c * d.y + c * c * d.z;
        let mean_in_view = self.camera.view(gaussian.mean);
        let t = DVec2::from_array(self.camera.jacobian(mean_in_view).map(DVec3::length));
        let scale = gaussian.log_scale.max_element().exp();
        let d_u = DVec2::new(2.0 * d_xx * t.x + d_xy * t.y, 2.0 * d_yy * t.y + d_xy * t.x);
        // Of the compensation, d_u is the product of U and the difference of two inverse covariances.
        let dimming =
            if self.constants.antialiased { d_splat.opacity * splat.opacity } else { 0.0 };
        let dimmed = 2.0 * dimming.abs() * DILATION * (a + c) * (a + c);
        let d_u = d_u + t * dimmed;
        512.0 * UNIT * scale * scale * t.dot(d_u) / gaussian.quat.length().max(1e-12)
    }

    /// The increment of the statistics of density control.
    fn damped_norm(&self, gaussian: &Gaussian, splat: &Splat, d_splat: &DSplat) -> f64 {
        let Params { damping_weight, damping_depth, adds_pixels, .. } = *self.params;
        let (weight, depth) =
            (f64::from(damping_weight), self.camera.depth(self.camera.view(gaussian.mean)));
        let nearness = (depth / f64::from(damping_depth)).min(1.0);
        let damping = weight * nearness * nearness + 1.0 - weight;
        damping * d_splat.norm(splat, self.params.half_view.as_dvec2(), adds_pixels != 0)
    }
}

/// The sum of the records of a Gaussian with these slots. Those of few slots are added in f32 in the kernel's exact
/// order; those of many by the lanes of a subgroup, in an order that depends on the device.
fn summed_record(channels: u32, intersection_ids: UVec2, gradient_records: &[f32]) -> Vec<Rounded> {
    let intersection_ids = intersection_ids.x as usize..intersection_ids.y as usize;
    let sum = |k: usize| {
        let numbers = intersection_ids
            .clone()
            .map(|slot| gradient_records[stored_record(channels) * slot + k]);
        if intersection_ids.len() <= SHARED_INTERSECTIONS as usize {
            return Rounded::exact(numbers.fold(0.0, |sum, number| sum + number));
        }
        let magnitudes: f64 = numbers.clone().map(|number| f64::from(number.abs())).sum();
        let sum = Rounded::exact(numbers.map(f64::from).sum::<f64>() as f32);
        Rounded { error: UNIT * chain(intersection_ids.len()) * magnitudes, ..sum }
    };
    (0..HEAD + channels as usize).map(sum).collect()
}

fn values(record: &[Rounded]) -> Vec<f64> {
    record.iter().map(|number| number.value).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { splats, colors, intersection_ranges, gradient_records, .. } = slices;
        let Slices { status, gradients, grad_norm_sums, visit_counts, .. } = slices;
        // From before the pass, since the device may process Gaussians in any order.
        let before = status[3];
        let scene = BackwardInputs::new(params, constants, slices.cameras, slices.lamp);
        let (planes, parameters) = scene.planes.floats(slices.parameters, constants.half_rest);
        let written = scene.written_columns() * scene.planes.count;
        let frozen = constants.frozen_columns as usize * scene.planes.count;
        let left_out = scene.left_out();
        gradients[frozen - left_out..written - left_out].fill(0.0);
        for i in (0..scene.planes.count).filter(|&i| slices.tile_counts[i] > 0) {
            let record =
                summed_record(constants.channels, intersection_ranges[i], gradient_records);
            let splat = Splat::from(&splats[i]);
            let d_splat = scene.d_splat(&splat, colors, &values(&record), i);
            let gaussian = planes.load(&parameters, i);
            let color = scene.color(colors, i);
            let gradient = scene.backward(&gaussian, &splat, color, &d_splat);
            let d_color = scene.d_color(&gaussian, d_splat.color, color);
            let mut is_finite = (8.0 * d_color.as_vec3()).is_finite();
            scene.store(&gradient, i, |at, value| {
                let value = value as f32;
                is_finite &= value.is_finite() || at < frozen;
                if (frozen..written).contains(&at) {
                    gradients[at - left_out] = value;
                }
            });
            if !is_finite {
                status[0] |= if before & !STATUS_GRADIENT == 0 { STATUS_GRADIENT } else { 0 };
            } else if before == 0 && frozen == 0 {
                grad_norm_sums[i] += scene.damped_norm(&gaussian, &splat, &d_splat) as f32;
                visit_counts[i] += 1;
            }
        }
    }

    /// Backward stability: the kernel returns the reference's result for inputs that are off by some roundings each.
    /// Attributes also pass through sums and exponentials with terms of order one, means through the view.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        const OFF: f64 = 256.0 * UNIT;
        let scene = BackwardInputs::new(params, constants, slices.cameras, slices.lamp);
        let (planes, parameters) = scene.planes.floats(slices.parameters, constants.half_rest);
        let one = Planes { count: 1, ..planes };
        let far = scene.camera.center().length();
        let [mut gradients, mut grad_norm_sums] =
            [scene.planes.float_count(), scene.planes.count].map(|len| vec![0.0; len]);
        for i in (0..scene.planes.count).filter(|&i| slices.tile_counts[i] > 0) {
            let gaussian = planes.load(&parameters, i);
            let (splat, color) = (Splat::from(&slices.splats[i]), scene.color(slices.colors, i));
            let mut inputs = vec![0.0; one.float_count()];
            one.store(&gaussian, 0, |at, value| inputs[at] = value);
            inputs.extend(splat.conic.to_array());
            let record = summed_record(
                constants.channels,
                slices.intersection_ranges[i],
                slices.gradient_records,
            );
            inputs.extend(values(&record));
            let attributes = one.float_count();
            let of_input = |(at, input): (usize, &f64)| {
                let beside = if at < 3 { far } else { 0.0 };
                OFF * (input.abs() + beside + if at < attributes { 1.0 } else { 0.0 })
            };
            let mut errors: Vec<f64> = inputs.iter().enumerate().map(of_input).collect();
            let of_record = errors[attributes + 3..].iter_mut().zip(&record);
            of_record.for_each(|(error, sum)| *error += sum.error);
            let bounds = sensitivity(&inputs, &errors, |inputs| {
                let (gaussian, rest) = inputs.split_at(attributes);
                let splat = Splat { conic: DVec3::from_slice(rest), ..splat };
                let (gaussian, d_splat) =
                    (one.load(gaussian, 0), scene.d_splat(&splat, slices.colors, &rest[3..], i));
                let gradient = scene.backward(&gaussian, &splat, color, &d_splat);
                let mut numbers = vec![0.0; attributes + 1];
                one.store(&gradient, 0, |at, value| numbers[at] = value);
                numbers[attributes] = scene.damped_norm(&gaussian, &splat, &d_splat);
                numbers
            });
            let d_splat = scene.d_splat(&splat, slices.colors, &values(&record), i);
            let gradient = scene.backward(&gaussian, &splat, color, &d_splat);
            scene.store(&gradient, i, |at, value| gradients[at] = OFF * value.abs());
            let mut moved = one.load(&bounds, 0);
            // A basis is a polynomial of magnitude 3 and degree 3, which may vanish.
            let point = scene.camera.view(gaussian.mean);
            let [by_lamp, factor] = scene
                .lamp
                .map_or([0.0; 2], |lamp| lamp.lit_backward_error(color, d_splat.color, point));
            moved.mean += by_lamp;
            let d_color = scene.d_color(&gaussian, d_splat.color, color);
            let basis = (64.0 * UNIT + factor) * d_color.abs();
            moved.sh.iter_mut().for_each(|bound| *bound += basis);
            moved.quat += scene.quat_error(&gaussian, &splat, &d_splat);
            scene.store(&moved, i, |at, bound| gradients[at] += bound);
            let norm = scene.damped_norm(&gaussian, &splat, &d_splat);
            let sum = f64::from(slices.grad_norm_sums[i].abs()) + norm;
            grad_norm_sums[i] = bounds[attributes] + 16.0 * UNIT * norm + 2.0 * UNIT * sum;
        }
        Tolerances {
            gradients: Tolerance::Each(gradients.split_off(scene.left_out())),
            grad_norm_sums: Tolerance::Each(grad_norm_sums),
            ..Tolerances::default()
        }
    }
}
