//! The forward kernels of the rasteriser: against their references, at their limits, and against golden renders.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::collections::HashSet;
use std::path::Path;

use glam::{DVec2, DVec3, DVec4, UVec2, Vec2};
use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::{assert_no_validation_messages, gpu};
use nightsplat::kernels::emit::NO_TILE;
use nightsplat::kernels::project::CULLED;
use nightsplat::kernels::splat::ALPHA_MIN;
use nightsplat::kernels::{
    ProjectedSplat, blend_forward, check_capacity, emit, order_counts, project, tile_ranges,
};
use nightsplat::reference::gaussian::Gaussian;
use nightsplat::reference::splat::{Splat, splat_columns};

#[macro_use]
mod common;
use common::model::{ROUNDING, model_tile};
use common::{Frame, Random, Setup, UNWRITTEN, assert_close, forward};

#[test]
fn project_matches_the_reference() {
    for setup in common::variants() {
        let frame = forward(&setup, None);
        let (splats, colors) =
            (vec![ProjectedSplat::default(); frame.splats.len()], common::initial_colors(&setup));
        let [depth_keys, ids, tile_counts] = [0; 3].map(|_| vec![0u32; splats.len()]);
        let Setup { parameters, params, .. } = &setup;
        let (splats, colors, depth_keys, ids, tile_counts) = run_reference!(
            project,
            constants!(project, setup, sh_degree, raw_colors),
            params,
            [parameters],
            [splats, colors, depth_keys, ids, tile_counts]
        );
        assert_eq!(frame.ids, ids);
        let size = params.camera.size.max_element() as f32;
        // exp of a log scale is good to 3 + 2 |x| units and enters cov2d squared; the rest are a few dozen roundings.
        let loose = 256.0 * ROUNDING as f32;
        let tight = 32.0 * ROUNDING as f32;
        let each = |value: fn(&ProjectedSplat) -> Vec<f32>| {
            move |splats: &[ProjectedSplat]| splats.iter().flat_map(value).collect::<Vec<_>>()
        };
        let means = each(|s| s.mean2d.to_array().into());
        assert_close("mean2d", &means(&frame.splats), &means(&splats), |_, m| {
            tight * (m.abs() + size)
        });
        let conics = each(|s| s.conic.to_array().into());
        let widest = |i: usize| splats[i / 3].conic.x.max(splats[i / 3].conic.z);
        assert_close("conic", &conics(&frame.splats), &conics(&splats), |i, _| loose * widest(i));
        let opacities = each(|s| vec![s.opacity]);
        assert_close("opacity", &opacities(&frame.splats), &opacities(&splats), |_, o| tight * o);
        let extents = each(|s| s.half_extent.to_array().into());
        assert_close("half_extent", &extents(&frame.splats), &extents(&splats), |_, e| loose * e);
        // Sixteen terms of magnitude 3 or so.
        assert_close("colors", &frame.colors, &colors, |_, _| tight * 16.0);
        for i in 0..splats.len() {
            // A tile whose border lies within rounding of the ellipse may count or not.
            let [most, least] =
                [1.0 + loose, 1.0 - loose].map(|f| tiles_of(&scaled(&splats[i], f), &setup).len());
            let count = frame.tile_counts[i] as usize;
            let is_culled = splats[i] == ProjectedSplat::default();
            assert!(if is_culled { count == 0 } else { (least..=most).contains(&count) }, "{i}");
            let expected = f32::from_bits(depth_keys[i]);
            let actual = f32::from_bits(frame.depth_keys[i]);
            assert_eq!(frame.depth_keys[i] == CULLED, count == 0, "{i}");
            assert!(
                count == 0 || tile_counts[i] == 0 || (actual - expected).abs() <= tight * expected
            );
        }
    }
    assert_no_validation_messages();
}

/// The splat grown by a factor about its mean.
fn scaled(splat: &ProjectedSplat, factor: f32) -> ProjectedSplat {
    let (conic, half_extent) = (splat.conic / (factor * factor), splat.half_extent * factor);
    ProjectedSplat { conic, half_extent, ..*splat }
}

/// The tiles that the reference gives a splat.
fn tiles_of(splat: &ProjectedSplat, setup: &Setup) -> Vec<u32> {
    use nightsplat::reference::splat::{splat_tile_rows, splat_tiles};
    let UVec2 { x: width, y: height } = setup.params.camera.size;
    let [top, bottom] = splat_tile_rows(splat, height, setup.tile);
    let row = |row| {
        let [first, end] = splat_tiles(splat, row, width, setup.tile);
        (first..end).map(move |column| row * setup.tiles().x + column)
    };
    (top..bottom).flat_map(row).collect()
}

#[test]
fn the_binning_kernels_match_their_references() {
    for setup in common::variants() {
        let frame = forward(&setup, None);
        let n = setup.params.gaussian_count;
        let Frame { sorted_ids, tile_counts, splats, offsets, counts, sorted_tiles, .. } = &frame;
        let ordered_counts = vec![0; n as usize];
        let ordered_counts = run_reference!(
            order_counts,
            order_counts::Constants::default(),
            order_counts::Params { gaussian_count: n },
            [sorted_ids, tile_counts],
            [ordered_counts]
        );
        assert_eq!(frame.ordered_counts, ordered_counts);

        let [tiles, slots, owners] = [0; 3].map(|_| vec![UNWRITTEN; frame.tiles.len()]);
        let (tiles, slots, owners) = run_reference!(
            emit,
            constants!(emit, setup),
            emit::Params {
                size: setup.params.camera.size,
                gaussian_count: n,
                tile_columns: setup.tiles().x
            },
            [counts, sorted_ids, ordered_counts, offsets, splats],
            [tiles, slots, owners]
        );
        assert_eq!((&frame.slots, &frame.owners), (&slots, &owners));
        // A border within rounding of the ellipse moves the slots of one Gaussian.
        let moved = frame.tiles.iter().zip(&tiles).filter(|(a, b)| a != b).count();
        assert!(moved * 1000 <= tiles.len(), "{moved} of {} tiles differ", tiles.len());

        let tile_ranges = vec![UVec2::ZERO; frame.tile_ranges.len()];
        let tile_ranges = run_reference!(
            tile_ranges,
            tile_ranges::Constants::default(),
            tile_ranges::Params { tile_count: setup.tile_count() },
            [counts, sorted_tiles],
            [tile_ranges]
        );
        assert_eq!(frame.tile_ranges, tile_ranges);
    }
    assert_no_validation_messages();
}

#[test]
fn padding_belongs_to_no_tile() {
    for sorted_tiles in [
        vec![],
        vec![3],
        vec![0, 0, 2, 5, NO_TILE],
        vec![NO_TILE; 3],
        (0..1000).map(|i| i / 7).collect(),
    ] {
        let params = tile_ranges::Params { tile_count: 120 };
        let constants = tile_ranges::Constants::default();
        let (counts, tile_ranges) = (vec![sorted_tiles.len() as u32], vec![UVec2::ZERO; 120]);
        let threads = Threads::Exactly([counts[0], 1, 1]);
        let actual = run_kernel!(
            tile_ranges,
            constants,
            params,
            threads,
            [counts, sorted_tiles],
            [tile_ranges]
        );
        let expected =
            run_reference!(tile_ranges, constants, params, [counts, sorted_tiles], [tile_ranges]);
        assert_eq!(actual, expected);
    }
}

#[test]
fn blend_forward_matches_the_reference() {
    for setup in common::variants() {
        let frame = forward(&setup, None);
        let Frame { tile_ranges, sorted_slots, owners, splats, colors, .. } = &frame;
        let (render, transmittances) =
            (vec![f32::NAN; frame.render.len()], vec![f32::NAN; setup.pixels()]);
        let (mut render, mut transmittances) = run_reference!(
            blend_forward,
            constants!(blend_forward, setup),
            common::blend_params(&setup),
            [tile_ranges, sorted_slots, owners, splats, colors],
            [render, transmittances]
        );
        let mut bounds = vec![0.0; setup.pixels()];
        let mut fragile = 0;
        for pixel in (0..tile_ranges.len()).flat_map(|tile| model_tile(&setup, &frame, tile)) {
            bounds[pixel.at] = pixel.error as f32;
            if pixel.is_fragile {
                fragile += 1;
                transmittances[pixel.at] = frame.transmittances[pixel.at];
                for at in (pixel.at..render.len()).step_by(setup.pixels()) {
                    render[at] = frame.render[at];
                }
            }
        }
        assert!(
            fragile * 50 <= setup.pixels(),
            "{fragile} of {} pixels hang on a rounding",
            setup.pixels()
        );
        assert_close("render", &frame.render, &render, |i, _| bounds[i % setup.pixels()]);
        assert_close("transmittances", &frame.transmittances, &transmittances, |i, _| bounds[i]);
        assert!(frame.render.iter().chain(&frame.transmittances).all(|value| value.is_finite()));
    }
    assert_no_validation_messages();
}

#[test]
fn an_overflow_renders_nothing_and_keeps_its_flag() {
    let setup = Setup::new(65, UVec2::new(50, 40), 1, 5);
    let total = forward(&setup, None).counts[0];
    let frame = forward(&setup, Some(total - 1));
    assert_eq!((frame.counts[0], &frame.status), (0, &vec![1, total]));
    assert!(frame.tiles.iter().all(|&tile| tile == UNWRITTEN), "emitted all the same");
    assert!(frame.transmittances.iter().all(|&transmittance| transmittance == 1.0));
    for (at, &value) in frame.render.iter().enumerate() {
        assert_eq!(value, setup.background[at / setup.pixels()]);
    }
    for (total, capacity, before) in
        [(0, 0, [0, 0]), (5, 5, [1, 9]), (6, 5, [2, 1]), (u32::MAX, 5, [0, 0])]
    {
        let (total, counts, status) = (vec![total], vec![7], before.to_vec());
        let params = check_capacity::Params { capacity };
        let constants = check_capacity::Constants::default();
        let threads = Threads::Exactly([1, 1, 1]);
        let (actual, after) =
            run_kernel!(check_capacity, constants, params, threads, [total], [counts, status]);
        let expected = run_reference!(check_capacity, constants, params, [total], [counts, status]);
        assert_eq!((actual, after.clone()), expected);
        assert_eq!(after[0] & before[0], before[0], "a flag was lowered");
    }
    assert_no_validation_messages();
}

/// A Gaussian in the middle of the view of [`Setup::new`], a few pixels wide.
fn plain(setup: &Setup, depth: f64) -> Gaussian {
    let camera = setup.camera();
    let in_view =
        ((camera.size / 2.0 - camera.principal_point) / camera.focal * depth).extend(depth);
    Gaussian {
        mean: camera.rotation.transpose() * (in_view - camera.translation),
        quat: DVec4::new(1.0, 0.2, -0.3, 0.1),
        log_scale: DVec3::splat((4.0 * depth / camera.focal.x).ln()),
        raw_opacity: 1.0,
        ..setup.get(0)
    }
}

#[test]
fn gaussians_out_of_range_leave_no_trace() {
    let mut setup = Setup::new(16, UVec2::new(50, 40), 1, 5);
    let (base, nan, infinity) = (plain(&setup, 3.0), f64::NAN, f64::INFINITY);
    let scale = |s| Gaussian { log_scale: DVec3::splat(s), ..base.clone() };
    let at = |mean| Gaussian { mean, ..base.clone() };
    let opacity = |raw_opacity| Gaussian { raw_opacity, ..base.clone() };
    let cases = [
        plain(&setup, -3.0),
        plain(&setup, 0.19),
        at(DVec3::new(nan, 0.0, 3.0)),
        at(DVec3::new(0.0, nan, 3.0)),
        at(DVec3::new(0.0, 0.0, nan)),
        at(DVec3::splat(infinity)),
        at(DVec3::new(0.0, 0.0, infinity)),
        at(DVec3::new(1e30, -1e30, 3.0)),
        at(base.mean + 100.0 * camera_right(&setup)),
        // 1 / (1 + 254.5) is below 1/255, by less than any rounding may cover.
        opacity(-(254.5f64.ln())),
        opacity(-1000.0),
        opacity(-infinity),
        opacity(nan),
        scale(nan),
        scale(40.0),
        scale(1000.0),
    ];
    for (i, gaussian) in cases.iter().enumerate() {
        setup.set(i, gaussian);
    }
    let frame = forward(&setup, None);
    assert_eq!(frame.tile_counts, [0; 16]);
    assert_eq!(frame.depth_keys, [CULLED; 16]);
    assert!(frame.splats.iter().all(is_finite), "{:?}", frame.splats);
    for (at, &value) in frame.render.iter().enumerate() {
        assert_eq!(value, setup.background[at / setup.pixels()]);
    }
    assert_no_validation_messages();
}

fn is_finite(splat: &ProjectedSplat) -> bool {
    splat.mean2d.is_finite() && splat.conic.is_finite() && splat.half_extent.is_finite()
}

fn camera_right(setup: &Setup) -> DVec3 {
    setup.camera().rotation.transpose() * DVec3::X
}

#[test]
fn extreme_gaussians_stay_finite() {
    let mut setup = Setup::new(9, UVec2::new(50, 40), 1, 5);
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
    let frame = forward(&setup, None);
    assert!(frame.tile_counts.iter().filter(|&&count| count > 0).count() >= 7);
    assert!(frame.splats.iter().all(is_finite), "{:?}", frame.splats);
    assert!(frame.render.iter().chain(&frame.transmittances).all(|value| value.is_finite()));
    let d_render = vec![1.0; frame.render.len()];
    let gradients = common::backward(&setup, &frame, &d_render);
    assert!(gradients.gradients.iter().all(|g| g.is_finite()), "{:?}", gradients.gradients);
    assert!(gradients.grad_norm_sums.iter().all(|g| g.is_finite()));
    assert_no_validation_messages();
}

/// Thousands of Gaussians, from dots to needles that cross the image many times over.
fn needles(count: usize) -> Setup {
    let mut setup = Setup::new(count, UVec2::new(123, 85), 0, 77);
    let mut random = Random::new(78);
    for i in 0..count {
        let log_scale = DVec3::from_array([0; 3].map(|_| random.between(-10.0, 3.0)));
        let gaussian = Gaussian { log_scale, ..setup.get(i) };
        setup.set(i, &gaussian);
    }
    setup
}

#[test]
fn counting_and_emitting_agree() {
    for tile in [[16, 16], [16, 8], [8, 8]] {
        let setup = Setup { tile: tile.into(), ..needles(5000) };
        let frame = forward(&setup, None);
        assert!(frame.counts[0] > 20_000, "{}", frame.counts[0]);
        let (mut padded, mut twice) = (0, 0);
        let mut seen = HashSet::new();
        for (&tile, &owner) in frame.tiles.iter().zip(&frame.owners) {
            padded += usize::from(tile >= setup.tile_count());
            twice += usize::from(!seen.insert((tile, owner)));
        }
        assert_eq!((padded, twice), (0, 0));
    }
    assert_no_validation_messages();
}

#[test]
fn no_visible_pixel_is_missed() {
    let setup = needles(2000);
    let frame = forward(&setup, None);
    let seen: HashSet<_> = frame.tiles.iter().copied().zip(frame.owners.iter().copied()).collect();
    let UVec2 { x: width, y: height } = setup.params.camera.size;
    let (mut visible, mut missed) = (0, vec![]);
    for (id, projected) in frame.splats.iter().enumerate() {
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
                let tile = y / setup.tile.y * setup.tiles().x + x / setup.tile.x;
                let is_in_row = (first..=last).contains(&(x as i32));
                if !is_in_row || !seen.contains(&(tile, id as u32)) {
                    missed.push(format!(
                        "({x}, {y}) of {id}: 255 alpha = {}, {projected:?}",
                        255.0 * alpha
                    ));
                }
            }
        }
    }
    assert!(visible > 100_000, "{visible}");
    assert!(
        missed.is_empty(),
        "{} of {visible}: {:#?}",
        missed.len(),
        &missed[..missed.len().min(10)]
    );
}

#[test]
fn a_pixel_is_done_before_its_transmittance_falls_below_the_limit() {
    let mut setup = Setup::new(9, UVec2::new(16, 16), 0, 5);
    for i in 0..9 {
        let log_scale = DVec3::splat(6.0);
        // Transmittances 0.2, 0.04, 0.008, 0.0016, 0.00032, and 0.000064 would be too little.
        let gaussian =
            Gaussian { log_scale, raw_opacity: 4.0f64.ln(), ..plain(&setup, 2.0 + i as f64) };
        setup.set(i, &gaussian);
    }
    let frame = forward(&setup, None);
    assert_close("transmittances", &frame.transmittances, &[0.2f32.powi(5); 256], |_, t| 0.02 * t);
    let gradients = common::backward(&setup, &frame, &vec![1.0; frame.render.len()]);
    let record = setup.record();
    for (i, d_splat) in gradients.d_splats.chunks_exact(record).enumerate() {
        assert_eq!(d_splat.iter().all(|&d| d == 0.0), i >= 5, "{i}: {d_splat:?}");
    }
}

/// The tensors of a safetensors file, by name.
fn tensors(path: &Path) -> impl Fn(&str) -> Vec<f32> + use<> {
    let bytes = std::fs::read(path).unwrap();
    let data = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..data]).unwrap();
    move |name| {
        let at = |i: usize| data + header[name]["data_offsets"][i].as_u64().unwrap() as usize;
        bytemuck::pod_collect_to_vec(&bytes[at(0)..at(1)])
    }
}

#[test]
fn golden_renders_are_met() {
    let folder =
        Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/fixtures/golden_render"));
    if !folder.is_dir() {
        println!("skipped: {} is absent", folder.display());
        return;
    }
    for case in ["tiny_case", "basic_case"] {
        let tensor = tensors(&folder.join(case).with_extension("safetensors"));
        let [means, quats, scales, opacities] =
            ["means", "quats", "scales", "opacities"].map(&tensor);
        let (coefficients, golden) = (tensor("coeffs"), tensor("out_img"));
        let size = UVec2::new(123, 82);
        let mut setup = Setup::new(opacities.len(), size, 3, 0);
        let [x, y, z] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        setup.params.camera.view_from_world = [x, y, z, [-0.123, -0.456, 8.0]];
        setup.params.camera.focal = Vec2::splat(0.5 * size.x as f32);
        setup.params.camera.principal_point = size.as_vec2() / 2.0;
        setup.params.near = 0.01;
        setup.alpha_max = 0.999;
        setup.background = [0.0; 11];
        let wide = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
        for i in 0..opacities.len() {
            let gaussian = Gaussian {
                mean: DVec3::from_slice(&wide(&means[3 * i..])),
                quat: DVec4::from_slice(&wide(&quats[4 * i..])),
                log_scale: DVec3::from_slice(&wide(&scales[3 * i..])),
                raw_opacity: opacities[i].into(),
                features: vec![],
                sh: wide(&coefficients[48 * i..][..48]).chunks(3).map(DVec3::from_slice).collect(),
            };
            setup.set(i, &gaussian);
        }
        let frame = forward(&setup, None);
        let plane = |c: usize| golden.iter().skip(c).step_by(4).copied();
        let rgb: Vec<f32> = (0..3).flat_map(plane).collect();
        assert_close(case, &frame.render, &rgb, |_, _| 1e-4);
        let alpha: Vec<f32> = frame.transmittances.iter().map(|t| 1.0 - t).collect();
        assert_close(case, &alpha, &plane(3).collect::<Vec<_>>(), |_, _| 1e-4);
    }
    assert_no_validation_messages();
}

#[test]
fn a_count_that_wrapped_around_writes_no_slot_beyond_the_counted() {
    let setup = Setup::new(3, UVec2::new(32, 32), 0, 1);
    let splats = forward(&setup, None).splats;
    // As if the offsets of later ranks had run past the total.
    let (counts, sorted_ids, ordered_counts) = (vec![2], vec![0, 1, 2], vec![4, 4, 4]);
    let offsets = vec![0, 4, u32::MAX - 1];
    let [tiles, slots, owners] = [0; 3].map(|_| vec![7u32; 16]);
    let (tiles, slots, owners) = run_kernel!(
        emit,
        constants!(emit, setup),
        emit::Params {
            size: setup.params.camera.size,
            gaussian_count: 3,
            tile_columns: setup.tiles().x
        },
        Threads::Exactly([3, 1, 1]),
        [counts, sorted_ids, ordered_counts, offsets, splats],
        [tiles, slots, owners]
    );
    let untouched = |slots: &[u32]| slots[2..].iter().all(|&slot| slot == 7);
    assert!(untouched(&tiles) && untouched(&slots) && untouched(&owners));
    assert_no_validation_messages();
}
