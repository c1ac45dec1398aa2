//! The two filters against aliasing: compensated opacities, and the smoothing floor.

use nightsplat::splats::smoothing::SmoothingFloor;

use crate::common::prelude::*;
use crate::common::setup::fisheye;
use crate::common::train::dataset;

/// The light of one small splat in a view of 1/`shrink` of the size: the sum of one minus the transmittances, in pixels
/// of the view of full size.
fn light(antialiased: bool, shrink: u32) -> f64 {
    let mut setup = Setup::new(1, [96 / shrink, 96 / shrink], 0, 1);
    let full = Setup::new(1, [96, 96], 0, 1);
    let gaussian = full.get(0);
    let log_scale = DVec3::splat((2.5 * 3.0 / (0.9 * 96.0_f64)).ln());
    let mean = full.at_pixel(DVec2::splat(48.0), 3.0);
    setup.set(0, &Gaussian { mean, log_scale, raw_opacity: -1.0, ..gaussian });
    setup.settings.antialiased = antialiased;
    let lost = setup.render().transmittances.iter().map(|&t| 1.0 - f64::from(t)).sum::<f64>();
    lost * f64::from(shrink * shrink)
}

#[test]
fn a_compensated_splat_has_the_same_light_in_a_small_view() {
    let [large, small] = [1, 8].map(|shrink| light(true, shrink));
    assert!((small / large - 1.0).abs() < 0.15, "{large} {small}");
    let [large, small] = [1, 8].map(|shrink| light(false, shrink));
    assert!(small / large > 2.0, "without compensation the dilation adds light: {large} {small}");
}

/// Gaussians of random scales, some behind the cameras, on the device.
fn raised(count: usize, status: u32, rest: StorageFormat) -> [Gaussians; 2] {
    let (gpu, setup) = (gpu(), Setup::new(count, [40, 30], 2, 5));
    let mut before = Gaussians::zeros(count, 2);
    before.parameters.copy_from_slice(&setup.parameters);
    if count > 2 {
        before.means_mut()[1] = Vec3::new(0.0, 0.0, -50.0);
        before.log_scales_mut()[2].x = f32::NAN;
    }
    let mut on_device = before.upload_as(&gpu, rest).unwrap();
    let status = gpu.buffer("status", &[status, 0, 0, 0]).unwrap();
    let cameras = [setup.camera, Setup::seen_by(fisheye(), 1, [40, 30], 0, 1).camera];
    let floor = SmoothingFloor::new(&gpu, 4.0, 0.2, &cameras).unwrap();
    agreeing(|| gpu.run("floor", |pass| floor.record(pass, &mut on_device, &status)).unwrap());
    let mut after = Gaussians::zeros(count, 2);
    after.parameters = on_device.read(&gpu).unwrap();
    [before, after]
}

/// Pixels of the Gaussian's smallest standard deviation in the camera, at its mean; `None`: it is not seen. A view that
/// the kernel counts as seeing it counts here, too.
fn pixels(gaussians: &Gaussians, i: usize, camera: &Camera) -> Option<f64> {
    let point = camera.view_from_world.transform_point3(gaussians.means()[i].as_dvec3());
    let position = camera.focal * point.truncate() / point.z + camera.principal_point;
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let is_seen = point.z > 0.2 && (position / size - 0.5).abs().max_element() < 0.651;
    let smallest = f64::from(gaussians.log_scales()[i].min_element()).exp();
    is_seen.then_some(smallest * camera.focal.max_element() / point.z)
}

#[test]
fn the_floor_raises_what_no_view_resolves_and_nothing_else_at_every_size() {
    for count in [0, 1, 63, 64, 65, 300] {
        let [before, after] = raised(count, 0, StorageFormat::Single);
        let mut changed = 0;
        for i in 0..count {
            if i == 2 && count > 2 {
                assert!(after.log_scales()[i].x.is_nan(), "a NaN stays, and is found");
                continue;
            }
            assert!(after.log_scales()[i].cmpge(before.log_scales()[i]).all());
            changed += usize::from(after.log_scales()[i] != before.log_scales()[i]);
        }
        let unseen = count > 2 && before.log_scales()[1] != after.log_scales()[1];
        assert!(!unseen && (count < 60 || changed > count / 4), "{changed} of {count}");
        let others = |gaussians: &Gaussians| {
            let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            [bits(&gaussians.parameters[..7 * count]), bits(&gaussians.parameters[10 * count..])]
        };
        assert_eq!(others(&before), others(&after));
    }
    let [single, half] =
        [StorageFormat::Single, StorageFormat::Half].map(|f| raised(60, 0, f)[1].clone());
    assert_eq!(single.log_scales()[3..], half.log_scales()[3..]);
}

#[test]
fn the_floor_changes_nothing_after_a_failed_step() {
    let [before, after] = raised(64, 2, StorageFormat::Single);
    assert_eq!(before.log_scales()[3..], after.log_scales()[3..]);
}

#[test]
fn a_trained_model_has_no_gaussian_below_the_floor() {
    let dataset = dataset(6, [40, 30]);
    let smallest = |smoothing: f64| {
        let mut config = TrainConfig { steps: 21, ..TrainConfig::bare() };
        config.antialiasing.smoothing = smoothing;
        let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
        advance(&mut trainer, 21);
        let gaussians = trainer.gaussians().unwrap();
        let views = || dataset.train_views().map(|view| &view.camera);
        let of = |i| views().filter_map(|camera| pixels(&gaussians, i, camera)).reduce(f64::max);
        (0..gaussians.count).filter_map(of).fold(f64::INFINITY, f64::min)
    };
    assert!(smallest(0.0) < 1.9, "{}", smallest(0.0));
    assert!(smallest(4.0) > 1.99, "{}", smallest(4.0));
}
