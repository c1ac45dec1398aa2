//! A host's image in the light of the photographs.

use nightsplat::kernels::photograph_light;
use nightsplat_photographs::tone::{
    FAMILIES, InverseTone, SceneLaw, Tone, ToneCurve, ToneParameters, ToneSettings, scene_law,
};

use super::*;

/// The parameters of `auto` for dark photographs, with this share of kept colours.
fn parameters(share: f32, weight: f32) -> ToneParameters {
    let mut of_curve =
        ToneParameters { white: 0.15, offset: 0.075, gain: 1.0, weight, ..Default::default() };
    of_curve.constants[0] = share;
    of_curve
}

/// The law of dark photographs.
fn law() -> SceneLaw {
    scene_law(&ToneSettings::new(Tone::Auto), &parameters(1.0 / 3.0, 1.0)).unwrap()
}

/// Black, the black level, no number, beyond white, clipped, and everything between in all three channels.
fn targets() -> Vec<[f32; 3]> {
    let edges =
        [0.0, -0.5, 0.02, 0.075, 0.0751, 0.0755, 0.5, 0.97, 0.99, 0.998, 1.0, 1.7, f32::NAN];
    let greys = edges.iter().map(|&edge| [edge; 3]);
    let mixed = edges.iter().map(|&edge| [edge, 0.3, 0.9]);
    let mut random = Random::new(9);
    let mut color = || [0, 1, 2].map(|_| random.between(0.0, 1.05) as f32);
    let colors: Vec<_> = (0..400).map(|_| color()).collect();
    greys.chain(mixed).chain(colors).collect()
}

/// The photographs' values of these targets, at some alphas, from the kernel. A checked pass agrees with the host's
/// inverse.
fn inverted(curve: u32, tone: ToneParameters, targets: &[[f32; 3]]) -> Vec<[f64; 3]> {
    let count = targets.len();
    let alphas: Vec<f32> = (0..count).map(|at| [1.0, 0.5, 0.25][at % 3]).collect();
    let transmittances: Vec<f32> = alphas.iter().map(|alpha| 1.0 - alpha).collect();
    let plane = |c: usize| targets.iter().zip(&alphas).map(move |(rgb, alpha)| rgb[c] * alpha);
    let render: Vec<f32> = (0..3).flat_map(plane).chain((0..count).map(|_| 7.0)).collect();
    let render = run_kernel!(
        photograph_light,
        photograph_light::Constants { tone_curve: curve },
        photograph_light::Params { pixel_count: count as u32, tone },
        Threads::Exactly([count as u32, 1, 1]),
        [transmittances],
        [render]
    );
    assert!(render[3 * count..].iter().all(|&value| value == 7.0), "other channels stay");
    let value = |c: usize, at: usize| f64::from(render[c * count + at]) / f64::from(alphas[at]);
    (0..count).map(|at| [0, 1, 2].map(|c| value(c, at))).collect()
}

#[test]
fn the_light_of_auto_is_the_hosts_inverse_to_a_ten_thousandth_up_to_clipping() {
    let targets = targets();
    let plain = [(1.0 / 3.0, 1.0), (0.0, 1.0), (1.0, 1.0), (0.6, 0.4), (0.3, 0.0)];
    let bent = [[1.2, 0.0, 0.0], [0.0, 0.25, 1.0], [2.0, 0.4, 0.5]];
    let plain = plain.map(|(share, weight)| (share, weight, [0.0; 3]));
    let cases = plain.into_iter().chain(bent.map(|ends| (1.0 / 3.0, 1.0, ends)));
    for (share, weight, ends) in cases {
        let (settings, mut tone) = (ToneSettings::new(Tone::Auto), parameters(share, weight));
        tone.constants[1..4].copy_from_slice(&ends);
        let inverse = InverseTone::new(&settings, &tone).unwrap();
        let mut most = 0.0_f64;
        for (target, found) in targets.iter().zip(inverted(Tone::Auto.constant(), tone, &targets)) {
            let expected = inverse.invert(inverse.shown(target.map(f64::from)));
            for (found, expected) in found.into_iter().zip(expected) {
                assert!(found.is_finite());
                // A code of 16 bits of the photograph, where its target is all but black.
                let off = ((found - expected).abs() - 1.0 / 65_535.0).max(0.0) / expected.max(1e-9);
                most = most.max(off);
            }
        }
        println!("share {share}, weight {weight}: {most:e}");
        assert!(most < 1e-4, "share {share}, weight {weight}: {most:e}");
    }
}

#[test]
fn the_light_of_every_curve_that_rises_agrees_with_the_hosts_inverse() {
    let targets: Vec<_> = targets().into_iter().step_by(5).collect();
    let rising = FAMILIES.iter().filter(|family| family.monotone);
    for family in rising {
        let mut parameters = ToneParameters {
            white: 0.12,
            offset: 0.02,
            gain: 0.9,
            weight: 1.0,
            ..Default::default()
        };
        for (constant, given) in parameters.constants.iter_mut().zip(family.defaults()) {
            *constant = given as f32;
        }
        if family.curve == ToneCurve::PerChannel {
            parameters.constants[..3].copy_from_slice(&[0.1, 0.2, 0.4]);
        }
        for weight in [1.0, 0.5] {
            parameters.weight = weight;
            let back = inverted(family.curve.constant(), parameters, &targets);
            assert!(back.iter().flatten().all(|x| x.is_finite()), "{}", family.name);
        }
    }
}

#[test]
fn every_colour_format_gets_the_photographs_light_and_else_costs_nothing() {
    let law = law();
    with_host(|host, gpu| {
        let mut shown = Shown::new(host, gpu);
        let stated = RenderSettings { law: Some(law), ..show_settings() };
        let mut frame = 0;
        for stored in COLOR_FORMATS.into_iter().take(11) {
            let format = stored.format;
            for is_over in [false, true] {
                let picture = host.picture(format, SIZE).unwrap();
                let under = vec![0x3000_3000; stored.words()];
                host.fill_picture(&picture, [&under, &under], ImageState::SAMPLED);
                let image = picture.lent(ImageState::SAMPLED, ImageState::TRANSFER_SOURCE);
                let color = Some(&image);
                let hdr10_nits = stored.hdr10_nits();
                let target =
                    Target { color, is_over, exposure: 1.5, hdr10_nits, ..Target::default() };
                let drawn = |shown: &mut Shown<'_>, frame, is_photograph| {
                    draw(shown, frame, &Target { is_photograph, ..target });
                    host.read_picture(&picture, stored.words())
                };
                // With and without a law in the settings.
                let plain = drawn(&mut shown, frame + 1, false);
                host.fill_picture(&picture, [&under, &under], ImageState::SAMPLED);
                shown.renderer = Renderer::new(gpu, stated).unwrap();
                let off = drawn(&mut shown, frame + 2, false);
                assert!(off == plain, "{format:?}: without the flag, no bit changes");
                let memory = gpu.memory_in_use();
                host.fill_picture(&picture, [&under, &under], ImageState::SAMPLED);
                let layers = drawn(&mut shown, frame + 3, true);
                assert!(gpu.memory_in_use() <= memory, "it is inverted in place");
                assert_ne!(layers[0], plain[0]);
                shown.renderer = Renderer::new(gpu, show_settings()).unwrap();
                frame += 3;
                for (camera, pixels) in cameras().iter().zip(&layers) {
                    let (mut render, transmittances) = planes(camera);
                    in_photographs(&law, &mut render, &transmittances);
                    let under = is_over.then_some(&under[..]);
                    let expected = packed((&render, &transmittances), stored, under);
                    let off = levels(pixels, &expected, stored.storage);
                    assert!(off <= 1, "{format:?}: {off} levels");
                }
                host.free_picture(picture);
            }
        }
    });
}

/// A render in the values of the photographs, by the host.
fn in_photographs(law: &SceneLaw, render: &mut [f32], transmittances: &[f32]) {
    let inverse = InverseTone::of_law(law);
    for (at, transmittance) in transmittances.iter().enumerate() {
        let alpha = 1.0 - f64::from(*transmittance);
        if alpha > 0.0 {
            let target = [0, 1, 2].map(|c| f64::from(render[c * PIXELS + at]) / alpha);
            let back = inverse.invert(inverse.shown(target));
            (0..3).for_each(|c| render[c * PIXELS + at] = (back[c] * alpha) as f32);
        }
    }
}

#[test]
fn a_model_that_states_no_law_has_no_photographs_to_draw() {
    with_host(|host, gpu| {
        let mut shown = Shown::new(host, gpu);
        let picture = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
        let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
        let target = Target { color: Some(&image), is_photograph: true, ..Target::default() };
        let layout = shown.on_device.layout;
        let refused = shown.renderer.prepare_draw(&layout, &cameras(), &target).unwrap_err();
        let text = refused.to_string();
        says(&text, &["states no tone law", "named tone curve"]);
        host.free_picture(picture);
    });
}
