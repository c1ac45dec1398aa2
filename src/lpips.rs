//! LPIPS (Zhang et al. 2018, version 0.1): how far two pictures are apart to AlexNet. Lower is more alike.

use std::path::Path;

use glam::UVec2;

use crate::gpu::Gpu;
use crate::image::Image;
use crate::input;
use crate::nn::{AlexNet, LAYERS, TensorFile, published};
use crate::{Error, Result};

/// What makes a picture of [-1, 1] the network's input: minus `SHIFT`, over `SCALE`, for each channel.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// The measure, on the device.
#[derive(Debug)]
pub struct Lpips {
    network: AlexNet,
    /// How much each channel of each layer counts.
    weights: [Vec<f32>; LAYERS],
}

impl Lpips {
    /// The measure with the weights of a safetensors file: the tensors of `lpips.LPIPS(net='alex')` under its names.
    ///
    /// # Errors
    /// [`Error::Input`] names what is missing, of another shape or not finite; the device is out of memory.
    pub fn load(gpu: &Gpu, path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = input::bytes(path)?;
        let file = TensorFile::of(&bytes).map_err(|error| {
            Error::input(path, format!("is no whole safetensors file ({error})"))
        })?;
        let network = AlexNet::new(gpu, path, &file)?;
        let mut weights = std::array::from_fn(|_| vec![]);
        for (index, weights) in weights.iter_mut().enumerate() {
            let (name, channels) = (format!("lin{index}.model.1.weight"), AlexNet::channels(index));
            *weights = published(path, &file, &name, &[1, channels, 1, 1])?;
        }
        Ok(Self { network, weights })
    }

    /// The distance of two pictures of one size, sRGB in [0, 1]; 0 for equal ones.
    ///
    /// # Errors
    /// [`Error::Usage`] where the sizes differ or are too small; the device is out of memory or lost.
    pub fn distance(&self, gpu: &Gpu, render: &Image, reference: &Image) -> Result<f64> {
        let size = |image: &Image| UVec2::new(image.width, image.height);
        if size(render) != size(reference) {
            let problem = "two pictures of different sizes cannot be compared";
            return Err(Error::Usage(problem.to_owned()));
        }
        let seen =
            |image: &Image| self.network.activations(gpu, size(image), &network_input(image));
        let (a, b) = (seen(render)?, seen(reference)?);
        let layers = a.iter().zip(&b).zip(&self.weights);
        Ok(layers.map(|((a, b), weights)| layer_distance(a, b, weights)).sum())
    }
}

fn network_input(image: &Image) -> Vec<f32> {
    let pixels = image.pixel_count();
    let value = |(at, value): (usize, &f32)| {
        let channel = at / pixels;
        (2.0 * value - 1.0 - SHIFT[channel]) / SCALE[channel]
    };
    image.data.iter().enumerate().map(value).collect()
}

/// The mean over the pixels of the weighted squared differences of the unit vectors across the channels.
fn layer_distance(a: &[f32], b: &[f32], weights: &[f32]) -> f64 {
    /// The published measure's, which keeps zero vectors zero.
    const EPSILON: f64 = 1e-10;
    let pixels = a.len() / weights.len();
    let lengths = |values: &[f32]| -> Vec<f64> {
        let mut squares = vec![0.0; pixels];
        for plane in values.chunks_exact(pixels) {
            squares.iter_mut().zip(plane).for_each(|(sum, &v)| *sum += f64::from(v).powi(2));
        }
        squares.into_iter().map(|square| square.sqrt() + EPSILON).collect()
    };
    let (length_a, length_b) = (lengths(a), lengths(b));
    let mut sum = 0.0;
    for ((a, b), &weight) in a.chunks_exact(pixels).zip(b.chunks_exact(pixels)).zip(weights) {
        let differences = (0..pixels)
            .map(|i| (f64::from(a[i]) / length_a[i] - f64::from(b[i]) / length_b[i]).powi(2));
        sum += f64::from(weight) * differences.sum::<f64>();
    }
    sum / pixels as f64
}
