//! A curve on the device, one photograph at a time, in tiles where a photograph exceeds what the device binds.

use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::image::Image;
use crate::kernels::ToneParameters;
use crate::pseudo_gt::PseudoGt;
use crate::tone::{Statistics, ToneSettings};

/// Measures and maps photographs.
pub(in crate::cli) struct Mapper {
    gpu: Gpu,
    pseudo_gt: PseudoGt,
    parameters: Buffer<ToneParameters>,
    /// The curve of all photographs, where they share one.
    scene: Option<ToneParameters>,
    tile_pixels: usize,
}

impl Mapper {
    pub(in crate::cli) fn new(gpu: &Gpu, settings: &ToneSettings) -> Result<Self> {
        let bytes_per_pixel = 3 * size_of::<f32>() as u64;
        Ok(Self {
            gpu: gpu.clone(),
            pseudo_gt: PseudoGt::new(gpu, settings)?,
            parameters: gpu.uninit("tone parameters", 1)?,
            scene: None,
            tile_pixels: (gpu.properties().max_storage_buffer_range / bytes_per_pixel) as usize,
        })
    }

    /// From now on every photograph gets the curve of these statistics.
    pub(in crate::cli) fn set_scene(&mut self, statistics: &Statistics) {
        self.scene = Some(self.pseudo_gt.settings().parameters(statistics));
    }

    /// The statistics of planes (3, pixels); what is mapped next gets the curve they give.
    pub(in crate::cli) fn statistics(&mut self, planes: &[f32]) -> Result<Statistics> {
        let tiles = self.tiles(planes)?;
        let tiles: Vec<&Buffer<f32>> = tiles.iter().collect();
        self.gpu.run("tone statistics", |pass| self.pseudo_gt.statistics_of_tiles(pass, &tiles))?;
        let measured = self.pseudo_gt.measured()?;
        let own = || self.pseudo_gt.settings().parameters(&measured);
        self.gpu.write(&mut self.parameters, &[self.scene.unwrap_or_else(own)])?;
        Ok(measured)
    }

    /// The photograph under the curve that the last statistics gave.
    pub(in crate::cli) fn map(&self, photograph: &Image) -> Result<Image> {
        let pixels = photograph.pixel_count();
        let mut mapped = photograph.clone();
        let mut first = 0;
        for tile in self.tiles(&photograph.data)? {
            let mut target = self.gpu.uninit("pseudo-GT", tile.len())?;
            self.gpu.run("tone", |pass| {
                self.pseudo_gt.map(pass, &tile, &self.parameters, 0, &mut target)
            })?;
            let count = tile.len() / 3;
            for (plane, values) in self.gpu.read(&target)?.chunks_exact(count).enumerate() {
                mapped.data[plane * pixels + first..][..count].copy_from_slice(values);
            }
            first += count;
        }
        Ok(mapped)
    }

    /// Runs of pixels, each planar (3, count), that the device can bind.
    fn tiles(&self, planes: &[f32]) -> Result<Vec<Buffer<f32>>> {
        let pixels = planes.len() / 3;
        if pixels <= self.tile_pixels {
            return Ok(vec![self.gpu.buffer("photograph", planes)?]);
        }
        let tile = |first: usize| {
            let count = self.tile_pixels.min(pixels - first);
            let plane = |plane: usize| &planes[plane * pixels + first..][..count];
            self.gpu.buffer("photograph", &[plane(0), plane(1), plane(2)].concat())
        };
        (0..pixels).step_by(self.tile_pixels).map(tile).collect()
    }
}
