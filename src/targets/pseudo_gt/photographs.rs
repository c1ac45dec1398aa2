//! Tone-maps photographs on the host, one at a time, in tiles if one exceeds what the device binds.

use nightsplat_photographs::image::Image;

use super::PseudoGt;
use crate::Result;
use crate::gpu::{Buffer, Download};
use crate::kernels::ToneParameters;

impl PseudoGt {
    /// The target of a photograph, at its own size.
    pub fn tone_mapped(&self, photograph: &Image, curve: &ToneParameters) -> Result<Image> {
        let parameters = self.gpu.buffer("tone parameters", &[*curve])?;
        let Image { width, height, .. } = *photograph;
        let pixels = photograph.pixel_count();
        let (mut data, mut first) = (vec![0.0; photograph.data.len()], 0);
        while first < pixels {
            let tile = self.tile(&photograph.data, first)?;
            let mut mapped = self.gpu.uninit("pseudo-GT", tile.len())?;
            let mut download = None;
            self.gpu.run("pseudo-GT", |pass| {
                self.map(pass, &tile, &parameters, 0, &mut mapped)?;
                download = Some(pass.download(&mapped)?);
                Ok(())
            })?;
            let mapped = download.map_or_else(|| Ok(vec![]), Download::wait)?;
            let count = tile.len() / 3;
            for (plane, values) in mapped.chunks_exact(count.max(1)).enumerate() {
                data[plane * pixels + first..][..count].copy_from_slice(values);
            }
            first += count;
        }
        Ok(Image { width, height, data })
    }

    /// The run of pixels from `first`, planar (3, count), as long as the device can bind.
    fn tile(&self, planes: &[f32], first: usize) -> Result<Buffer<f32>> {
        /// Small tiles reuse one another's memory.
        const MOST: usize = 1 << 20;
        let pixels = planes.len() / 3;
        let bytes_per_pixel = 3 * size_of::<f32>() as u64;
        let bindable = (self.gpu.properties().max_storage_buffer_range / bytes_per_pixel) as usize;
        let count = bindable.min(MOST).min(pixels - first);
        let planes = [0, 1, 2].map(|plane| &planes[plane * pixels + first..][..count]);
        self.gpu.buffer("photograph", &planes.concat())
    }
}
