//! Masked pixels do not affect statistics, losses, gradients, density control or scores.

use nightsplat::train::Part;
use nightsplat_photographs::image::Mask;
use nightsplat_photographs::metrics::psnr_of_counted;

use crate::common::prelude::*;
use crate::common::train::train;

/// The right third of every view is masked, and a column at its border by half.
fn masked(mut dataset: Dataset, hidden: Option<[f32; 3]>) -> Dataset {
    for view in &mut dataset.views {
        let (width, height) = (view.camera.width, view.camera.height);
        let weight = |x: u32| match x.cmp(&(2 * width / 3)) {
            std::cmp::Ordering::Less => 1.0,
            std::cmp::Ordering::Equal => 0.5,
            std::cmp::Ordering::Greater => 0.0,
        };
        let weights = (0..width * height).map(|pixel| weight(pixel % width)).collect();
        view.mask = Some(Mask { width, height, weights });
        let paint = |image: &Image| {
            let color = |x, y| hidden.filter(|_| weight(x) == 0.0).unwrap_or(image.pixel(x, y));
            Image::from_fn(width, height, color)
        };
        view.image = view.image.as_ref().map(paint);
        view.reference = view.reference.as_ref().map(paint);
        view.original = None;
    }
    dataset
}

fn dataset() -> Dataset {
    crate::common::train::dataset(8, [48, 36])
}

/// Density control acts twice within thirty steps.
fn config(tone: ToneSettings) -> TrainConfig {
    let mut config = TrainConfig { steps: 30, tone, ..TrainConfig::bare() };
    config.schedule.densify_after = 8;
    config.schedule.densify_interval = 10;
    config
}

#[test]
fn masked_pixels_do_not_affect_the_model() {
    for (tone, ssim_weight) in
        [(ToneSettings::default(), 0.2), (ToneSettings::new(ToneCurve::Ap3), 0.0)]
    {
        let config = TrainConfig { ssim_weight, ..config(tone) };
        let one = train(&config, &masked(dataset(), None)).1;
        let other = train(&config, &masked(dataset(), Some([0.9, 0.0, 0.3]))).1;
        assert_eq!(one.parameters, other.parameters, "{:?}", config.tone.curve);
        let shown = train(&config, &dataset()).1;
        assert_ne!(one.parameters, shown.parameters);
    }
}

#[test]
fn masked_pixels_do_not_affect_the_networks() {
    for variant in [NetworkVariant::Identity, NetworkVariant::Paper] {
        let mut config = TrainConfig { steps: 6, ..config(ToneSettings::new(ToneCurve::Ap3)) };
        config.model.set_parts(&[Part::Denoiser, Part::Tonemapper]);
        config.model.network =
            DenoiserSettings { channels: 4, stages: 2, variant, ..Default::default() };
        config.model.denoiser_crop = 24;
        let denoised = |dataset: &Dataset| {
            let mut trainer = Trainer::new(&gpu(), config.clone(), dataset).unwrap();
            advance(&mut trainer, config.steps);
            let camera = dataset.views[0].camera;
            trainer.render(&camera).unwrap().denoised.unwrap().data
        };
        let one = denoised(&masked(dataset(), None));
        let other = denoised(&masked(dataset(), Some([0.9, 0.0, 0.3])));
        assert_eq!(one, other, "{variant:?}");
        assert_ne!(one, denoised(&dataset()), "{variant:?}");
    }
}

#[test]
fn every_pass_of_a_masked_step_agrees_with_its_reference() {
    let mut with_parts = config(ToneSettings::new(ToneCurve::Ap3));
    with_parts.model.set_parts(&[Part::Structure, Part::Denoiser, Part::Tonemapper]);
    with_parts.model.network = DenoiserSettings { channels: 4, stages: 2, ..Default::default() };
    let mut with_exposures = config(ToneSettings::default());
    with_exposures.exposure.learn = true;
    for config in [with_parts, with_exposures] {
        let mut trainer = Trainer::new(&gpu(), config, &masked(dataset(), None)).unwrap();
        for _ in 0..2 {
            let (_, checks) = agreeing_step(&mut trainer);
            for kernel in ["mask_render", "mask_gradient"] {
                assert!(checks.passes.iter().any(|pass| pass.kernel == kernel), "no {kernel}");
            }
        }
    }
}

#[test]
fn scores_are_those_of_the_unmasked_pixels() {
    let size = (40, 32);
    let wave = |phase: f32| {
        Image::from_fn(size.0, size.1, move |x, y| {
            [0.2, 0.9, 1.7].map(|c| 0.5 + 0.3 * (0.4 * x as f32 + 0.2 * y as f32 + c + phase).sin())
        })
    };
    let (render, reference) = (wave(0.0), wave(0.3));
    let weights = (0..size.0 * size.1).map(|pixel| f32::from(pixel % size.0 < 24)).collect();
    let mask = Mask { width: size.0, height: size.1, weights };
    let left = |image: &Image| Image::from_fn(24, size.1, |x, y| image.pixel(x, y));
    let scores = Scores::of_counted(&render, &reference, Some(&mask)).unwrap();
    let cut = Scores::measure(&left(&render), &left(&reference)).unwrap();
    assert!((scores.psnr - cut.psnr).abs() < 1e-9);
    assert!((scores.psnr_channel_mean - cut.psnr_channel_mean).abs() < 1e-9);
    // Except for the windows at the border, which include the reference beyond it.
    assert!((scores.ssim - cut.ssim).abs() < 0.05, "{} {}", scores.ssim, cut.ssim);
    assert_eq!(psnr_of_counted(&render, &reference, Some(&mask)).unwrap(), scores.psnr);
    // For any content of the masked pixels.
    let painted =
        Image::from_fn(size.0, size.1, |x, y| if x < 24 { render.pixel(x, y) } else { [7.0; 3] });
    let again = Scores::of_counted(&painted, &reference, Some(&mask)).unwrap();
    assert!((again.ssim - scores.ssim).abs() < 1e-12 && again.psnr == scores.psnr);
    assert_eq!(
        Scores::of_counted(&render, &reference, None).unwrap(),
        Scores::measure(&render, &reference).unwrap()
    );
    let nothing = Mask { weights: vec![0.0; mask.weights.len()], ..mask };
    assert!(Scores::of_counted(&render, &reference, Some(&nothing)).is_err());
}
