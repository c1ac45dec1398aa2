//! The memory of the denoiser: the maps of one stage, or of every stage if memory allows, and gradients.

use glam::UVec2;

use super::super::conv::{Precision, partial_count};
use super::super::half::PackedMap;
use super::super::norm::NormMemory;
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
    let per_pixel = 2 * settings.channels() + images * RGB as usize;
    let beside = float_bytes(extent.pixels * per_pixel + extent.partials + 4 * extent.packed);
    beside + Activations::bytes(settings, extent)
}

/// State of a stage between its forward and its backward pass.
#[derive(Debug)]
pub(super) struct Activations {
    /// f of every repeat, each (C, H, W); if f is packed, that of the first, and two buffers that alternate for the
    /// later ones.
    features: Vec<Buffer<f32>>,
    /// conv(f) of every repeat, repeats x (C, H, W).
    pub(super) convolved: Vec<Buffer<f32>>,
    /// f of every repeat but the last, packed.
    pub(super) packed: Vec<PackedMap>,
    pub(super) norm: NormMemory,
    /// u, (3, H, W).
    pub(super) update: Buffer<f32>,
}

/// The number of maps of f: repeats + 1, or three if the backward pass reads the packed form of those between the first
/// and the last.
fn feature_maps(settings: DenoiserSettings) -> usize {
    let all = settings.repeats as usize + 1;
    match settings.precision {
        Precision::Single => all,
        Precision::Half => all.min(3),
    }
}

impl Activations {
    /// f of a repeat; if f is packed, only of the first or of the two written last.
    pub(super) fn features(&self, repeat: usize) -> &Buffer<f32> {
        &self.features[self.slot(repeat)]
    }

    /// f of the first repeat, to be written.
    pub(super) fn first_features(&mut self) -> &mut Buffer<f32> {
        &mut self.features[0]
    }

    /// f of the last repeat, and u to be written.
    pub(super) fn ends(&mut self, repeats: usize) -> (&Buffer<f32>, &mut Buffer<f32>) {
        let slot = self.slot(repeats);
        (&self.features[slot], &mut self.update)
    }

    /// The input of a repeat, and all its outputs.
    pub(super) fn repeat(&mut self, repeat: usize) -> Repeat<'_> {
        let [from, to] = [repeat, repeat + 1].map(|repeat| self.slot(repeat));
        let (before, after) = self.features.split_at_mut(from.max(to));
        let (shortcut, target) = match from < to {
            true => (&before[from], &mut after[0]),
            false => (&after[0], &mut before[to]),
        };
        let (convolved, packed) = (&mut self.convolved[repeat], &mut self.packed[repeat]);
        Repeat { shortcut, packed, convolved, norm: &mut self.norm, target }
    }

    fn slot(&self, repeat: usize) -> usize {
        if repeat == 0 { 0 } else { 1 + (repeat - 1) % (self.features.len() - 1) }
    }

    fn new(gpu: &Gpu, settings: DenoiserSettings, extent: Extent) -> Result<Self> {
        let Extent { pixels, packed, .. } = extent;
        let repeats = settings.repeats as usize;
        let map = |name| gpu.uninit(name, settings.channels() * pixels);
        Ok(Self {
            features: (0..feature_maps(settings))
                .map(|_| map("features"))
                .collect::<Result<_>>()?,
            convolved: (0..repeats).map(|_| map("convolved")).collect::<Result<_>>()?,
            packed: (0..repeats).map(|_| PackedMap::new(gpu, packed)).collect::<Result<_>>()?,
            norm: NormMemory::new(gpu, pixels, settings.channels(), repeats)?,
            update: gpu.uninit("update", RGB as usize * pixels)?,
        })
    }

    fn bytes(settings: DenoiserSettings, extent: Extent) -> u64 {
        let (Extent { pixels, packed, .. }, repeats) = (extent, settings.repeats as usize);
        let maps = feature_maps(settings) + repeats;
        let per_pixel = maps * settings.channels() + RGB as usize;
        let norm = NormMemory::floats(pixels, settings.channels(), repeats);
        float_bytes(pixels * per_pixel + norm + 4 * repeats * packed)
    }
}

/// The maps of one repeat.
#[derive(Debug)]
pub(super) struct Repeat<'a> {
    /// f
    pub(super) shortcut: &'a Buffer<f32>,
    /// f, packed.
    pub(super) packed: &'a mut PackedMap,
    /// conv(f)
    pub(super) convolved: &'a mut Buffer<f32>,
    pub(super) norm: &'a mut NormMemory,
    /// f of the next.
    pub(super) target: &'a mut Buffer<f32>,
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
    pub(super) d_features: Buffer<f32>,
    pub(super) d_convolved: Buffer<f32>,
    /// dL/d conv(f), packed.
    pub(super) d_packed: PackedMap,
    pub(super) d_update: Buffer<f32>,
    /// `dL/dR_k`, alternating, each (3, H, W).
    pub(super) d_denoised: [Buffer<f32>; 2],
    pub(super) partials: Buffer<f32>,
}

impl DenoiserMemory {
    pub(super) fn new(gpu: &Gpu, settings: DenoiserSettings, extent: Extent) -> Result<Self> {
        let Extent { pixels, partials, packed } = extent;
        let map = |name| gpu.uninit(name, settings.channels() * pixels);
        let image = |name| gpu.uninit(name, RGB as usize * pixels);
        Ok(Self {
            activations: Activations::new(gpu, settings, extent)?,
            denoised: (0..settings.stages).map(|_| image("denoised")).collect::<Result<_>>()?,
            d_features: map("d_features")?,
            d_convolved: map("d_convolved")?,
            d_packed: PackedMap::new(gpu, packed)?,
            d_update: image("d_update")?,
            d_denoised: [image("d_denoised")?, image("d_denoised")?],
            partials: gpu.uninit("partials", partials)?,
        })
    }
}
