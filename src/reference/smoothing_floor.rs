//! The lowest standard deviations that training views resolve, in f64.

use glam::{DVec2, DVec3};
use nightsplat_models::attributes::Attribute;

use super::camera::ReferenceCamera;
use super::rounding::UNIT;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::smoothing_floor::{Constants, Kernel, Params, SEEN_MARGIN, Slices, Tolerances};

/// The world units between two samples of the finest view that sees a point up to `margin` outside; `None`: no view
/// does.
fn sampling(params: &Params, slices: &Slices<'_>, mean: DVec3, margin: f64) -> Option<f64> {
    let of_view = |camera: &_| {
        let camera = ReferenceCamera::from(camera);
        let point = camera.view(mean);
        let depth = camera.depth(point);
        let is_ahead = depth > params.near.into();
        let in_image = if is_ahead { camera.project(point) / camera.size } else { DVec2::INFINITY };
        let is_seen = (in_image - 0.5).abs().max_element() <= 0.5 + margin;
        is_seen.then(|| depth / camera.focal.max_element())
    };
    let cameras = slices.cameras.iter().take(params.camera_count as usize);
    cameras.filter_map(of_view).min_by(f64::total_cmp)
}

fn mean(params: &Params, slices: &Slices<'_>, i: usize) -> DVec3 {
    let first = Attribute::Means.column(0) * params.gaussian_count as usize + 3 * i;
    DVec3::from_array([0, 1, 2].map(|axis| slices.parameters[first + axis].into()))
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        for i in (0..n).filter(|_| slices.status[0] == 0) {
            let mean = mean(params, &slices, i);
            let Some(sampling) = sampling(params, &slices, mean, SEEN_MARGIN) else { continue };
            let lowest = (f64::from(params.width) * sampling).ln() as f32;
            let first = Attribute::LogScales.column(0) * n + 3 * i;
            for scale in &mut slices.parameters[first..first + 3] {
                if *scale < lowest {
                    *scale = lowest;
                }
            }
        }
    }

    /// A depth has the rounding error of its largest term. Where it decides whether a view sees the mean, the floor is
    /// that with the view or that without it.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let n = params.gaussian_count as usize;
        let mut parameters = vec![0.0; slices.parameters.len()];
        let cameras = slices.cameras.iter().take(params.camera_count as usize);
        let far = cameras
            .map(|camera| ReferenceCamera::from(camera).center().length())
            .fold(0.0, f64::max);
        for i in 0..n {
            let mean = mean(params, &slices, i);
            let of = |margin| sampling(params, &slices, mean, margin);
            let slack = 1e-4;
            let bound = match (of(SEEN_MARGIN + slack), of(SEEN_MARGIN - slack)) {
                (None, _) => 0.0,
                (Some(_), None) => f64::INFINITY,
                (Some(loose), Some(strict)) => {
                    let focal = slices.cameras.iter().map(|camera| camera.focal.max_element());
                    let depth = loose * f64::from(focal.fold(f32::INFINITY, f32::min));
                    let rounded = 16.0 * UNIT * (1.0 + (mean.length() + far) / depth);
                    let log = (f64::from(params.width) * loose).ln().abs();
                    (strict / loose).ln() + rounded + 8.0 * UNIT * (1.0 + log)
                }
            };
            let first = Attribute::LogScales.column(0) * n + 3 * i;
            parameters[first..first + 3].fill(bound);
        }
        Tolerances { parameters: Tolerance::Each(parameters) }
    }
}
