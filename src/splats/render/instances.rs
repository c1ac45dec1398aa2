//! Many models in one draw, each with a transform of its own, projected into one list and sorted together.

use std::collections::HashMap;
use std::ops::Range;

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use nightsplat_core::camera::{Camera, CameraModel, deviation_from_rigid};

use super::pipelines::ProjectionKind;
use super::projection::{GROUP, Projected};
use super::{KernelView, RenderSettings, Renderer};
use crate::gpu::Recorder;
use crate::kernels::{self, InstanceView};
use crate::splats::device::{DeviceGaussians, GaussianBounds, GaussianSlice, Layout};
use crate::splats::packed_sh::StorageFormat;
use crate::{Error, Result};

/// A model in a draw, which may have others, and itself again elsewhere. The Gaussians are shared: nothing is copied.
#[derive(Clone, Copy, Debug)]
pub struct Instance<'a> {
    /// Its Gaussians, of any SH degree; features, near plane and colours are those of the renderer's settings.
    pub gaussians: &'a DeviceGaussians,
    /// From the model's world, in which its positions are relative to the origin of the Gaussians, to the world of the
    /// cameras: rigid.
    pub pose: DAffine3,
    /// The factor on lengths of the model before the pose.
    pub scale: f64,
    /// Factors of display-referred red, green and blue, 0 or more, and of the opacity, 0 to 1.
    pub tint: [f32; 4],
    /// The corners of a box in the model's world outside of which no Gaussian is seen, by its centre.
    pub clip: Option<[DVec3; 2]>,
    /// Whether it is drawn.
    pub is_visible: bool,
    /// Its pose and scale in the frame before, for motion vectors; `None`: it has not moved.
    pub before: Option<(DAffine3, f64)>,
}

impl<'a> Instance<'a> {
    /// A model as it is.
    pub fn new(gaussians: &'a DeviceGaussians) -> Self {
        let tint = [1.0; 4];
        let pose = DAffine3::IDENTITY;
        Self { gaussians, pose, scale: 1.0, tint, clip: None, is_visible: true, before: None }
    }

    fn check(&self, index: usize, settings: &RenderSettings) -> Result<()> {
        let refuse = |problem: String| Err(Error::Usage(format!("instance {index} {problem}")));
        let layout = &self.gaussians.layout;
        if layout.shape.features != settings.shape.features {
            return refuse("has other features than the renderer".to_owned());
        }
        if let Some(off) = deviation_from_rigid(&self.pose) {
            return refuse(format!(
                "has a pose that is not rigid, by {off:.4}; pass its scale as such"
            ));
        }
        if !(self.scale.is_finite() && self.scale > 0.0) {
            return refuse(format!("has scale {}; it is positive", self.scale));
        }
        let [red, green, blue, opacity] = self.tint;
        let are_valid =
            [red, green, blue].iter().all(|factor| factor.is_finite() && *factor >= 0.0);
        if !(are_valid && (0.0..=1.0).contains(&opacity)) {
            let tint = self.tint;
            return refuse(format!("has tint {tint:?}; colours are 0 or more, the opacity 0 to 1"));
        }
        if let Some((pose, scale)) = self.before {
            let is_valid = scale.is_finite() && scale > 0.0;
            if !is_valid || deviation_from_rigid(&pose).is_some() {
                return refuse("has a pose before that is not rigid, or a scale of 0".to_owned());
            }
        }
        if self.clip.is_some_and(|[least, most]| least.is_nan() || most.is_nan()) {
            return refuse("has a clip box with a NaN".to_owned());
        }
        Ok(())
    }

    /// From a camera's view of it to that of another in the frame before.
    pub(super) fn before_from_now(&self, camera: &Camera, before: &Camera) -> DAffine3 {
        let (pose, scale) = self.before.unwrap_or((self.pose, self.scale));
        Self { pose, scale, ..*self }.view_from_model(before)
            * self.view_from_model(camera).inverse()
    }

    /// From the coordinates of its means to those of a view.
    fn view_from_model(&self, camera: &Camera) -> DAffine3 {
        let scaled = DAffine3::from_scale(DVec3::splat(self.scale));
        let origin = DAffine3::from_translation(self.gaussians.origin);
        camera.view_from_world * self.pose * scaled * origin
    }

    /// As a camera sees it, with its splats from `first` on.
    fn view(&self, camera: &Camera, first: u32) -> InstanceView {
        let view = self.view_from_model(camera);
        let DAffine3 { matrix3: DMat3 { x_axis, y_axis, z_axis }, translation } = view;
        let center = view.matrix3.inverse() * -translation;
        let origin = self.gaussians.origin;
        let [least, most] = match self.clip {
            Some(corners) => corners.map(|corner| (corner - origin).as_vec3()),
            None => [Vec3::NEG_INFINITY, Vec3::INFINITY],
        };
        InstanceView {
            view_from_model: [x_axis, y_axis, z_axis, translation]
                .map(|column| column.as_vec3().to_array()),
            camera_center: center.as_vec3(),
            first,
            tint: self.tint,
            box_min: least,
            box_max: most,
        }
    }

    /// Whether a camera can see any of its splats: by the bounds that the Gaussians were uploaded with, and without any
    /// always.
    fn may_be_seen(&self, camera: &Camera, settings: &RenderSettings) -> bool {
        self.gaussians.bounds.is_none_or(|bounds| {
            bounds.may_be_seen(&self.view_from_model(camera), camera, settings)
        })
    }
}

/// A splat ends where its alpha is 1 / 255, at most this number of standard deviations from its centre.
const DEVIATIONS: f64 = 3.34;

impl GaussianBounds {
    /// What `project` computes, bounded: a splat is within `DEVIATIONS` of its standard deviation on the image, which
    /// is no more than focal / depth sqrt(1 + slope^2) of that in the world, or focal for parallel rays, and the
    /// dilation.
    fn may_be_seen(
        &self,
        view_from_model: &DAffine3,
        camera: &Camera,
        settings: &RenderSettings,
    ) -> bool {
        let [least, most] = self.corners.map(|corner| corner.as_dvec3());
        let corner = |at: u32| {
            let side = |axis: u32| at >> axis & 1 == 1;
            let axes = [side(0), side(1), side(2)];
            let pick = |k: usize| if axes[k] { most[k] } else { least[k] };
            view_from_model.transform_point3(DVec3::new(pick(0), pick(1), pick(2)))
        };
        let corners: [DVec3; 8] = std::array::from_fn(|at| corner(at as u32));
        if corners.iter().all(|corner| corner.z <= f64::from(settings.near)) {
            return matches!(camera.model, CameraModel::Fisheye(_));
        }
        if matches!(camera.model, CameraModel::Fisheye(_)) || !self.deviation.is_finite() {
            return true;
        }
        let is_orthographic = camera.model == CameraModel::Orthographic;
        let kernel = kernels::Camera::from(&camera.into());
        let size = DVec2::new(camera.width.into(), camera.height.into());
        let scale = view_from_model.matrix3.x_axis.length();
        let slopes = match is_orthographic {
            true => DVec2::ZERO,
            false => kernel.min_slope.abs().max(kernel.max_slope.abs()).as_dvec2(),
        };
        let reach = DEVIATIONS
            * scale
            * f64::from(self.deviation)
            * (DVec3::new(1.0, slopes.x, slopes.y).length() + 1.0);
        let dilated = DEVIATIONS * kernels::splat::DILATION.sqrt() + 1.0;
        (0..2).all(|axis| {
            let slope = |pixel: f64| (pixel - camera.principal_point[axis]) / camera.focal[axis];
            let (low, high) = (slope(-dilated), slope(size[axis] + dilated));
            // Of the pyramid, or of the box of parallel rays.
            let width = |point: &DVec3| if is_orthographic { 1.0 } else { point.z };
            let is_right = |point: &DVec3| point[axis] - high * width(point) <= reach;
            let is_left = |point: &DVec3| low * width(point) - point[axis] <= reach;
            corners.iter().any(is_right) && corners.iter().any(is_left)
        })
    }
}

/// The SH degree that is stored, and how.
pub(super) fn stored(layout: &Layout) -> (u32, StorageFormat) {
    (layout.shape.sh_degree, layout.sh_rest)
}

/// The splats of an instance: those of its Gaussians, up to whole workgroups, as a dispatch has.
fn splats_of(layout: &Layout) -> usize {
    layout.count.next_multiple_of(GROUP as usize)
}

/// The Gaussians of one model, and its instances in the table.
struct InstancedModel<'a> {
    gaussians: GaussianSlice<'a>,
    instances: Range<u32>,
}

/// The first splat of an instance, and its place in the draw.
#[derive(Clone, Copy, Debug)]
pub(super) struct FirstSplat {
    pub(super) splat: u32,
    pub(super) instance: usize,
}

/// The instances that cameras may see.
pub(super) struct VisibleInstances<'a> {
    models: Vec<InstancedModel<'a>>,
    table: Vec<InstanceView>,
    /// In ascending order.
    pub(super) firsts: Vec<FirstSplat>,
    /// Splats of all of them.
    pub(super) count: usize,
}

impl<'a> VisibleInstances<'a> {
    /// As one of the cameras sees them, those that any of them may see: views that share an order have the same splats.
    pub(super) fn new(
        all: &[Instance<'a>],
        camera: &Camera,
        seen_by: &[Camera],
        settings: &RenderSettings,
    ) -> Self {
        let mut by_model: Vec<(GaussianSlice<'a>, Vec<(usize, &Instance<'a>)>)> = vec![];
        let is_drawn = |(_, instance): &(usize, &Instance<'a>)| {
            instance.is_visible
                && seen_by.iter().any(|camera| instance.may_be_seen(camera, settings))
        };
        let mut models = HashMap::new();
        for (at, instance) in all.iter().enumerate().filter(is_drawn) {
            let slice = instance.gaussians.slice();
            let model = *models.entry(slice.parameters.begin()).or_insert(by_model.len());
            match by_model.get_mut(model) {
                Some((_, instances)) => instances.push((at, instance)),
                None => by_model.push((slice, vec![(at, instance)])),
            }
        }
        let (mut models, mut table, mut firsts, mut count) = (vec![], vec![], vec![], 0);
        for (gaussians, instances) in by_model {
            let first = table.len() as u32;
            let each = splats_of(&gaussians.layout);
            for (&(at, instance), first) in instances.iter().zip((count..).step_by(each.max(1))) {
                table.push(instance.view(camera, first as u32));
                firsts.push(FirstSplat { splat: first as u32, instance: at });
            }
            count += each * instances.len();
            let instances = first..table.len() as u32;
            models.push(InstancedModel { gaussians, instances });
        }
        Self { models, table, firsts, count }
    }
}

/// The splats of all instances together, as a renderer reserves memory for them.
pub(super) fn layout_of(instances: &[Instance<'_>], settings: &RenderSettings) -> Result<Layout> {
    let mut count = 0;
    for (index, instance) in instances.iter().enumerate() {
        instance.check(index, settings)?;
        count += splats_of(&instance.gaussians.layout);
    }
    match u32::try_from(count) {
        Ok(_) => Ok(Layout::new(count, settings.shape, settings.rest)),
        Err(_) => Err(Error::Usage(format!("{count} splats of all instances exceed 32 bits"))),
    }
}

impl Renderer {
    /// Uploads the table of a view and records the projection of its instances.
    pub(super) fn record_instances(
        &mut self,
        pass: &mut Recorder<'_>,
        visible: &VisibleInstances<'_>,
        view: &KernelView<'_>,
        sh_degree: u32,
    ) -> Result<()> {
        pass.update(&mut self.frame.instances, &visible.table)?;
        let (mut projecting, _) = self.projecting();
        let gpu = projecting.gpu;
        // Each model writes splats of its own, unless it takes several passes.
        let passes =
            |model: &InstancedModel<'_>| model.gaussians.layout.batches(gpu).iter().count();
        let are_disjoint = visible.models.iter().all(|model| passes(model) == 1);
        let mut record = |pass: &mut Recorder<'_>| {
            visible.models.iter().try_for_each(|model| {
                let InstancedModel { gaussians, ref instances } = *model;
                let kind =
                    ProjectionKind { instances: Some(stored(&gaussians.layout)), ..view.kind };
                let sh_degree = sh_degree.min(gaussians.layout.shape.sh_degree);
                // Those of all models are bound, as later passes do: the next pass then binds its Gaussians alone.
                let (splats, instances) = (0..visible.count, instances.clone());
                projecting.record(
                    pass,
                    view,
                    &Projected { gaussians, kind, sh_degree, splats, instances },
                )
            })
        };
        if are_disjoint { pass.concurrently(record) } else { record(pass) }
    }
}
