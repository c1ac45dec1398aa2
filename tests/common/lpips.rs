//! Weights of LPIPS from a formula, the same as in `scripts/lpips-reference.py`.

use std::path::Path;

use nightsplat::networks::lpips::Network;

use super::safetensors;

/// Values in [-0.5, 0.5) from a multiplicative hash (Knuth).
pub(crate) fn noise(index: usize, salt: u64) -> f64 {
    let hash = ((index as u64 + 1) * 2_654_435_761 + salt * 97_531) % (1 << 32);
    hash as f64 / 2.0_f64.powi(32) - 0.5
}

/// The position of a convolution, its output and input channels, its kernel size.
type Layer = (&'static str, usize, usize, usize);

const ALEXNET: &[Layer] = &[
    ("slice1.0", 64, 3, 11),
    ("slice2.3", 192, 64, 5),
    ("slice3.6", 384, 192, 3),
    ("slice4.8", 256, 384, 3),
    ("slice5.10", 256, 256, 3),
];

const VGG16: &[Layer] = &[
    ("slice1.0", 64, 3, 3),
    ("slice1.2", 64, 64, 3),
    ("slice2.5", 128, 64, 3),
    ("slice2.7", 128, 128, 3),
    ("slice3.10", 256, 128, 3),
    ("slice3.12", 256, 256, 3),
    ("slice3.14", 256, 256, 3),
    ("slice4.17", 512, 256, 3),
    ("slice4.19", 512, 512, 3),
    ("slice4.21", 512, 512, 3),
    ("slice5.24", 512, 512, 3),
    ("slice5.26", 512, 512, 3),
    ("slice5.28", 512, 512, 3),
];

/// The tensors of `lpips.LPIPS(net=...)` in its order.
fn tensors(network: Network) -> Vec<(String, Vec<usize>)> {
    let (layers, compared) = match network {
        Network::Alex => (ALEXNET, [64, 192, 384, 256, 256]),
        Network::Vgg => (VGG16, [64, 128, 256, 512, 512]),
    };
    let convolutions = layers.iter().flat_map(|&(layer, outputs, inputs, window)| {
        [
            (format!("net.{layer}.weight"), vec![outputs, inputs, window, window]),
            (format!("net.{layer}.bias"), vec![outputs]),
        ]
    });
    let linear =
        |(index, channels)| (format!("lin{index}.model.1.weight"), vec![1, channels, 1, 1]);
    convolutions.chain(compared.into_iter().enumerate().map(linear)).collect()
}

/// Writes weights of a network, each computed from its position, after `change`.
pub(crate) fn write(
    network: Network,
    path: &Path,
    change: impl Fn(&str, &mut Vec<usize>, &mut Vec<f32>),
) {
    let made = tensors(network).into_iter().enumerate().map(|(salt, (name, mut shape))| {
        let fan_in: usize = shape[1..].iter().product();
        let value = |at| {
            let noise = noise(at, salt as u64);
            let value = match name.rsplit('.').next() {
                _ if name.starts_with("lin") => 4.0 * (noise + 0.5) / shape[1] as f64,
                Some("weight") => 2.0 * (6.0 / fan_in as f64).sqrt() * noise,
                _ => 0.1 * noise,
            };
            value as f32
        };
        let mut values = (0..shape.iter().product()).map(value).collect();
        change(&name, &mut shape, &mut values);
        (name, shape, values)
    });
    let made: Vec<(String, Vec<usize>, Vec<f32>)> = made.collect();
    let views: Vec<(&str, &[usize], &[f32])> =
        made.iter().map(|(name, shape, values)| (name.as_str(), &shape[..], &values[..])).collect();
    safetensors::write(path, &views);
}
