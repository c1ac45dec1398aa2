//! One Gaussian from world space to the image plane, in f64.

use glam::{DMat3, DVec2, DVec3, UVec2};

use super::camera::{Camera, rotation, unit_quat};
use super::gaussian::{Gaussian, Planes, sigmoid};
use super::sh::sh_basis;
use super::splat::{Splat, splat_tile_rows, splat_tiles};
use crate::gpu::Reference;
use crate::kernels::ProjectedSplat;
use crate::kernels::project::{CULLED, Constants, Kernel, Params, Slices};
use crate::kernels::splat::{ALPHA_MIN, DILATION};

/// What one Gaussian is on the image plane.
#[derive(Clone, Debug)]
pub struct Projection {
    /// Its light.
    pub splat: Splat,
    /// Pixels: the box around the ellipse alpha = 1/255.
    pub half_extent: DVec2,
    /// RGB; not below zero, but for raw colours.
    pub color: DVec3,
    /// z in the view, world units.
    pub depth: f64,
}

/// Projects one Gaussian with SH up to `sh_degree`; `None` where it is culled. Raw colours are the bare SH sum.
pub fn project_gaussian(
    camera: &Camera,
    near: f64,
    sh_degree: u32,
    raw_colors: bool,
    gaussian: &Gaussian,
) -> Option<Projection> {
    let mean_in_view = camera.view(gaussian.mean);
    let depth = mean_in_view.z;
    let opacity = sigmoid(gaussian.raw_opacity);
    if !(depth > near && opacity > ALPHA_MIN) {
        return None;
    }

    let slope = camera.clamped_slope(mean_in_view);
    let scale = DMat3::from_diagonal(gaussian.log_scale.exp());
    let view_axes = camera.rotation * rotation(unit_quat(gaussian.quat)) * scale;
    let rows = view_axes.transpose();
    let u0 = camera.focal.x / depth * (rows * DVec3::new(1.0, 0.0, -slope.x));
    let u1 = camera.focal.y / depth * (rows * DVec3::new(0.0, 1.0, -slope.y));

    let (xx, xy, yy) = (u0.dot(u0), u0.dot(u1), u1.dot(u1));
    let normal = u0.cross(u1);
    let det = normal.dot(normal) + DILATION * (xx + yy) + DILATION * DILATION;
    let cov2d = DVec3::new(xx + DILATION, xy, yy + DILATION);
    let mean2d = camera.focal * mean_in_view.truncate() / depth + camera.principal_point;
    if !(det < 1e30 && mean2d.abs().cmplt(DVec2::splat(1e30)).all()) {
        return None;
    }

    let conic = DVec3::new(cov2d.z, -cov2d.y, cov2d.x) / det;
    let level = 2.002 * (255.0 * opacity).ln() + 1e-3;
    let half_extent = DVec2::new((level * cov2d.x).sqrt(), (level * cov2d.z).sqrt()) + 0.01;

    let basis = sh_basis(sh_degree, (gaussian.mean - camera.center()).normalize());
    let color: DVec3 = gaussian.sh.iter().zip(basis).map(|(&c, b)| b * c).sum();
    Some(Projection {
        splat: Splat { mean2d, conic, opacity },
        half_extent,
        color: if raw_colors { color } else { (color + 0.5).max(DVec3::ZERO) },
        depth,
    })
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { parameters, splats, colors, depth_keys, ids, tile_counts } = slices;
        let camera = Camera::from(&params.camera);
        let (size, near) = (params.camera.size, params.near);
        let (channels, sh_degree) = (constants.channels as usize, constants.sh_degree);
        let feature_count = channels - 3;
        let planes = Planes { count: params.gaussian_count as usize, feature_count, sh_degree };
        let raw_colors = constants.raw_colors;
        let tile = UVec2::new(constants.tile_width, constants.tile_height);
        for i in 0..planes.count {
            ids[i] = i as u32;
            depth_keys[i] = CULLED;
            tile_counts[i] = 0;
            let gaussian = planes.load(parameters, i);
            let Some(projection) =
                project_gaussian(&camera, near.into(), params.sh_degree, raw_colors, &gaussian)
            else {
                continue;
            };
            splats[i] = ProjectedSplat {
                mean2d: projection.splat.mean2d.as_vec2(),
                conic: projection.splat.conic.as_vec3(),
                opacity: projection.splat.opacity as f32,
                half_extent: projection.half_extent.as_vec2(),
            };
            let values = projection.color.to_array().into_iter().chain(gaussian.features);
            for (color, value) in colors[channels * i..].iter_mut().zip(values) {
                *color = value as f32;
            }
            let [top, bottom] = splat_tile_rows(&splats[i], size.y, tile);
            for row in top..bottom {
                let [first, end] = splat_tiles(&splats[i], row, size.x, tile);
                tile_counts[i] += end - first;
            }
            if tile_counts[i] > 0 {
                depth_keys[i] = (projection.depth as f32).to_bits();
            }
        }
    }
}
