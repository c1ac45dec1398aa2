//! Weights of LPIPS that are made by a formula: `scripts/lpips-reference.py` makes the same.

use std::path::Path;

use super::safetensors;

/// Numbers of [-0.5, 0.5) by a multiplicative hash (Knuth).
pub(crate) fn noise(index: usize, salt: u64) -> f64 {
    let hash = ((index as u64 + 1) * 2_654_435_761 + salt * 97_531) % (1 << 32);
    hash as f64 / 2.0_f64.powi(32) - 0.5
}

/// The tensors of `lpips.LPIPS(net='alex')` in its order.
fn tensors() -> Vec<(String, Vec<usize>)> {
    let layers = [
        (1, 0, 64, 3, 11),
        (2, 3, 192, 64, 5),
        (3, 6, 384, 192, 3),
        (4, 8, 256, 384, 3),
        (5, 10, 256, 256, 3),
    ];
    let convolutions = layers.into_iter().flat_map(|(slice, at, outputs, inputs, window)| {
        let name = format!("net.slice{slice}.{at}");
        [
            (format!("{name}.weight"), vec![outputs, inputs, window, window]),
            (format!("{name}.bias"), vec![outputs]),
        ]
    });
    let linear = |(index, layer): (usize, (i32, i32, usize, usize, usize))| {
        (format!("lin{index}.model.1.weight"), vec![1, layer.2, 1, 1])
    };
    convolutions.chain(layers.into_iter().enumerate().map(linear)).collect()
}

/// Writes weights of AlexNet, each made by a formula from its place, `change`d.
pub(crate) fn write(path: &Path, change: impl Fn(&str, &mut Vec<usize>, &mut Vec<f32>)) {
    let made = tensors().into_iter().enumerate().map(|(salt, (name, mut shape))| {
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
