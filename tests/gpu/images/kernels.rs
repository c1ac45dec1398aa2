//! The kernels between a render and an image.

use super::*;

/// Of a pixel.
pub(super) fn words_of(storage: u32) -> usize {
    match storage {
        pixels::STORED_HALVES => 2,
        pixels::STORED_FLOATS => 4,
        _ => 1,
    }
}

/// A word of a pixel, whose numbers are 0 to 2.
pub(super) fn random_word(storage: u32, random: &mut Random) -> u32 {
    let half = |x: f64| u32::from(f16::from_f64(x).to_bits());
    match storage {
        pixels::STORED_HALVES => {
            half(random.between(0.0, 2.0)) | half(random.between(0.0, 1.0)) << 16
        }
        pixels::STORED_FLOATS => (random.between(0.0, 2.0) as f32).to_bits(),
        // Without the highest bits of the exponents.
        pixels::STORED_SMALL_FLOATS => {
            random.between(0.0, 4e9) as u32 & !(1 << 10 | 1 << 21 | 1 << 31)
        }
        _ => random.between(0.0, 4e9) as u32,
    }
}

/// Packs pixels and depths on the device, which agree with the reference.
fn pack(
    params: pack_pixels::Params,
    render: Vec<f32>,
    transmittances: Vec<f32>,
    under: Vec<u32>,
    scene: Vec<u32>,
) -> (Vec<u32>, Vec<f32>) {
    let count = transmittances.len();
    let (pixels, depths) = (vec![7u32; words_of(params.storage) * count], vec![7.0f32; count]);
    run_kernel!(
        pack_pixels,
        pack_pixels::Constants {},
        params,
        Threads::Exactly([count as u32, 1, 1]),
        [render, transmittances, under, scene],
        [pixels, depths]
    )
}

#[test]
fn pixels_of_every_encoding_agree_with_their_reference() {
    let mut random = Random::new(3);
    let count = 500;
    for stored in COLOR_FORMATS {
        for flags in 0..4 {
            let [is_over, is_mean] = [0, 1].map(|bit| flags >> bit & 1);
            let render: Vec<f32> =
                (0..4 * count).map(|_| random.between(-0.1, 1.4) as f32).collect();
            let mut transmittances: Vec<f32> =
                (0..count).map(|_| random.between(0.0, 1.0) as f32).collect();
            transmittances[..2].copy_from_slice(&[1.0, 1e-4]);
            let words = words_of(stored.storage) * count;
            let under = (0..words).map(|_| random_word(stored.storage, &mut random)).collect();
            let params = pack_pixels::Params {
                pixel_count: count as u32,
                storage: stored.storage,
                light: stored.light,
                swaps: stored.swaps,
                is_over,
                exposure: 1.7,
                nits: NITS,
                background: Vec3::new(0.1, 0.5, 0.02),
                depth_plane: 3,
                is_mean,
                is_linear_depth: 1,
                has_color: 1,
                ..pack_pixels::Params::default()
            };
            let (_, depths) = pack(params, render, transmittances, under, vec![]);
            assert_eq!(depths[0].is_infinite(), is_mean == 1, "nothing is seen at pixel 0");
        }
    }
}

/// The codes of numbers, by the formats' definitions: what no format has becomes 0 or its largest number.
#[test]
fn numbers_of_every_format_are_rounded_once_and_bounded() {
    const LARGEST: f32 = f32::MAX;
    let of_floats = |x: f32| vec![x.to_bits(), x.to_bits(), x.to_bits(), 1f32.to_bits()];
    let of_small = |eleven: u32, ten: u32| vec![eleven | eleven << 11 | ten << 22];
    let of_tens = |code: u32| vec![code | code << 10 | code << 20 | 3 << 30];
    let of_halves = |bits: u32| vec![bits | bits << 16, bits | 0x3c00 << 16];
    let (small, tens) = (pixels::STORED_SMALL_FLOATS, pixels::STORED_TENS);
    let halves = pixels::STORED_HALVES;
    let cases = [
        (pixels::STORED_FLOATS, 0.1, of_floats(0.1)),
        (pixels::STORED_FLOATS, f32::NAN, of_floats(0.0)),
        (pixels::STORED_FLOATS, -2.0, of_floats(0.0)),
        (pixels::STORED_FLOATS, f32::INFINITY, of_floats(LARGEST)),
        (pixels::STORED_FLOATS, LARGEST, of_floats(LARGEST)),
        (small, 1.0, of_small(0x3c0, 0x1e0)),
        (small, 0.0, of_small(0, 0)),
        (small, f32::NAN, of_small(0, 0)),
        (small, -1.0, of_small(0, 0)),
        (small, f32::NEG_INFINITY, of_small(0, 0)),
        (small, f32::INFINITY, of_small(0x7bf, 0x3df)),
        (small, LARGEST, of_small(0x7bf, 0x3df)),
        (small, 65_024.0, of_small(0x7bf, 0x3df)),
        (small, 64_512.0, of_small(0x7be, 0x3df)),
        // A tie is even: between 1 and 1 + 1 / 64, and between that and the next; ten bits have half of these.
        (small, 1.0 + 1.0 / 128.0, of_small(0x3c0, 0x1e0)),
        (small, 1.0 + 3.0 / 128.0, of_small(0x3c2, 0x1e1)),
        // Rounded up to the next power, in the exponent too.
        (small, 1.999, of_small(0x400, 0x200)),
        // The least that are subnormal, half of that, and the largest that rounds up to what is normal.
        (small, 2f32.powi(-20), of_small(1, 0)),
        (small, 3.0 * 2f32.powi(-20), of_small(3, 2)),
        (small, 2f32.powi(-21), of_small(0, 0)),
        (small, 2f32.powi(-14) * 0.9999, of_small(0x40, 0x20)),
        (tens, 0.5, of_tens(512)),
        (tens, 1.0, of_tens(1023)),
        (tens, f32::NAN, of_tens(0)),
        (tens, -1.0, of_tens(0)),
        (tens, f32::INFINITY, of_tens(1023)),
        (tens, LARGEST, of_tens(1023)),
        (halves, f32::NAN, of_halves(0)),
        (halves, f32::INFINITY, of_halves(0x7bff)),
        (halves, 70_000.0, of_halves(0x7bff)),
        (halves, -1.0, of_halves(0)),
    ];
    for (storage, number, expected) in cases {
        let params = pack_pixels::Params {
            pixel_count: 1,
            storage,
            light: pixels::LIGHT_DISPLAY,
            has_color: 1,
            ..pack_pixels::Params::default()
        };
        let (pixels, _) = pack(params, vec![number; 3], vec![0.0], vec![], vec![]);
        assert_eq!(pixels, expected, "{storage} {number}");
    }
}

/// Codes of ST 2084 and BT.2020 from the standards' own tables and definitions.
#[test]
fn hdr10_has_the_codes_of_its_standards() {
    let code = |luminance: f32, color: [f32; 3]| {
        let params = pack_pixels::Params {
            pixel_count: 1,
            storage: pixels::STORED_TENS,
            light: pixels::LIGHT_HDR10,
            exposure: 1.0,
            nits: luminance,
            has_color: 1,
            ..pack_pixels::Params::default()
        };
        let (pixels, _) = pack(params, color.to_vec(), vec![0.0], vec![], vec![]);
        [0, 10, 20].map(|shift| pixels[0] >> shift & 0x3ff)
    };
    // 10-bit codes of full range: 100 nits 0.508, 203 nits 0.581 (BT.2408), 1 000 nits 0.752.
    for (luminance, expected) in [(100.0, 520), (203.0, 594), (1000.0, 769), (10_000.0, 1023)] {
        for channel in code(luminance, [1.0; 3]) {
            assert!(channel.abs_diff(expected) <= 1, "{luminance} nits: {channel}, {expected}");
        }
    }
    assert_eq!(code(203.0, [0.0; 3]), [0; 3]);
    // Red of BT.709 has green and blue of BT.2020.
    let [red, green, blue] = code(203.0, [1.0, 0.0, 0.0]);
    assert!(red > green && green > blue && blue > 0, "{red} {green} {blue}");
}

#[test]
fn depths_are_stored_by_every_projection_and_read_back() {
    let depths = [0.05f32, 0.1, 0.5, 2.0, 39.0, 40.0, 41.0, 3.4e38];
    let count = depths.len();
    let scene = vec![0.25f32.to_bits(); count];
    for (is_reversed, far) in [(0, 0.0), (1, 0.0), (0, 40.0), (1, 40.0)] {
        for has_scene in [0, 1] {
            let params = pack_pixels::Params {
                pixel_count: count as u32,
                depth_plane: 1,
                is_reversed,
                near: 0.1,
                far,
                has_scene,
                ..pack_pixels::Params::default()
            };
            let render = [vec![0.0; count], depths.to_vec()].concat();
            let transmittances = vec![0.0; count];
            let (_, stored) = pack(params, render, transmittances, vec![], scene.clone());
            assert!(stored.iter().all(|d| (0.0..=1.0).contains(d)), "{stored:?}");
            let [nearest, farthest] = if is_reversed == 1 { [1.0, 0.0] } else { [0.0, 1.0] };
            assert!((stored[0] - nearest).abs() < 1e-6, "before the near plane: {stored:?}");
            let unseen = if has_scene == 1 { 0.25 } else { farthest };
            assert_eq!(stored[count - 1], unseen, "{stored:?}");
            let read = depth_limits::Params {
                pixel_count: count as u32,
                format: pixels::DEPTH_FLOAT,
                is_reversed,
                is_linear: 0,
                is_orthographic: 0,
                near: 0.1,
                far,
            };
            let words = stored.iter().map(|depth| depth.to_bits()).collect();
            let limits = read_back(read, words);
            for (depth, limit) in depths.iter().zip(&limits).skip(1).take(4) {
                assert!((limit / depth - 1.0).abs() < 2e-3, "{depth} {limit}");
            }
        }
    }
}

fn read_back(params: depth_limits::Params, words: Vec<u32>) -> Vec<f32> {
    let count = words.len();
    let limits = vec![7.0f32; count];
    run_kernel!(
        depth_limits,
        depth_limits::Constants {},
        params,
        Threads::Exactly([count as u32, 1, 1]),
        [words],
        [limits]
    )
}

#[test]
fn depths_of_every_format_and_convention_agree_with_their_reference() {
    let mut random = Random::new(4);
    let count = 600;
    for format in [pixels::DEPTH_FLOAT, pixels::DEPTH_24, pixels::DEPTH_16] {
        for (is_reversed, far) in [(0, 0.0), (1, 0.0), (0, 50.0), (1, 50.0)] {
            let word = |i: usize, random: &mut Random| match (format, i) {
                (pixels::DEPTH_FLOAT, 0) => 0.0f32.to_bits(),
                (pixels::DEPTH_FLOAT, 1) => 1.0f32.to_bits(),
                (pixels::DEPTH_FLOAT, 2) => f32::NAN.to_bits(),
                (pixels::DEPTH_FLOAT, _) => (random.between(0.0, 1.0) as f32).to_bits(),
                (_, 0) => 0,
                (_, 1) => u32::MAX,
                _ => random.between(0.0, 4e9) as u32,
            };
            let words: Vec<u32> = (0..count).map(|i| word(i, &mut random)).collect();
            let limits = vec![7.0f32; count];
            let (is_linear, near) = (0, 0.1);
            let params = depth_limits::Params {
                pixel_count: count as u32,
                format,
                is_reversed,
                is_linear,
                is_orthographic: 0,
                near,
                far,
            };
            let limits = run_kernel!(
                depth_limits,
                depth_limits::Constants {},
                params,
                Threads::Exactly([count as u32, 1, 1]),
                [words],
                [limits]
            );
            // What the host cleared hides nothing; its near plane is the near plane.
            let (cleared, nearest) = if is_reversed == 1 { (0, 1) } else { (1, 0) };
            if format == pixels::DEPTH_FLOAT {
                assert!(limits[cleared] > 3e38 && limits[2] > 3e38, "{limits:?}");
            }
            if format != pixels::DEPTH_16 {
                assert!((limits[nearest] - near).abs() < 1e-6, "{}", limits[nearest]);
            }
        }
    }
}
