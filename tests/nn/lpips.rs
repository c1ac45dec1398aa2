//! LPIPS against `PyTorch`'s, on weights that both make by a formula: `scripts/lpips-reference.py` prints what is expected.

use glam::UVec2;
use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::gpu;
use nightsplat::image::Image;
use nightsplat::kernels::*;
use nightsplat::lpips::Lpips;

use super::common::Random;
use super::common::lpips::{noise, write};
use super::common::safetensors;

fn picture(width: u32, height: u32, salt: u64) -> Image {
    let value = |at: usize| {
        let ramp = (at % width as usize) as f64 / f64::from(width);
        (0.5 * (noise(at, salt) + 0.5) + 0.5 * ramp) as f32
    };
    Image { width, height, data: (0..3 * (width * height) as usize).map(value).collect() }
}

#[test]
fn the_distance_is_pytorch_s() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lpips.safetensors");
    write(&path, |_, _, _| {});
    let lpips = Lpips::load(&gpu(), &path).unwrap();
    for (width, height, far, near) in EXPECTED {
        let (a, b) = (picture(width, height, 100), picture(width, height, 200));
        let mix = a.data.iter().zip(&b.data).map(|(a, b)| 0.9 * a + 0.1 * b).collect();
        let mixed = Image { data: mix, ..a.clone() };
        for (other, expected) in [(&b, far), (&mixed, near), (&a, 0.0)] {
            let distance = lpips.distance(&gpu(), &a, other).unwrap();
            // Pictures that are nearly alike differ by little more than both sides round their activations.
            let bound = 1e-4 * expected + 1e-5 * far;
            assert!(
                (distance - expected).abs() <= bound,
                "{width}x{height}: {distance}, not {expected}"
            );
            let turned = lpips.distance(&gpu(), other, &a).unwrap();
            assert_eq!(distance, turned, "as far one way as the other");
        }
    }
    let small = picture(30, 40, 1);
    let message = lpips.distance(&gpu(), &small, &small).unwrap_err().to_string();
    assert!(message.contains("31 pixels") && message.contains("30x40"), "{message}");
    let message = lpips.distance(&gpu(), &small, &picture(40, 30, 1)).unwrap_err().to_string();
    assert!(message.contains("different sizes"), "{message}");
}

/// Width, height, the distance of two pictures and of one from a tenth of the way to the other.
const EXPECTED: [(u32, u32, f64, f64); 3] = [
    (31, 31, 3.992542e-03, 6.721584e-05),
    (64, 48, 1.379768e-02, 1.342563e-04),
    (97, 70, 1.059226e-02, 1.753946e-04),
];

#[test]
fn weights_of_another_network_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lpips.safetensors");
    let refused = |parts: &[&str]| {
        let message = Lpips::load(&gpu(), &path).unwrap_err().to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        assert!(!message.contains('\n') && message.contains("lpips.safetensors"), "{message}");
    };
    refused(&["cannot be read"]);
    std::fs::write(&path, "no weights").unwrap();
    refused(&["no whole safetensors file"]);
    write(&path, |name, shape, values| {
        if name == "net.slice1.0.weight" {
            *shape = vec![64, 3, 3, 3];
            values.truncate(64 * 27);
        }
    });
    refused(&["`net.slice1.0.weight` is [64, 3, 3, 3]", "not [64, 3, 11, 11]", "docs/guide.md"]);
    write(&path, |name, _, values| {
        if name == "lin4.model.1.weight" {
            values[7] = f32::NAN;
        }
    });
    refused(&["`lin4.model.1.weight`", "not finite"]);
    safetensors::write(&path, &[("net.slice1.0.bias", &[1], &[0.0])]);
    refused(&["has no tensor `net.slice1.0.weight`"]);
}

#[test]
fn a_strided_convolution_matches_its_reference() {
    let mut random = Random::new(3);
    for (size, window, stride, padding, in_channels, out_channels) in [
        ([31, 33], 11, 4, 2, 3, 9),
        ([7, 5], 5, 1, 2, 2, 16),
        ([3, 1], 3, 1, 1, 5, 1),
        ([1, 1], 1, 1, 0, 1, 8),
        ([9, 40], 4, 3, 0, 2, 17),
    ] {
        let size = UVec2::from_array(size);
        let mut image = |count: u32| -> Vec<f32> {
            (0..count).map(|_| random.between(-1.0, 1.0) as f32).collect()
        };
        let target_size = (size + 2 * padding - window) / stride + 1;
        let target = image(out_channels * target_size.element_product());
        let values = image(5 + out_channels * (in_channels * window * window + 1));
        let source = image(in_channels * size.element_product());
        let constants = conv_strided::Constants::default();
        let threads = out_channels.div_ceil(constants.out_block) * target_size.element_product();
        run_kernel!(
            conv_strided,
            constants,
            conv_strided::Params {
                size,
                target_size,
                in_channels,
                out_channels,
                window,
                stride,
                padding,
                offset: 5
            },
            Threads::Exactly([threads, 1, 1]),
            [values, source],
            [target]
        );
    }
}

#[test]
fn pooling_matches_its_reference() {
    let mut random = Random::new(4);
    for (size, window, stride, channels) in
        [([31, 33], 3, 2, 5), ([3, 3], 3, 2, 1), ([1, 9], 1, 3, 2), ([8, 7], 2, 2, 70)]
    {
        let size = UVec2::from_array(size);
        let target_size = (size - window) / stride + 1;
        let pixels = channels * size.element_product();
        let mut source: Vec<f32> = (0..pixels).map(|_| random.between(-1.0, 1.0) as f32).collect();
        source[0] = f32::NEG_INFINITY;
        let target = vec![0.0_f32; (channels * target_size.element_product()) as usize];
        let threads = Threads::Exactly([target.len() as u32, 1, 1]);
        run_kernel!(
            max_pool,
            max_pool::Constants::default(),
            max_pool::Params { size, target_size, channels, window, stride },
            threads,
            [source],
            [target]
        );
    }
}
