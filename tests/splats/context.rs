//! Gaussians that are rendered with those of a view, and have no gradients.

use crate::common::prelude::*;
use crate::common::setup::Rendered;

const SIZE: [u32; 2] = [50, 37];

/// The Gaussians before and after an index.
fn divided(setup: &Setup, at: usize) -> [Gaussians; 2] {
    let is_first: Vec<bool> = (0..setup.count).map(|index| index < at).collect();
    let is_second: Vec<bool> = is_first.iter().map(|first| !first).collect();
    [is_first, is_second].map(|keep| {
        let mut part = setup.gaussians();
        part.retain(&keep);
        part
    })
}

/// The setup of the second part alone.
fn with(setup: &Setup, part: &Gaussians) -> Setup {
    Setup { count: part.count, parameters: part.parameters.clone(), ..setup.clone() }
}

/// Render and gradients of the second part, in the context of the first.
#[test]
fn a_context_is_rendered_and_the_others_have_the_same_gradients_to_the_bit() {
    for (before, seed) in [(1, 3), (64, 4), (70, 5)] {
        let setup = Setup::new(120, SIZE, 2, seed);
        let mut whole = setup.render();
        let d_render: Vec<f32> =
            (0..3 * setup.pixels()).map(|i| ((i * 7 % 11) as f32 - 5.0) / 11.0).collect();
        let gradients = whole.backward(&d_render);

        let [context, trained] = divided(&setup, before);
        let rest = with(&setup, &trained);
        let mut rendered = Rendered::in_context(&rest, &context);
        assert_eq!(rendered.render, whole.render, "{before}");
        assert_eq!(rendered.transmittances, whole.transmittances);
        let of_rest = rendered.backward(&d_render);
        assert_eq!(of_rest.visit_counts, gradients.visit_counts[before..]);
        assert_eq!(of_rest.grad_norm_sums, gradients.grad_norm_sums[before..]);
        for index in 0..trained.count {
            let [of_rest, of_whole] =
                [(&rest, &of_rest, index), (&setup, &gradients, before + index)]
                    .map(|(setup, gradients, at)| setup.planes().load(&gradients.parameters, at));
            assert_eq!(format!("{of_rest:?}"), format!("{of_whole:?}"), "{before} {index}");
        }
    }
}

#[test]
fn every_pass_over_a_context_agrees_with_its_reference() {
    let setup = Setup::new(90, SIZE, 1, 9);
    let [context, trained] = divided(&setup, 33);
    let rest = with(&setup, &trained);
    agreeing(|| Rendered::in_context(&rest, &context).backward(&vec![0.5; 3 * setup.pixels()]));
}

#[test]
fn a_context_follows_the_renderer_to_another_degree() {
    let setup = Setup::new(60, SIZE, 3, 12);
    let [context, trained] = divided(&setup, 20);
    let lower = |gaussians: &Gaussians| gaussians.with_sh_degree(1);
    let mut renderer = Renderer::new(&gpu(), setup.settings).unwrap();
    renderer.set_context(&context).unwrap();
    renderer.set_sh_degree(1).unwrap();
    renderer.reserve(trained.count, [&setup.camera]).unwrap();
    let mut options = setup.options;
    options.sh_degree = 1;
    let uploaded = lower(&trained).upload(&gpu()).unwrap();
    let image = renderer.render_image(&uploaded, &setup.camera, &options).unwrap();

    let shape = lower(&trained).shape;
    let mut expected = Renderer::new(&gpu(), RenderSettings { shape, ..setup.settings }).unwrap();
    expected.reserve(setup.count, [&setup.camera]).unwrap();
    let all = lower(&setup.gaussians()).upload(&gpu()).unwrap();
    assert_eq!(image.data, expected.render_image(&all, &setup.camera, &options).unwrap().data);
}

#[test]
fn more_gaussians_than_were_reserved_for_beside_the_context_are_refused() {
    let setup = Setup::new(90, SIZE, 1, 9);
    let [context, trained] = divided(&setup, 30);
    let mut renderer = Renderer::new(&gpu(), setup.settings).unwrap();
    renderer.reserve(trained.count, [&setup.camera]).unwrap();
    renderer.set_context(&context).unwrap();
    let uploaded = trained.upload(&gpu()).unwrap();
    let refused = renderer.render_image(&uploaded, &setup.camera, &setup.options).unwrap_err();
    assert!(refused.to_string().contains("exceed"), "{refused}");

    let wrong = context.with_features(Features::ALL);
    assert!(renderer.set_context(&wrong).unwrap_err().to_string().contains("cannot be rendered"));
}

/// Sixteen-bit coefficients of the context are those of the whole.
#[test]
fn a_context_is_stored_in_the_format_of_the_renderer() {
    let mut setup = Setup::new(60, SIZE, 2, 12);
    setup.settings.rest = StorageFormat::Half;
    let [context, trained] = divided(&setup, 20);
    let mut images = vec![];
    for (context, gaussians) in [(Some(context), trained), (None, setup.gaussians())] {
        let mut renderer = Renderer::new(&gpu(), setup.settings).unwrap();
        context.iter().for_each(|context| renderer.set_context(context).unwrap());
        renderer.reserve(gaussians.count, [&setup.camera]).unwrap();
        let uploaded = gaussians.upload_as(&gpu(), StorageFormat::Half).unwrap();
        images.push(renderer.render_image(&uploaded, &setup.camera, &setup.options).unwrap().data);
    }
    assert_eq!(images[0], images[1]);
}
