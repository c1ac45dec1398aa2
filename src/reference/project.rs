//! One Gaussian from world space to the image plane, in f64.

use glam::{DMat3, DVec2, DVec3, DVec4, UVec2, Vec4};

use super::camera::ReferenceCamera;
use super::gaussian::{Gaussian, Planes, sigmoid};
use super::lamp::ReferenceLamp;
use super::rotation::{rotation, unit_quat};
use super::rounding::{UNIT, sensitivity};
use super::sh::sh_basis;
use super::splat::{Splat, extent_error, splat_level, splat_tile_rows, splat_tiles, stored_color};
use crate::gpu::{Kernel as _, Reference, Tolerance};
use crate::kernels::camera::NEAREST;
use crate::kernels::project::{CULLED, Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::splat::{ALPHA_MIN, DILATION};
use crate::kernels::{self, InstanceView, ProjectedSplat};

/// The projection of one Gaussian onto the image plane.
#[derive(Clone, Debug)]
pub struct Projection {
    /// Mean, conic and opacity.
    pub splat: Splat,
    /// Pixels: the box around the ellipse alpha = 1/255.
    pub half_extent: DVec2,
    /// RGB; not below zero, except for raw colours.
    pub color: DVec3,
    /// In the camera model's definition, world units.
    pub depth: f64,
    /// The rounding errors of the compensation, in units of one rounding of it: a thin splat's determinant cancels.
    pub conditioning: f64,
}

/// How Gaussians are projected.
#[derive(Clone, Copy, Debug)]
pub struct ProjectionSettings {
    /// World units.
    pub near: f64,
    /// The SH degree in use.
    pub sh_degree: u32,
    /// Colours are the bare SH sum.
    pub raw_colors: bool,
    /// Opacities are compensated for the dilation.
    pub antialiased: bool,
    /// Lights the colours.
    pub lamp: Option<ReferenceLamp>,
}

/// Projects one Gaussian; `None` if it is culled.
pub fn project_gaussian(
    camera: &ReferenceCamera,
    settings: ProjectionSettings,
    gaussian: &Gaussian,
) -> Option<Projection> {
    let ProjectionSettings { near, sh_degree, raw_colors, antialiased, lamp } = settings;
    let mean_in_view = camera.view(gaussian.mean);
    let depth = camera.depth(mean_in_view);
    let mut opacity = sigmoid(gaussian.raw_opacity);
    if !(depth > near && opacity > ALPHA_MIN) {
        return None;
    }

    let scale = DMat3::from_diagonal(gaussian.log_scale.exp());
    let view_axes = camera.rotation * rotation(unit_quat(gaussian.quat)) * scale;
    let rows = view_axes.transpose();
    let [u0, u1] = camera.jacobian(mean_in_view).map(|row| rows * row);

    let (xx, xy, yy) = (u0.dot(u0), u0.dot(u1), u1.dot(u1));
    let normal = u0.cross(u1);
    let det = normal.dot(normal) + DILATION * (xx + yy) + DILATION * DILATION;
    let cov2d = DVec3::new(xx + DILATION, xy, yy + DILATION);
    let mean2d = camera.project(mean_in_view);
    if !(det < 1e30 && mean2d.abs().cmplt(DVec2::splat(1e30)).all()) {
        return None;
    }
    if antialiased {
        opacity *= (normal.dot(normal) / det).sqrt();
        if opacity.is_nan() || opacity <= ALPHA_MIN {
            return None;
        }
    }

    let conic = DVec3::new(cov2d.z, -cov2d.y, cov2d.x) / det;
    let level = 2.002 * (255.0 * opacity).ln() + 1e-3;
    let half_extent = DVec2::new((level * cov2d.x).sqrt(), (level * cov2d.z).sqrt()) + 0.01;

    let basis = sh_basis(sh_degree, camera.direction(gaussian.mean).normalize());
    let color: DVec3 = gaussian.sh.iter().zip(basis).map(|(&c, b)| b * c).sum();
    let color = if raw_colors { color } else { color + 0.5 };
    let color = lamp.map_or(color, |lamp| lamp.lit(color, mean_in_view));
    Some(Projection {
        splat: Splat { mean2d, conic, opacity },
        half_extent,
        color: if raw_colors { color } else { color.max(DVec3::ZERO) },
        depth,
        conditioning: if antialiased { (xx * yy).sqrt() / normal.length() } else { 0.0 },
    })
}

impl Projection {
    /// In the layout of the kernel.
    fn stored(&self) -> ProjectedSplat {
        ProjectedSplat {
            mean2d: self.splat.mean2d.as_vec2(),
            conic: self.splat.conic.as_vec3(),
            opacity: self.splat.opacity as f32,
            half_extent: self.half_extent.as_vec2(),
        }
    }

    /// mean2d, half extent, conic, opacity, colour, depth.
    fn numbers(&self) -> [f64; 12] {
        let Splat { mean2d, conic, opacity } = self.splat;
        let ([x, y], [a, b, c]) = (mean2d.to_array(), conic.to_array());
        let ([w, h], [r, g, blue]) = (self.half_extent.to_array(), self.color.to_array());
        [x, y, w, h, a, b, c, opacity, r, g, blue, self.depth]
    }
}

/// The key by which visible Gaussians are sorted.
fn depth_key(depth: f32, near: f32) -> u32 {
    let nearest = near.max(NEAREST as f32);
    let beyond = depth.max(nearest).to_bits() - nearest.to_bits();
    (beyond >> 4).min(CULLED - 1)
}

/// The keys of positive numbers differ by sixteenths of their difference in units in the last place.
fn key_error(depth: f32, error: f64) -> f64 {
    let last_place = f64::from(depth.next_up()) - f64::from(depth);
    1.0 + (1.0 + error / last_place) / 16.0
}

/// The tiles of an image that a splat covers.
fn tile_count(size: UVec2, constants: &Constants, splat: &ProjectedSplat) -> u32 {
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    let [top, bottom] = splat_tile_rows(splat, size.y, tile);
    let row = |row| {
        let [first, end] = splat_tiles(splat, row, size.x, tile);
        end - first
    };
    (top..bottom).map(row).sum()
}

/// The instances of a dispatch; without any, the model itself.
fn instances<'a>(
    params: &Params,
    constants: &Constants,
    table: &'a [InstanceView],
) -> Vec<Option<&'a InstanceView>> {
    if !constants.instances {
        return vec![None];
    }
    let [first, count] = [params.first_instance, params.instance_count].map(|n| n as usize);
    table[first..first + count].iter().map(Some).collect()
}

/// A view and its Gaussians.
struct ProjectionInputs<'a> {
    params: &'a Params,
    constants: &'a Constants,
    /// Size of the image, pixels.
    size: UVec2,
    camera: ReferenceCamera,
    lamp: Option<ReferenceLamp>,
    planes: Planes,
    instance: Option<&'a InstanceView>,
    /// The splat of the first Gaussian.
    first: usize,
    /// Factors of the colour and of the opacity.
    tint: DVec4,
}

impl<'a> ProjectionInputs<'a> {
    fn new(
        params: &'a Params,
        constants: &'a Constants,
        cameras: &[kernels::Camera],
        lamp: &[f32],
        instance: Option<&'a InstanceView>,
    ) -> Self {
        let Constants { channels, sh_degree, view_depths, .. } = *constants;
        let planes = Planes::new(
            params.gaussian_count,
            channels - view_depths,
            sh_degree,
            constants.rest_by_column,
        );
        let mut camera = cameras[params.camera_index as usize];
        if let Some(instance) = instance {
            camera.view_from_world = instance.view_from_model;
        }
        let (size, camera) = (camera.size, ReferenceCamera::from(&camera));
        let lamp = constants.lamp.then(|| ReferenceLamp::from_numbers(lamp));
        let first = instance.map_or(0, |instance| {
            (instance.first + params.first_gaussian - params.first_splat) as usize
        });
        let tint = instance.map_or(DVec4::ONE, |instance| Vec4::from(instance.tint).as_dvec4());
        Self { params, constants, size, camera, lamp, planes, instance, first, tint }
    }

    /// Whether an instance shows no Gaussian there.
    fn is_clipped(&self, gaussian: &Gaussian) -> bool {
        self.instance.is_some_and(|instance| {
            let mean = gaussian.mean.as_vec3();
            !(mean.cmpge(instance.box_min).all() && mean.cmple(instance.box_max).all())
        })
    }

    /// The depth of a Gaussian in the order that several views share.
    fn shared_depth(&self, gaussian: &Gaussian) -> f64 {
        let axis = Vec4::from(self.params.sort_axis).as_dvec4();
        axis.dot(self.camera.view(gaussian.mean).extend(1.0))
    }

    fn project(&self, gaussian: &Gaussian) -> Option<Projection> {
        let Params { near, sh_degree, .. } = *self.params;
        let Constants { raw_colors, antialiased, .. } = *self.constants;
        let (near, lamp) = (near.into(), self.lamp);
        let settings = ProjectionSettings { near, sh_degree, raw_colors, antialiased, lamp };
        if self.instance.is_none() {
            return project_gaussian(&self.camera, settings, gaussian);
        }
        let opacity = self.tint.w * sigmoid(gaussian.raw_opacity);
        let raw_opacity = (opacity / (1.0 - opacity)).ln();
        let tinted = Gaussian { raw_opacity, ..gaussian.clone() };
        let projection = project_gaussian(&self.camera, settings, &tinted)?;
        Some(Projection { color: self.tint.truncate() * projection.color, ..projection })
    }

    /// The error bound of its key: the depth is a sum of products of a few times the distance.
    fn shared_key_error(&self, gaussian: &Gaussian) -> f64 {
        let nearest = self.params.near.max(NEAREST as f32);
        let depth = (self.shared_depth(gaussian) as f32).max(nearest);
        let far = gaussian.mean.length() + self.camera.center().length();
        let scale = self.camera.rotation.x_axis.length().max(1.0);
        key_error(depth, 64.0 * UNIT * far * scale)
    }

    /// The error bound of each of [`Projection::numbers`]: the kernel computes them for a Gaussian that is off by a few
    /// roundings, including exponentials, and rounds them a few times. `None` if that decides whether the Gaussian is
    /// culled.
    fn errors(&self, gaussian: &Gaussian) -> Option<[f64; 12]> {
        let Gaussian { mean, quat, log_scale, raw_opacity, .. } = gaussian;
        let far = mean.length() + self.camera.center().length();
        let mut inputs = mean.to_array().to_vec();
        inputs.extend(quat.to_array());
        inputs.extend(log_scale.to_array());
        inputs.push(*raw_opacity);
        let errors: Vec<f64> = (0..inputs.len())
            .map(|at| match at {
                0..3 => 16.0 * UNIT * far,
                3..7 => 16.0 * UNIT * quat.length(),
                _ => (16.0 + 8.0 * inputs[at].abs()) * UNIT,
            })
            .collect();
        let project = |inputs: &[f64]| {
            self.project(&Gaussian {
                mean: DVec3::from_slice(inputs),
                quat: DVec4::from_slice(&inputs[3..]),
                log_scale: DVec3::from_slice(&inputs[7..]),
                raw_opacity: inputs[10],
                ..gaussian.clone()
            })
        };
        let is_culled = |inputs: &[f64]| project(inputs).is_none();
        let is_fragile = (0..inputs.len()).any(|at| {
            let mut moved = inputs.clone();
            [errors[at], -errors[at]].into_iter().any(|error| {
                moved[at] = inputs[at] + error;
                is_culled(&moved) != is_culled(&inputs)
            })
        });
        if is_fragile {
            return None;
        }
        let Some(projection) = project(&inputs) else { return Some([0.0; 12]) };
        let moved = sensitivity(&inputs, &errors, |inputs| {
            project(inputs).map_or_else(|| vec![f64::NAN; 12], |p| p.numbers().to_vec())
        });
        let Splat { mean2d, conic, opacity } = projection.splat;
        let size = self.camera.size.max_element();
        let center = mean2d.abs() + size;
        let widest = 64.0 * conic.x.max(conic.z);
        // Sixteen terms, whose basis is a polynomial of magnitude 3 and degree 3.
        let color = 128.0 * (1.0 + gaussian.sh.iter().map(|c| c.abs().max_element()).sum::<f64>());
        let point = self.camera.view(gaussian.mean);
        let color = self.lamp.map_or(color, |lamp| lamp.lit_error(color, point))
            * self.tint.truncate().max_element().max(1.0);
        let far = far * self.camera.rotation.x_axis.length().max(1.0);
        let dimmed = 32.0 * projection.conditioning;
        let level = f64::from(splat_level(opacity as f32));
        let extent =
            projection.half_extent * (extent_error(opacity as f32) / UNIT + dimmed / level);
        let rounded = [
            16.0 * center.x,
            16.0 * center.y,
            extent.x,
            extent.y,
            widest,
            widest,
            widest,
            (8.0 + dimmed) * opacity,
            color,
            color,
            color,
            16.0 * far,
        ];
        Some(std::array::from_fn(|k| moved[k] + UNIT * rounded[k]))
    }

    /// The fewest and the most tiles of a splat whose numbers are off by `errors`.
    fn tile_counts(&self, splat: &ProjectedSplat, errors: &[f64; 12]) -> [u32; 2] {
        let extent = splat.half_extent.as_dvec2();
        let conic = splat.conic.as_dvec3();
        let shift = errors[0].max(errors[1]) * (conic.x + conic.z).sqrt();
        let grown = [
            errors[2] / extent.x,
            errors[3] / extent.y,
            errors[4] / conic.x,
            errors[6] / conic.z,
            extent_error(splat.opacity),
        ];
        let radius = f64::from(splat_level(splat.opacity)).sqrt();
        let grown = (grown.into_iter().fold(0.0, f64::max) + shift / radius) as f32;
        [1.0 - grown, 1.0 + grown].map(|factor| {
            let (conic, half_extent) =
                (splat.conic / (factor * factor), splat.half_extent * factor);
            tile_count(self.size, self.constants, &ProjectedSplat { conic, half_extent, ..*splat })
        })
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { parameters, splats, colors, depth_keys, ids, tile_counts, .. } = slices;
        let stored = stored_color(constants.channels);
        for instance in instances(params, constants, slices.instances) {
            let scene =
                ProjectionInputs::new(params, constants, slices.cameras, slices.lamp, instance);
            let (planes, floats) = scene.planes.floats(parameters, constants.half_rest);
            let whole = Self::INTERFACE.workgroup_size[0] as usize;
            let count = scene.planes.count;
            for k in 0..if constants.instances { count.next_multiple_of(whole) } else { count } {
                let i = scene.first + k;
                let first =
                    if constants.instances { params.first_splat } else { params.first_gaussian };
                let orders = !constants.shares_sort || params.keeps_order == 0;
                if orders {
                    ids[i] = first + i as u32;
                    depth_keys[i] = CULLED;
                }
                tile_counts[i] = 0;
                if k >= scene.planes.count {
                    continue;
                }
                let gaussian = planes.load(&floats, k);
                if constants.shares_sort && orders {
                    depth_keys[i] = depth_key(scene.shared_depth(&gaussian) as f32, params.near);
                }
                if scene.is_clipped(&gaussian) {
                    continue;
                }
                let Some(projection) = scene.project(&gaussian) else { continue };
                splats[i] = projection.stored();
                let depth = (constants.view_depths != 0).then_some(projection.depth);
                let values = projection.color.to_array().into_iter().chain(gaussian.features);
                let values = values.chain(depth).chain(std::iter::repeat(0.0));
                for (color, value) in colors[stored * i..][..stored].iter_mut().zip(values) {
                    *color = value as f32;
                }
                tile_counts[i] = tile_count(scene.size, constants, &splats[i]);
                if tile_counts[i] > 0 && !constants.shares_sort {
                    depth_keys[i] = depth_key(projection.depth as f32, params.near);
                }
            }
        }
    }

    /// A Gaussian close to the culling limit may be culled; one whose ellipse is close to a tile may cover it.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let stored = stored_color(constants.channels);
        let n = slices.ids.len();
        let [mut splats, mut colors, mut depth_keys, mut tile_counts] =
            [8 * n, stored * n, n, n].map(|len| vec![0.0; len]);
        for instance in instances(params, constants, slices.instances) {
            let scene =
                ProjectionInputs::new(params, constants, slices.cameras, slices.lamp, instance);
            let (planes, floats) = scene.planes.floats(slices.parameters, constants.half_rest);
            for k in 0..scene.planes.count {
                let i = scene.first + k;
                let gaussian = planes.load(&floats, k);
                let shared = constants.shares_sort.then(|| scene.shared_key_error(&gaussian));
                depth_keys[i] = shared.unwrap_or_default();
                if scene.is_clipped(&gaussian) {
                    continue;
                }
                let Some(errors) = scene.errors(&gaussian) else {
                    splats[8 * i..][..8].fill(f64::INFINITY);
                    colors[stored * i..][..stored].fill(f64::INFINITY);
                    tile_counts[i] = f64::INFINITY;
                    depth_keys[i] = shared.unwrap_or(f64::INFINITY);
                    continue;
                };
                let Some(projection) = scene.project(&gaussian) else { continue };
                splats[8 * i..][..8].copy_from_slice(&errors[..8]);
                colors[stored * i..][..3].copy_from_slice(&errors[8..11]);
                if constants.view_depths != 0 {
                    colors[stored * i + constants.channels as usize - 1] = errors[11];
                }
                let splat = projection.stored();
                let count = tile_count(scene.size, constants, &splat);
                let [fewest, most] = scene.tile_counts(&splat, &errors);
                tile_counts[i] = (count - count.min(fewest)).max(most.max(count) - count).into();
                depth_keys[i] = match (shared, fewest, most) {
                    (Some(error), ..) => error,
                    (_, _, 0) => 0.0,
                    (_, 0, _) => f64::INFINITY,
                    _ => key_error(projection.depth as f32, errors[11]),
                };
            }
        }
        Tolerances {
            splats: Tolerance::Each(splats),
            colors: Tolerance::Each(colors),
            depth_keys: Tolerance::Each(depth_keys),
            tile_counts: Tolerance::Each(tile_counts),
            ..Tolerances::default()
        }
    }
}
