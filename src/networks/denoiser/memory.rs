//! The memory of the denoiser: the maps of one stage, or of every stage if memory allows, and gradients.

use glam::UVec2;

use super::super::conv::{Precision, partial_count};
use super::super::half::PackedMap;
use super::super::norm::{CHUNK, NormMemory};
use super::super::norm_half::HALF_CHUNK;
use super::super::reserved::Extent;
use super::super::{RGB, check_binding, float_bytes};
use super::DenoiserSettings;
use crate::Result;
use crate::gpu::{Buffer, Gpu};

/// The extent of a view.
pub(super) fn extent(settings: DenoiserSettings, size: UVec2) -> Extent {
    let DenoiserSettings { channels, precision, .. } = settings;
    let ends = [[RGB, channels], [channels, RGB]];
    let ends = ends.map(|layer| partial_count(size, layer, Precision::Single));
    let inner = partial_count(size, [channels; 2], precision);
    Extent {
        pixels: size.x as usize * size.y as usize,
        partials: inner.max(ends[0]).max(ends[1]),
        packed: match precision {
            Precision::Single => 0,
            Precision::Half => PackedMap::packed_count(size, channels),
        },
    }
}

/// Checks that the device can bind every buffer of a view.
pub(super) fn check(gpu: &Gpu, settings: DenoiserSettings, size: UVec2) -> Result<()> {
    let (channels, Extent { pixels, partials, packed }) =
        (settings.channels, extent(settings, size));
    let map = (settings.channels().max(RGB as usize) * pixels).max(4 * packed);
    check_binding(gpu, &format!("the denoiser's {channels} feature maps"), size, map)?;
    let sums = format!("the sums of the gradients of the denoiser's {channels} channels");
    check_binding(gpu, &sums, size, partials)
}

/// The bytes that [`DenoiserMemory::new`] allocates.
pub(super) fn bytes(settings: DenoiserSettings, extent: Extent) -> u64 {
    let images = settings.stages as usize + 3;
    let gradients = MapCounts::gradients(settings);
    let beside = extent.pixels * images * RGB as usize + extent.partials;
    float_bytes(beside + gradients.floats(settings, extent)) + Activations::bytes(settings, extent)
}

/// The number of maps: in single precision (C, H, W), and packed.
#[derive(Clone, Copy, Debug)]
struct MapCounts {
    features: usize,
    convolved: usize,
    packed: usize,
    packed_convolved: usize,
}

impl MapCounts {
    /// Those between the forward and the backward pass of a stage. If they are packed, the first f and the last are in
    /// single precision too.
    fn activations(settings: DenoiserSettings) -> Self {
        let repeats = settings.repeats as usize;
        match settings.precision {
            Precision::Single => {
                Self { features: repeats + 1, convolved: repeats, packed: 0, packed_convolved: 0 }
            }
            Precision::Half => {
                Self { features: 2, convolved: 0, packed: repeats + 1, packed_convolved: repeats }
            }
        }
    }

    /// Those that the backward pass overwrites.
    fn gradients(settings: DenoiserSettings) -> Self {
        match settings.precision {
            Precision::Single => Self { features: 1, convolved: 1, packed: 0, packed_convolved: 0 },
            Precision::Half => Self { features: 1, convolved: 0, packed: 2, packed_convolved: 1 },
        }
    }

    fn floats(self, settings: DenoiserSettings, Extent { pixels, packed, .. }: Extent) -> usize {
        (self.features + self.convolved) * settings.channels() * pixels
            + 4 * (self.packed + self.packed_convolved) * packed
    }
}

/// State of a stage between its forward and its backward pass.
#[derive(Debug)]
pub(super) struct Activations {
    /// f of every repeat and the last, each (C, H, W); if f is packed, the first and the last.
    pub(super) features: Vec<Buffer<f32>>,
    /// conv(f) of every repeat, each (C, H, W).
    pub(super) convolved: Vec<Buffer<f32>>,
    /// f of every repeat and the last, packed.
    pub(super) packed: Vec<PackedMap>,
    /// conv(f) of every repeat, packed.
    pub(super) packed_convolved: Vec<PackedMap>,
    pub(super) norm: NormMemory,
    /// u, (3, H, W).
    pub(super) update: Buffer<f32>,
}

/// The values of a channel that a subgroup of the norm processes.
fn chunk(settings: DenoiserSettings) -> u32 {
    match settings.precision {
        Precision::Single => CHUNK,
        Precision::Half => HALF_CHUNK,
    }
}

impl Activations {
    fn new(gpu: &Gpu, settings: DenoiserSettings, extent: Extent) -> Result<Self> {
        let Extent { pixels, packed, .. } = extent;
        let (channels, repeats) = (settings.channels(), settings.repeats as usize);
        let of = MapCounts::activations(settings);
        let map = |name, count| {
            (0..count).map(|_| gpu.uninit(name, channels * pixels)).collect::<Result<_>>()
        };
        let packed = |count| (0..count).map(|_| PackedMap::new(gpu, packed)).collect::<Result<_>>();
        Ok(Self {
            features: map("features", of.features)?,
            convolved: map("convolved", of.convolved)?,
            packed: packed(of.packed)?,
            packed_convolved: packed(of.packed_convolved)?,
            norm: NormMemory::new(gpu, pixels, channels, repeats, chunk(settings))?,
            update: gpu.uninit("update", RGB as usize * pixels)?,
        })
    }

    fn bytes(settings: DenoiserSettings, extent: Extent) -> u64 {
        let (pixels, repeats) = (extent.pixels, settings.repeats as usize);
        let norm = NormMemory::floats(pixels, settings.channels(), repeats, chunk(settings));
        let maps = MapCounts::activations(settings).floats(settings, extent);
        float_bytes(maps + norm + pixels * RGB as usize)
    }
}

/// The gradients of a stage's maps, which its backward pass overwrites.
#[derive(Debug)]
pub(super) struct StageGradients {
    /// dL/df, (C, H, W).
    pub(super) features: Buffer<f32>,
    /// dL/d conv(f), (C, H, W).
    pub(super) convolved: Buffer<f32>,
    /// dL/df of a repeat and of the one after it, alternating, and dL/d conv(f), packed.
    pub(super) packed: [PackedMap; 3],
}

impl StageGradients {
    fn new(
        gpu: &Gpu,
        settings: DenoiserSettings,
        Extent { pixels, packed, .. }: Extent,
    ) -> Result<Self> {
        let map = |count| gpu.uninit("gradients", count * settings.channels() * pixels);
        let packed = || PackedMap::new(gpu, packed);
        Ok(Self {
            features: map(1)?,
            convolved: map(MapCounts::gradients(settings).convolved)?,
            packed: [packed()?, packed()?, packed()?],
        })
    }
}

/// The activations of the stages before the last, as many as are kept.
#[derive(Debug, Default)]
pub(super) struct EarlierStages {
    /// The extent that they are allocated for.
    extent: Extent,
    stages: Vec<Activations>,
}

impl EarlierStages {
    pub(super) fn new(gpu: &Gpu, settings: DenoiserSettings, extent: Extent) -> Result<Self> {
        let stages = (1..settings.stages).map(|_| Activations::new(gpu, settings, extent));
        Ok(Self { extent, stages: stages.collect::<Result<_>>()? })
    }

    pub(super) fn bytes(settings: DenoiserSettings, extent: Extent) -> u64 {
        let each = Activations::bytes(settings, extent);
        u64::from(settings.stages - 1).saturating_mul(each)
    }

    /// The extent that they are allocated for.
    pub(super) fn extent(&self) -> Extent {
        self.extent
    }

    /// The activations of stage `k` in a view of this extent: its own if they are kept, else the shared ones.
    pub(super) fn activations<'a>(
        &'a mut self,
        k: usize,
        extent: Extent,
        shared: &'a mut Activations,
    ) -> &'a mut Activations {
        let kept = if extent.fits(self.extent) { self.stages.get_mut(k) } else { None };
        kept.unwrap_or(shared)
    }
}

/// The memory of one view.
#[derive(Debug)]
pub(super) struct DenoiserMemory {
    /// Of the last stage, and of earlier ones without their own activations.
    pub(super) activations: Activations,
    /// `R_1` to `R_K`, each (3, H, W).
    pub(super) denoised: Vec<Buffer<f32>>,
    pub(super) gradients: StageGradients,
    pub(super) d_update: Buffer<f32>,
    /// `dL/dR_k`, alternating, each (3, H, W).
    pub(super) d_denoised: [Buffer<f32>; 2],
    pub(super) partials: Buffer<f32>,
}

impl DenoiserMemory {
    pub(super) fn new(gpu: &Gpu, settings: DenoiserSettings, extent: Extent) -> Result<Self> {
        let Extent { pixels, partials, .. } = extent;
        let image = |name| gpu.uninit(name, RGB as usize * pixels);
        Ok(Self {
            activations: Activations::new(gpu, settings, extent)?,
            denoised: (0..settings.stages).map(|_| image("denoised")).collect::<Result<_>>()?,
            gradients: StageGradients::new(gpu, settings, extent)?,
            d_update: image("d_update")?,
            d_denoised: [image("d_denoised")?, image("d_denoised")?],
            partials: gpu.uninit("partials", partials)?,
        })
    }
}
