//! The kernels between a render and an image.

use super::*;

#[test]
fn pixels_of_every_encoding_agree_with_their_reference() {
    let mut random = Random::new(3);
    let count = 500;
    for encoding in 0..4 {
        for flags in 0..8 {
            let [swaps, is_over, is_mean] = [0, 1, 2].map(|bit| flags >> bit & 1);
            let render: Vec<f32> =
                (0..4 * count).map(|_| random.between(-0.1, 1.4) as f32).collect();
            let mut transmittances: Vec<f32> =
                (0..count).map(|_| random.between(0.0, 1.0) as f32).collect();
            transmittances[..2].copy_from_slice(&[1.0, 1e-4]);
            let under: Vec<u32> = match encoding {
                0 | 1 => (0..2 * count).map(|_| halves(&mut random)).collect(),
                _ => (0..count).map(|_| random.between(0.0, 4e9) as u32).collect(),
            };
            let (pixels, depths) = (vec![7u32; under.len()], vec![7.0f32; count]);
            let params = pack_pixels::Params {
                pixel_count: count as u32,
                encoding,
                swaps,
                is_over,
                exposure: 1.7,
                background: Vec3::new(0.1, 0.5, 0.02),
                depth_plane: 3,
                is_mean,
                has_color: 1,
            };
            let (_, depths) = run_kernel!(
                pack_pixels,
                pack_pixels::Constants {},
                params,
                Threads::Exactly([count as u32, 1, 1]),
                [render, transmittances, under],
                [pixels, depths]
            );
            assert_eq!(depths[0].is_infinite(), is_mean == 1, "nothing is seen at pixel 0");
        }
    }
}

pub(super) fn halves(random: &mut Random) -> u32 {
    let half = |x: f64| u32::from(f16::from_f64(x).to_bits());
    half(random.between(0.0, 2.0)) | half(random.between(0.0, 1.0)) << 16
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
