//! From the gradients of a splat to those of its Gaussian, in f64.

use glam::{DMat3, DVec2, DVec3, DVec4};

use super::camera::{Camera, rotation, unit_quat};
use super::gaussian::{Gaussian, Planes, sigmoid};
use super::sh::{sh_basis, sh_basis_gradient};
use super::splat::Splat;
use crate::gpu::Reference;
use crate::kernels::project_backward::{Constants, Kernel, Params, Slices};
use crate::kernels::splat::RECORD_HEAD;

/// The gradients that arrive at one splat.
#[derive(Clone, Debug)]
pub struct DSplat {
    /// 1 / pixels.
    pub mean2d: DVec2,
    /// (xx, xy, yy), pixels^2.
    pub conic: DVec3,
    /// Of the opacity after the sigmoid.
    pub opacity: f64,
    /// RGB; zero where the colour was clamped.
    pub color: DVec3,
    /// Of what is blended beside colour.
    pub features: Vec<f64>,
}

/// The gradients of a Gaussian's attributes from those of the splat it became.
pub fn project_gaussian_backward(
    camera: &Camera,
    sh_degree: u32,
    gaussian: &Gaussian,
    splat: &Splat,
    d_splat: &DSplat,
) -> Gaussian {
    let mean_in_view = camera.view(gaussian.mean);
    let z = mean_in_view.z;
    let free_slope = mean_in_view.truncate() / z;
    let slope = camera.clamped_slope(mean_in_view);
    let unit = unit_quat(gaussian.quat);
    let scale = gaussian.log_scale.exp();
    let scaled_axes = rotation(unit) * DMat3::from_diagonal(scale);
    let world_from_view = camera.rotation.transpose();
    let t0 = world_from_view * (camera.focal.x / z * DVec3::new(1.0, 0.0, -slope.x));
    let t1 = world_from_view * (camera.focal.y / z * DVec3::new(0.0, 1.0, -slope.y));
    let (u0, u1) = (scaled_axes.transpose() * t0, scaled_axes.transpose() * t1);

    let [a, b, c] = splat.conic.to_array();
    let d_conic = d_splat.conic;
    let d_xx = -(a * a * d_conic.x + a * b * d_conic.y + b * b * d_conic.z);
    let d_xy = -(2.0 * a * b * d_conic.x + (a * c + b * b) * d_conic.y + 2.0 * b * c * d_conic.z);
    let d_yy = -(b * b * d_conic.x + b * c * d_conic.y + c * c * d_conic.z);
    let d_u0 = 2.0 * d_xx * u0 + d_xy * u1;
    let d_u1 = 2.0 * d_yy * u1 + d_xy * u0;

    let d_scaled_axes = outer_product(t0, d_u0) + outer_product(t1, d_u1);
    let d_log_scale =
        DVec3::from_array([0, 1, 2].map(|k| d_scaled_axes.col(k).dot(scaled_axes.col(k))));
    let d_unit = rotation_backward(unit, d_scaled_axes * DMat3::from_diagonal(scale));
    let norm = gaussian.quat.length();
    let d_quat = if norm > 1e-12 { (d_unit - unit * unit.dot(d_unit)) / norm } else { DVec4::ZERO };

    let d_j0 = camera.rotation * (scaled_axes * d_u0);
    let d_j1 = camera.rotation * (scaled_axes * d_u1);
    let mut d_slope = -camera.focal / z * DVec2::new(d_j0.z, d_j1.z);
    for axis in 0..2 {
        if free_slope[axis] != slope[axis] {
            d_slope[axis] = 0.0;
        }
    }
    let d_xy_view = (camera.focal * d_splat.mean2d + d_slope) / z;
    let d_inverse_z =
        camera.focal.x * (d_j0.x - slope.x * d_j0.z) + camera.focal.y * (d_j1.y - slope.y * d_j1.z);
    let d_z = -d_inverse_z / (z * z) - d_xy_view.dot(free_slope);

    let (d_mean_sh, d_sh) =
        sh_backward(sh_degree, &gaussian.sh, gaussian.mean - camera.center(), d_splat.color);
    let opacity = sigmoid(gaussian.raw_opacity);
    Gaussian {
        mean: world_from_view * d_xy_view.extend(d_z) + d_mean_sh,
        quat: d_quat,
        log_scale: d_log_scale,
        raw_opacity: d_splat.opacity * opacity * (1.0 - opacity),
        features: d_splat.features.clone(),
        sh: d_sh,
    }
}

/// The gradient of the mean through the viewing direction, and those of the SH coefficients.
fn sh_backward(degree: u32, sh: &[DVec3], offset: DVec3, d_color: DVec3) -> (DVec3, Vec<DVec3>) {
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

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { parameters, splats, colors, tile_counts, d_splats, status, .. } = slices;
        let Slices { gradients, grad_norm_sums, visit_counts, .. } = slices;
        let camera = Camera::from(&params.camera);
        let (channels, sh_degree) = (constants.channels as usize, constants.sh_degree);
        let feature_count = channels - 3;
        let planes = Planes { count: params.gaussian_count as usize, feature_count, sh_degree };
        let raw_colors = constants.raw_colors;
        let head = RECORD_HEAD as usize;
        let record = head + channels;
        gradients[..planes.len()].fill(0.0);
        for i in 0..planes.count {
            if tile_counts[i] == 0 {
                continue;
            }
            let d: Vec<f64> = d_splats[record * i..][..record].iter().map(|&d| d.into()).collect();
            let is_free = |c: usize| raw_colors || colors[channels * i + c] > 0.0;
            let passes = |c: usize| if is_free(c) { d[head + c] } else { 0.0 };
            let d_splat = DSplat {
                mean2d: DVec2::from_slice(&d[0..2]),
                conic: DVec3::from_slice(&d[2..5]),
                opacity: d[5],
                color: DVec3::from_array([0, 1, 2].map(passes)),
                features: d[head + 3..].to_vec(),
            };
            let gaussian = planes.load(parameters, i);
            let splat = Splat::from(&splats[i]);
            let gradient =
                project_gaussian_backward(&camera, params.sh_degree, &gaussian, &splat, &d_splat);
            planes.store(&gradient, i, |at, value| gradients[at] = value as f32);

            if status[0] == 0 {
                let depth = camera.view(gaussian.mean).z;
                let weight = f64::from(params.damping_weight);
                let nearness = (depth / f64::from(params.damping_depth)).min(1.0);
                let damping = weight * nearness * nearness + 1.0 - weight;
                let norm = (0.5 * camera.size * d_splat.mean2d).length();
                grad_norm_sums[i] += (damping * norm) as f32;
                visit_counts[i] += 1;
            }
        }
    }
}
