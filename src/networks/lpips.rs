//! LPIPS (Zhang et al. 2018, version 0.1): a perceptual distance between two images. Lower is more similar.

use std::path::Path;

use glam::UVec2;
use nightsplat_core::input;
use nightsplat_photographs::image::Image;

use crate::gpu::Gpu;
pub use crate::networks::Network;
use crate::networks::{TensorFile, Trunk, published};
use crate::{Error, Result};

/// The normalisation of the network's input: minus `SHIFT`, over `SCALE`, for each channel. It is meant for [-1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// The input range of black and white.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Range {
    /// [-1, 1], as the authors of LPIPS define it.
    #[default]
    Signed,
    /// [0, 1], as in the code of 3DGS.
    Unit,
}

impl Range {
    /// All ranges.
    pub const ALL: [Self; 2] = [Self::Signed, Self::Unit];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Signed => "signed",
            Self::Unit => "unit",
        }
    }

    fn of_unit(self, value: f32) -> f32 {
        match self {
            Self::Signed => 2.0 * value - 1.0,
            Self::Unit => value,
        }
    }
}

/// A version of LPIPS: values of different versions are not comparable.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LpipsVersion {
    /// The network.
    pub network: Network,
    /// The input range.
    pub range: Range,
}

impl LpipsVersion {
    /// All versions.
    pub fn all() -> impl Iterator<Item = Self> {
        let of = |network| Range::ALL.map(|range| Self { network, range });
        Network::ALL.into_iter().flat_map(of)
    }

    /// The key of its values in JSON: `lpips` for the default, else with network and range, as `lpips_vgg_unit`.
    pub fn key(self) -> String {
        if self == Self::default() {
            return "lpips".to_owned();
        }
        format!("lpips_{}_{}", self.network.name(), self.range.name())
    }

    /// The head of its column in tables.
    pub fn title(self) -> String {
        if self == Self::default() {
            return "LPIPS".to_owned();
        }
        format!("LPIPS {} {}", self.network.name(), self.range.name())
    }
}

/// LPIPS on the device.
#[derive(Debug)]
pub struct Lpips {
    trunk: Trunk,
    range: Range,
    /// The weight of each channel of each compared layer.
    weights: Vec<Vec<f32>>,
}

impl Lpips {
    /// Loads the weights of a safetensors file: the tensors of `lpips.LPIPS(net='alex')` or `(net='vgg')` under its
    /// names. They determine the network.
    pub fn load(gpu: &Gpu, path: impl AsRef<Path>, range: Range) -> Result<Self> {
        let path = path.as_ref();
        let bytes = input::bytes(path)?;
        let file = TensorFile::parse(&bytes).map_err(|error| {
            Error::input(path, format!("is not an intact safetensors file ({error})"))
        })?;
        let network = Network::detect(path, &file)?;
        let trunk = Trunk::new(gpu, path, &file, network)?;
        let weights = network.compared_channels().enumerate().map(|(index, channels)| {
            published(path, &file, &format!("lin{index}.model.1.weight"), &[1, channels, 1, 1])
        });
        Ok(Self { trunk, range, weights: weights.collect::<Result<_>>()? })
    }

    /// The version of its distances.
    pub fn measure(&self) -> LpipsVersion {
        LpipsVersion { network: self.trunk.network, range: self.range }
    }

    /// The distance between two images of one size, sRGB in [0, 1]; 0 for equal ones.
    pub fn distance(&self, gpu: &Gpu, render: &Image, reference: &Image) -> Result<f64> {
        let size = |image: &Image| UVec2::new(image.width, image.height);
        if size(render) != size(reference) {
            let problem = "two images of different sizes cannot be compared";
            return Err(Error::Usage(problem.to_owned()));
        }
        self.trunk.check(gpu, size(render))?;
        let seen =
            |image: &Image| self.trunk.activations(gpu, size(image), &self.network_input(image));
        let (a, b) = (seen(render)?, seen(reference)?);
        let layers = a.iter().zip(&b).zip(&self.weights);
        Ok(layers.map(|((a, b), weights)| layer_distance(a, b, weights)).sum())
    }

    fn network_input(&self, image: &Image) -> Vec<f32> {
        let pixels = image.pixel_count();
        let value = |(at, &value): (usize, &f32)| {
            let channel = at / pixels;
            (self.range.of_unit(value) - SHIFT[channel]) / SCALE[channel]
        };
        image.data.iter().enumerate().map(value).collect()
    }
}

/// The mean over the pixels of the weighted squared differences of the unit vectors across the channels.
fn layer_distance(a: &[f32], b: &[f32], weights: &[f32]) -> f64 {
    /// As in the published measure: zero vectors map to zero.
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
