//! The renderer's forward pass: its limits, its invariances, and golden renders.

use std::collections::HashSet;

use glam::DVec4;
use nightsplat::gpu::{BackwardForm, RecordSums, Sorting, Tile};
use nightsplat::kernels::ProjectedSplat;
use nightsplat::kernels::splat::ALPHA_MIN;
use nightsplat::kernels::status::{STATUS_NOT_FINITE, STATUS_OVERFLOWED};
use nightsplat::reference::splat::{Splat, splat_columns};
use nightsplat::splats::lamp::Lamp;
use nightsplat::splats::render::Status;
use nightsplat_models::gaussians::Attribute;

use crate::common::chain::Chain;
use crate::common::prelude::*;
use crate::common::setup::{Rendered, features, lamp, tile_of};
use crate::common::{fixture, safetensors};

const SIZE: [u32; 2] = [50, 40];

/// Asserts that the render is the background at full transmittance.
fn assert_shows_nothing(rendered: &Rendered<'_>, setup: &Setup) {
    assert!(rendered.transmittances.iter().all(|&transmittance| transmittance == 1.0));
    for (plane, value) in rendered.render.chunks(setup.pixels()).zip(setup.background()) {
        assert!(plane.iter().all(|&shown| shown == value));
    }
}

// ---------------------------------------------------------------------------
// Limits

#[test]
fn an_overflow_renders_nothing_and_keeps_its_flag() {
    let setup = Setup::new(65, SIZE, 1, 5);
    let (_, Status { intersections: total, .. }) = setup.render_within(0);
    let (exact, status) = setup.render_within(total);
    assert!(!status.overflowed && status.intersections == total);
    assert_eq!(exact.render, setup.render().render);
    let (mut rendered, status) = setup.render_within(total - 1);
    assert!(status.overflowed && status.intersections == total);
    assert_shows_nothing(&rendered, &setup);
    // Neither a render that fits nor any other clears the flags.
    let flags = STATUS_OVERFLOWED | STATUS_NOT_FINITE;
    gpu().write(rendered.renderer.render_and_status().2, &[flags, 7]).unwrap();
    rendered.renderer.set_intersection_capacity(total).unwrap();
    rendered.forward();
    assert_eq!(gpu().read(rendered.renderer.status()).unwrap(), [flags, total, 0, flags]);
}

/// A Gaussian in the middle of the view of [`Setup::new`], a few pixels wide.
fn plain(setup: &Setup, depth: f64) -> Gaussian {
    let camera = setup.camera();
    Gaussian {
        mean: setup.at_pixel(camera.size / 2.0, depth),
        quat: DVec4::new(1.0, 0.2, -0.3, 0.1),
        log_scale: DVec3::splat((4.0 * depth / camera.focal.x).ln()),
        raw_opacity: 1.0,
        ..setup.get(0)
    }
}

#[test]
fn gaussians_out_of_range_are_not_rendered() {
    let mut setup = Setup::new(17, SIZE, 1, 5);
    let (base, nan, infinity) = (plain(&setup, 3.0), f64::NAN, f64::INFINITY);
    let scale = |s| Gaussian { log_scale: DVec3::splat(s), ..base.clone() };
    let at = |mean| Gaussian { mean, ..base.clone() };
    let opacity = |raw_opacity| Gaussian { raw_opacity, ..base.clone() };
    let right = setup.camera().rotation.transpose() * DVec3::X;
    let cases = [
        plain(&setup, -3.0),
        plain(&setup, 0.19),
        at(DVec3::new(nan, 0.0, 3.0)),
        at(DVec3::new(0.0, nan, 3.0)),
        at(DVec3::new(0.0, 0.0, nan)),
        at(DVec3::splat(infinity)),
        at(DVec3::new(0.0, 0.0, infinity)),
        at(DVec3::new(1e30, -1e30, 3.0)),
        at(base.mean + 100.0 * right),
        // 1 / (1 + 254.5) is below 1/255, by less than the allowed rounding error.
        opacity(-(254.5f64.ln())),
        opacity(-1000.0),
        opacity(-infinity),
        opacity(nan),
        scale(nan),
        // A determinant of 1e35: finite, but its square is not.
        scale(18.0),
        scale(40.0),
        scale(1000.0),
    ];
    for (i, gaussian) in cases.iter().enumerate() {
        setup.set(i, gaussian);
    }
    let mut rendered = setup.render();
    assert_shows_nothing(&rendered, &setup);
    assert_eq!(gpu().read(&rendered.renderer.frame().lists.counts).unwrap(), [0]);
    let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
    assert!(gradients.parameters.iter().all(|&g| g == 0.0));
    assert_eq!(gradients.visit_counts, [Rendered::VISITS_BEFORE; 17]);
}

#[test]
fn extreme_gaussians_stay_finite() {
    let mut setup = Setup::new(9, SIZE, 1, 5);
    let (base, nan) = (plain(&setup, 3.0), f64::NAN);
    let scale = |s| Gaussian { log_scale: s, ..base.clone() };
    let quat = |quat| Gaussian { quat, ..base.clone() };
    let cases = [
        scale(DVec3::splat(-40.0)),
        scale(DVec3::new(-1000.0, -2.0, -2.0)),
        scale(DVec3::splat(8.0)),
        scale(DVec3::new(11.0, -40.0, -40.0)),
        scale(DVec3::new(40.0, -40.0, -1.0)),
        quat(DVec4::ZERO),
        quat(DVec4::new(nan, 0.0, 0.0, 1.0)),
        quat(DVec4::splat(1e30)),
        Gaussian { raw_opacity: 1000.0, ..base.clone() },
    ];
    for (i, gaussian) in cases.iter().enumerate() {
        setup.set(i, gaussian);
    }
    let mut rendered = setup.render();
    let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
    let seen = gradients.visit_counts.iter().filter(|&&visits| visits > Rendered::VISITS_BEFORE);
    assert!(seen.count() >= 7);
    let Rendered { render, transmittances, .. } = rendered;
    let all = [render, transmittances, gradients.parameters, gradients.grad_norm_sums].concat();
    assert!(all.iter().all(|value| value.is_finite()));
}

/// In units of a lamp: at it, next to it, far from it, and out of its narrow beam without ambient light.
#[test]
fn lit_colors_stay_finite_at_the_lamp_and_far_away() {
    let mut setup = Setup::new(5, SIZE, 1, 5);
    let base = plain(&setup, 3.0);
    let camera = setup.camera();
    let in_view = camera.view(base.mean);
    let lamp = Lamp { position: in_view.to_array(), reference_distance: 1e-6, ..lamp() };
    for (i, offset) in [0.0, 1e-30, 1e-3, 0.1].into_iter().enumerate() {
        let mean = base.mean + DVec3::new(offset, 0.0, 0.0);
        setup.set(i, &Gaussian { mean, ..base.clone() });
    }
    let far = setup.at_pixel(camera.principal_point, 1e20);
    setup.set(4, &Gaussian { mean: far, log_scale: DVec3::splat(12.0), ..base });
    setup.settings.lamp = Some(lamp);
    let numbers = lamp.numbers();
    let mut narrow = numbers;
    // Before their functions: hardly any ambient light, the largest exponent, a beam as narrow as a number allows.
    (narrow[5], narrow[6], narrow[7], narrow[8]) = (-200.0, 200.0, 1e6, 1e6);
    (narrow[3], narrow[4]) = (4e3, -4e3);
    let mut wide = numbers;
    (wide[5], wide[6], wide[7], wide[8]) = (200.0, -200.0, -200.0, -200.0);
    for numbers in [numbers, narrow, wide] {
        let mut rendered = setup.render_lit(&numbers);
        let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
        let of_lamp = gpu().read(rendered.renderer.lamp_gradients().unwrap()).unwrap();
        let all = [&rendered.render[..], &gradients.parameters, &of_lamp].concat();
        assert!(all.iter().all(|value| value.is_finite()), "{numbers:?}: {of_lamp:?}");
    }
}

#[test]
fn a_pixel_is_done_before_its_transmittance_falls_below_the_limit() {
    let mut setup = Setup::new(9, [16, 16], 0, 5);
    for i in 0..9 {
        let log_scale = DVec3::splat(6.0);
        // Transmittances 0.2, 0.04, 0.008, 0.0016, 0.00032; the next, 0.000064, would be below the limit.
        let raw_opacity = 4.0f64.ln();
        setup.set(i, &Gaussian { log_scale, raw_opacity, ..plain(&setup, 2.0 + i as f64) });
    }
    let mut rendered = setup.render();
    let expected = [0.2f32.powi(5); 256];
    assert_close("transmittances", &rendered.transmittances, &expected, |_, t| 0.02 * t);
    let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
    for i in 0..9 {
        let gradient = setup.planes().load(&gradients.parameters, i);
        assert_eq!(gradient.sh[0] == DVec3::ZERO, i >= 5, "{i}: {gradient:?}");
        assert_eq!(gradient.raw_opacity == 0.0, i >= 5, "{i}: {gradient:?}");
    }
}

// ---------------------------------------------------------------------------
// Tiles

/// Thousands of Gaussians, from dots to needles that cross the image many times over.
fn needles(count: usize) -> Setup {
    let mut setup = Setup::new(count, [123, 85], 0, 77);
    let mut random = Random::new(78);
    for i in 0..count {
        let log_scale = DVec3::from_array([0; 3].map(|_| random.between(-10.0, 3.0)));
        let gaussian = Gaussian { log_scale, ..setup.get(i) };
        setup.set(i, &gaussian);
    }
    setup
}

/// Every intersection of a render: tile and Gaussian.
fn intersections(rendered: &Rendered<'_>) -> Vec<(u32, u32)> {
    let lists = &rendered.renderer.frame().lists;
    let [tiles, intersection_ids, gaussian_ids, counts] =
        [&lists.tiles, &lists.intersection_ids, &lists.gaussian_ids, &lists.counts]
            .map(|buffer| gpu().read(buffer).unwrap());
    let gaussian_ids =
        intersection_ids[..counts[0] as usize].iter().map(|&slot| gaussian_ids[slot as usize]);
    tiles.into_iter().zip(gaussian_ids).collect()
}

/// Those of the tiles that subgroups of this device support.
fn suited<const N: usize>(tiles: [([u32; 2], u32); N]) -> impl Iterator<Item = Tile> {
    tiles.into_iter().map(tile_of).filter(|&tile| gpu().properties().suits_tile(tile))
}

#[test]
fn counting_and_emitting_agree() {
    for tile in suited([([16, 16], 1), ([16, 8], 1), ([8, 8], 1)]) {
        let mut setup = needles(5000);
        setup.settings.tile = Some(tile);
        let [width, height] = tile.size;
        let all = intersections(&setup.render());
        assert!(all.len() > 20_000, "{}", all.len());
        let tile_count = setup.camera.width.div_ceil(width) * setup.camera.height.div_ceil(height);
        assert!(all.iter().all(|&(tile, _)| tile < tile_count), "a slot is padding");
        assert_eq!(all.iter().collect::<HashSet<_>>().len(), all.len(), "one is a duplicate");
    }
}

#[test]
fn both_sorts_give_the_same_bits() {
    let form = BackwardForm { segment: 64, sums: RecordSums::Shuffles };
    for backward in [None, Some(form)] {
        let [whole, tiles] = [Sorting::Whole, Sorting::Tiles].map(|sorting| {
            let mut setup = needles(3000);
            setup.settings.sorting = Some(sorting);
            let tile = setup.settings.tile_on(&gpu()).unwrap();
            setup.settings.tile = Some(Tile { backward, ..tile });
            let mut rendered = setup.render();
            let d_render: Vec<f32> = rendered.render.iter().map(|value| value - 0.5).collect();
            let gradients = rendered.backward(&d_render);
            (rendered.render.clone(), rendered.transmittances.clone(), gradients)
        });
        assert!(whole == tiles, "{backward:?}");
    }
}

#[test]
fn no_visible_pixel_is_missed() {
    let mut setup = needles(2000);
    setup.settings.tile = Some([16, 8].into());
    let rendered = setup.render();
    let seen: HashSet<_> = intersections(&rendered).into_iter().collect();
    let splats = gpu().read(&rendered.renderer.frame().splats).unwrap();
    let (width, height) = (setup.camera.width, setup.camera.height);
    let (mut visible, mut missed) = (0, vec![]);
    for (id, projected) in (0..).zip(&splats) {
        let splat = Splat::from(projected);
        for y in 0..height {
            let [first, last] = splat_columns(projected, y as f32, y as f32);
            for x in 0..width {
                let sigma = splat.sigma(splat.mean2d - DVec2::new(x.into(), y.into()) - 0.5);
                let alpha = splat.opacity * (-sigma).exp();
                if !(sigma >= 0.0 && alpha >= ALPHA_MIN) {
                    continue;
                }
                visible += 1;
                let tile = y / 8 * width.div_ceil(16) + x / 16;
                let is_in_row = (first..=last).contains(&(x as i32));
                if !is_in_row || !seen.contains(&(tile, id)) {
                    let ProjectedSplat { mean2d, conic, .. } = projected;
                    missed.push(format!("({x}, {y}) of {id}, {mean2d} {conic}: alpha = {alpha}"));
                }
            }
        }
    }
    assert!(visible > 100_000, "{visible}");
    let shown = &missed[..missed.len().min(10)];
    assert!(missed.is_empty(), "{} of {visible}: {shown:#?}", missed.len());
}

#[test]
fn neither_tiles_nor_the_order_of_gaussians_change_a_bit() {
    // Faint, so that nothing occludes a Gaussian that another tile missed; no two at the same depth, where the order
    // would decide.
    let mut setup = needles(1000);
    let camera = setup.camera();
    for i in 0..setup.count {
        let gaussian = setup.get(i);
        let nearer = (1.0 + 0.004 * i as f64) / camera.view(gaussian.mean).z;
        let mean = camera.center() + (gaussian.mean - camera.center()) * nearer;
        setup.set(i, &Gaussian { mean, raw_opacity: -4.0, ..gaussian });
    }
    let mut reversed = setup.clone();
    (0..setup.count).for_each(|i| reversed.set(i, &setup.get(setup.count - 1 - i)));
    let mut first: Option<(Vec<f32>, Vec<f32>)> = None;
    for setup in [&mut setup, &mut reversed] {
        let alone = [[16, 16], [16, 8], [8, 8], [32, 4], [64, 4]].map(|size| (size, 1));
        let shares = [([16, 16], 2), ([16, 16], 4), ([32, 16], 4), ([8, 8], 2)];
        for tile in suited(alone).chain(suited(shares)) {
            setup.settings.tile = Some(tile);
            let Rendered { render, transmittances, .. } = setup.render();
            let (first_render, first_transmittances) =
                first.get_or_insert_with(|| (render.clone(), transmittances.clone()));
            assert!(render == *first_render, "{tile:?}");
            assert!(transmittances == *first_transmittances, "{tile:?}");
        }
    }
}

// ---------------------------------------------------------------------------
// Golden renders

/// A render or its golden counterpart: (channels + 1, H, W), the last plane being the transmittances.
fn planes(render: Vec<f32>, transmittances: Vec<f32>) -> Vec<f32> {
    [render, transmittances].concat()
}

/// Panics with the largest difference and its position.
fn assert_golden(name: &str, setup: &Setup, golden: &[f32], tolerance: f32) {
    let Rendered { render, transmittances, .. } = setup.render();
    let actual = planes(render, transmittances);
    assert_eq!(actual.len(), golden.len(), "{name}");
    let difference = |&at: &usize| (actual[at] - golden[at]).abs();
    // NaN counts as the largest.
    let by = |a: &usize, b: &usize| difference(a).total_cmp(&difference(b));
    let at = (0..golden.len()).max_by(by).unwrap();
    let (pixel, width) = (at % setup.pixels(), setup.camera.width as usize);
    let (x, y, channel) = (pixel % width, pixel / width, at / setup.pixels());
    let (largest, actual, golden) = (difference(&at), actual[at], golden[at]);
    assert!(
        largest <= tolerance,
        "{name}: off by {largest:e} at most, at pixel ({x}, {y}) of channel {channel}: {actual}, golden {golden}"
    );
}

/// The scenes of `tests/fixtures/golden`; its README describes the files.
fn golden_setups() -> [(&'static str, Setup); 3] {
    let plain = Setup::new(16, [24, 16], 2, 90);
    let shape = Shape { sh_degree: 0, features: Features::ALL };
    let mut features = Setup::new(12, [16, 12], shape, 91);
    features.settings.raw_colors = true;
    let mut antialiased = Setup::new(16, [24, 16], 1, 92);
    antialiased.settings.antialiased = true;
    [("plain", plain), ("features", features), ("antialiased", antialiased)]
}

/// The rounding error of a render: dozens of operations on values of a few units.
const GOLDEN_TOLERANCE: f32 = 1e-5;

#[test]
fn renders_agree_with_golden_renders_of_the_f64_chain() {
    for (name, mut setup) in golden_setups() {
        let path = fixture("golden").join(name).with_extension("safetensors");
        if std::env::var_os("NIGHTSPLAT_WRITE_GOLDEN").is_some() {
            write_golden(&path, &setup);
        }
        let golden = safetensors::read(path);
        setup.parameters.clone_from(&golden["parameters"]);
        let [x, y, z, translation] =
            [0, 3, 6, 9].map(|at| Vec3::from_slice(&golden["view_from_world"][at..]).as_dvec3());
        setup.camera.view_from_world = DAffine3 { matrix3: DMat3::from_cols(x, y, z), translation };
        setup.camera.focal = Vec2::from_slice(&golden["focal"]).as_dvec2();
        setup.camera.principal_point = Vec2::from_slice(&golden["principal_point"]).as_dvec2();
        let golden = planes(golden["render"].clone(), golden["transmittances"].clone());
        assert_golden(name, &setup, &golden, GOLDEN_TOLERANCE);
    }
}

/// Renders on the CPU in f64; refuses a scene whose visibility depends on a rounding.
fn write_golden(path: &Path, setup: &Setup) {
    let chain = Chain::new(setup);
    let results = chain.run(&chain.parameters());
    for seed in 0..20 {
        let jittered = chain.run(&chain.jitter(seed));
        let moved = results.render.iter().zip(&jittered.render).map(|(a, b)| (a - b).abs());
        let most = moved.fold(0.0, f64::max);
        assert!(
            most < 10.0 * f64::from(GOLDEN_TOLERANCE),
            "{path:?} depends on a rounding: {most}"
        );
    }
    let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect::<Vec<_>>();
    let Camera { width, height, focal, principal_point, view_from_world, .. } = setup.camera;
    let (width, height) = (width as usize, height as usize);
    safetensors::write(
        path,
        &[
            ("parameters", &[setup.parameters.len()], &setup.parameters),
            ("view_from_world", &[4, 3], &narrow(&view_from_world.to_cols_array())),
            ("focal", &[2], &narrow(&focal.to_array())),
            ("principal_point", &[2], &narrow(&principal_point.to_array())),
            ("render", &[setup.channels(), height, width], &narrow(&results.render)),
            ("transmittances", &[height, width], &narrow(&results.transmittances)),
        ],
    );
}

#[test]
fn renders_agree_with_golden_renders_of_another_renderer() {
    let Some(folder) = shared("data/fixtures/golden_render") else { return };
    for case in ["tiny_case", "basic_case"] {
        let golden = safetensors::read(folder.join(case).with_extension("safetensors"));
        let row = |name: &str, width: usize, i: usize| -> Vec<f64> {
            golden[name][width * i..][..width].iter().map(|&v| v.into()).collect()
        };
        let mut setup = Setup::new(golden["opacities"].len(), [123, 82], 3, 0);
        setup.camera.view_from_world =
            DAffine3::from_translation(Vec3::new(-0.123, -0.456, 8.0).as_dvec3());
        setup.camera.focal = DVec2::splat(0.5 * 123.0);
        setup.camera.principal_point = DVec2::new(61.5, 41.0);
        (setup.settings.near, setup.settings.max_alpha) = (0.01, 0.999);
        setup.options.background = [0.0; 3];
        for i in 0..setup.count {
            let gaussian = Gaussian {
                mean: DVec3::from_slice(&row("means", 3, i)),
                quat: DVec4::from_slice(&row("quats", 4, i)),
                log_scale: DVec3::from_slice(&row("scales", 3, i)),
                raw_opacity: row("opacities", 1, i)[0],
                features: vec![],
                sh: row("coeffs", 48, i).chunks(3).map(DVec3::from_slice).collect(),
            };
            setup.set(i, &gaussian);
        }
        // (H, W, RGBA), where A is one minus the transmittance.
        let plane = |c: usize| golden["out_img"].iter().skip(c).step_by(4).copied();
        let transmittances = plane(3).map(|alpha| 1.0 - alpha).collect();
        let golden = planes((0..3).flat_map(plane).collect(), transmittances);
        assert_golden(case, &setup, &golden, 1e-4);
    }
}

#[test]
fn gaussians_of_another_shape_or_storage_are_refused() {
    let gpu = gpu();
    let setup = Setup::new(10, [32, 24], Shape { sh_degree: 1, features: features(4) }, 1);
    let settings = |shape: Shape, rest| RenderSettings { shape, rest, ..setup.settings };
    let given = setup.settings.shape;
    for (settings, why) in [
        (settings(given, StorageFormat::Half), "SH coefficients as Single"),
        (
            settings(0.into(), StorageFormat::Single),
            "Gaussians of SH degree 1 with depth cannot be rendered by a renderer made for SH degree 0",
        ),
        (settings(Shape { sh_degree: 3, ..given }, StorageFormat::Single), "made for SH degree 3"),
    ] {
        let mut renderer = Renderer::new(&gpu, settings).unwrap();
        renderer.reserve(setup.count, [&setup.camera]).unwrap();
        let refused = renderer.render_image(&setup.upload(), &setup.camera, &setup.options);
        let message = refused.unwrap_err().to_string();
        assert!(message.contains(why), "{message}");
    }
}

#[test]
fn only_the_given_gaussians_are_rendered_however_many_are_reserved() {
    let gpu = gpu();
    let setup = Setup::new(100, [32, 24], 0, 1);
    let mut subset = setup.gaussians();
    // The first of every plane: a subset of the Gaussians.
    subset = Gaussians { count: 10, parameters: vec![], ..subset };
    for (attribute, width) in [
        (Attribute::Means, 3),
        (Attribute::Quats, 4),
        (Attribute::LogScales, 3),
        (Attribute::RawOpacities, 1),
        (Attribute::Dc, 3),
    ] {
        let all = setup.gaussians();
        subset.parameters.extend(&all.parameters[all.plane(attribute)][..10 * width]);
    }
    let render = |renderer: &mut Renderer, gaussians: &Gaussians| {
        let gaussians = gaussians.upload(&gpu).unwrap();
        renderer.render_image(&gaussians, &setup.camera, &setup.options).unwrap()
    };
    let alone = || {
        let mut renderer = Renderer::new(&gpu, setup.settings).unwrap();
        renderer.reserve(10, [&setup.camera]).unwrap();
        renderer
    };
    let expected = render(&mut alone(), &subset);
    let mut renderer = Renderer::new(&gpu, setup.settings).unwrap();
    renderer.reserve(300, [&setup.camera]).unwrap();
    let all = render(&mut renderer, &setup.gaussians());
    assert!(render(&mut renderer, &subset) == expected && all != expected);
    let too_many = setup.gaussians().upload(&gpu).unwrap();
    let refused = alone().render_image(&too_many, &setup.camera, &setup.options).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "100 Gaussians exceed the 10 that the renderer has; call `Renderer::reserve`"
    );
}
