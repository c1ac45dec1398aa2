//! LPIPS against `PyTorch`, with weights from the same formula: `scripts/lpips-reference.py` prints the expected
//! values.

use nightsplat::kernels::*;
use nightsplat::networks::lpips::{Lpips, LpipsVersion, Network, Range};

use crate::common::lpips::{noise, write};
use crate::common::prelude::*;
use crate::common::{not_run, safetensors};

fn picture(width: u32, height: u32, salt: u64) -> Image {
    let value = |at: usize| {
        let ramp = (at % width as usize) as f64 / f64::from(width);
        (0.5 * (noise(at, salt) + 0.5) + 0.5 * ramp) as f32
    };
    Image { width, height, data: (0..3 * (width * height) as usize).map(value).collect() }
}

/// Width, height, the distance of two images, and that of one from a tenth of the way to the other.
type Expected = (u32, u32, f64, f64);

fn assert_distances(network: Network, range: Range, expected: &[Expected]) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lpips.safetensors");
    write(network, &path, |_, _, _| {});
    let lpips = Lpips::load(&gpu(), &path, range).unwrap();
    assert_eq!(lpips.measure(), LpipsVersion { network, range }, "told by its tensors");
    for &(width, height, far, near) in expected {
        let (a, b) = (picture(width, height, 100), picture(width, height, 200));
        let mix = a.data.iter().zip(&b.data).map(|(a, b)| 0.9 * a + 0.1 * b).collect();
        let mixed = Image { data: mix, ..a.clone() };
        for (other, expected) in [(&b, far), (&mixed, near), (&a, 0.0)] {
            let distance = lpips.distance(&gpu(), &a, other).unwrap();
            // For almost equal images, the difference is close to the rounding of activations on both sides.
            let bound = 1e-4 * expected + 1e-5 * far;
            assert!(
                (distance - expected).abs() <= bound,
                "{width}x{height}: {distance}, not {expected}"
            );
            let turned = lpips.distance(&gpu(), other, &a).unwrap();
            assert_eq!(distance, turned, "as far one way as the other");
        }
    }
}

#[test]
fn the_distance_of_alexnet_agrees_with_pytorch() {
    let expected = [
        (31, 31, 3.992540e-03, 6.721541e-05),
        (64, 48, 1.379769e-02, 1.342557e-04),
        (97, 70, 1.059226e-02, 1.753948e-04),
    ];
    assert_distances(Network::Alex, Range::Signed, &expected);
    let expected = [(31, 31, 1.295715e-03, 2.349210e-05), (97, 70, 8.203130e-03, 1.189130e-04)];
    assert_distances(Network::Alex, Range::Unit, &expected);
}

#[test]
fn the_distance_of_vgg_agrees_with_pytorch() {
    let expected = [(16, 16, 3.423346e-03, 6.976494e-05), (37, 22, 6.713986e-03, 1.908189e-04)];
    assert_distances(Network::Vgg, Range::Signed, &expected);
    let expected = [(16, 16, 1.460342e-03, 3.301097e-05), (37, 22, 3.067561e-03, 4.611988e-05)];
    assert_distances(Network::Vgg, Range::Unit, &expected);
}

#[test]
fn images_that_a_network_cannot_process_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lpips.safetensors");
    for (network, least, parts) in [
        (Network::Alex, 31, ["AlexNet", "31 pixels", "30x40"]),
        (Network::Vgg, 16, ["VGG-16", "16 pixels", "15x40"]),
    ] {
        write(network, &path, |_, _, _| {});
        let lpips = Lpips::load(&gpu(), &path, Range::default()).unwrap();
        let refused = |a: &Image, b: &Image, parts: &[&str]| {
            let message = lpips.distance(&gpu(), a, b).unwrap_err().to_string();
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        };
        let small = picture(least - 1, 40, 1);
        refused(&small, &small, &parts);
        refused(&small, &picture(40, least - 1, 1), &["different sizes"]);
        if network == Network::Vgg {
            // Its first layers have 64 planes of the whole image.
            let limit = gpu().properties().max_storage_buffer_range;
            let width = (limit / (64 * 4 * 1000) + 1) as u32;
            let data = vec![0.0; 3 * 1000 * width as usize];
            let large = Image { width, height: 1000, data };
            refused(&large, &large, &["VGG-16", "x1000", &limit.to_string(), "AlexNet"]);
        }
    }
}

#[test]
fn weights_of_another_network_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lpips.safetensors");
    let refused = |parts: &[&str]| {
        let message = Lpips::load(&gpu(), &path, Range::default()).unwrap_err().to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        assert!(!message.contains('\n') && message.contains("lpips.safetensors"), "{message}");
    };
    refused(&["cannot be read"]);
    fs::write(&path, "no weights").unwrap();
    refused(&["not an intact safetensors file"]);
    write(Network::Alex, &path, |name, shape, values| {
        if name == "net.slice1.0.weight" {
            *shape = vec![64, 3, 3, 3];
            values.truncate(64 * 27);
        }
    });
    let remedy = "scripts/lpips-weights.py";
    refused(&["`net.slice1.0.weight` is [64, 3, 3, 3]", "not [64, 3, 11, 11]", remedy]);
    write(Network::Vgg, &path, |name, _, values| {
        if name == "lin4.model.1.weight" {
            values[7] = f32::NAN;
        }
    });
    refused(&["`lin4.model.1.weight`", "not finite"]);
    let last = [0.0; 9];
    safetensors::write(&path, &[("net.slice5.28.weight", &[1, 1, 3, 3], &last)]);
    refused(&["has no tensor `net.slice1.0.weight`", "[64, 3, 3, 3]"]);
    // SqueezeNet starts like VGG-16.
    let first = vec![0.0; 64 * 27];
    safetensors::write(&path, &[("net.slice1.0.weight", &[64, 3, 3, 3], &first)]);
    refused(&[
        "neither `net.slice5.10.weight` of AlexNet",
        "`net.slice5.28.weight` of VGG-16",
        remedy,
    ]);
}

#[test]
fn every_measure_has_its_own_key() {
    let keys: Vec<String> = LpipsVersion::all().map(LpipsVersion::key).collect();
    assert_eq!(keys, ["lpips", "lpips_alex_unit", "lpips_vgg_signed", "lpips_vgg_unit"]);
    let titles: Vec<String> = LpipsVersion::all().map(LpipsVersion::title).collect();
    assert_eq!(titles, ["LPIPS", "LPIPS alex unit", "LPIPS vgg signed", "LPIPS vgg unit"]);
}

/// The script tests itself on planted weights, in Python only; its output is read here.
#[test]
fn the_output_of_the_converter_is_read() {
    let python = Command::new("python3").arg("--version").output();
    if !python.is_ok_and(|output| output.status.success()) {
        return not_run("python3", "it is not installed");
    }
    let folder = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/scripts/test-lpips-weights.py");
    let output = Command::new("python3").args([script, "--keep"]).arg(folder.path()).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    for network in Network::ALL {
        let path = folder.path().join(format!("lpips-{}.safetensors", network.name()));
        let lpips = Lpips::load(&gpu(), path, Range::default()).unwrap();
        assert_eq!(lpips.measure().network, network);
    }
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
