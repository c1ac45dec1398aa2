//! Tone-maps photographs on the host, one at a time, in tiles if one exceeds what the device binds.

use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::ToneMapping;

use super::PseudoGt;
use crate::Result;
use crate::gpu::{Buffer, Download};

impl PseudoGt {
    /// The target of a photograph, at its own size.
    pub fn tone_mapped(&self, photograph: &Image, tone_mapping: &ToneMapping) -> Result<Image> {
        let parameters = self.gpu.buffer("tone parameters", &[tone_mapping.parameters])?;
        let Image { width, height, .. } = *photograph;
        let pixels = photograph.pixel_count();
        let (mut data, mut first) = (vec![0.0; photograph.data.len()], 0);
        for tile in self.tiles(&photograph.data)? {
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

    /// Runs of pixels, each planar (3, count), that the device can bind.
    fn tiles(&self, planes: &[f32]) -> Result<Vec<Buffer<f32>>> {
        let pixels = planes.len() / 3;
        let bytes_per_pixel = 3 * size_of::<f32>() as u64;
        let most = (self.gpu.properties().max_storage_buffer_range / bytes_per_pixel) as usize;
        if pixels <= most {
            return Ok(vec![self.gpu.buffer("photograph", planes)?]);
        }
        let tile = |first: usize| {
            let count = most.min(pixels - first);
            let plane = |plane: usize| &planes[plane * pixels + first..][..count];
            self.gpu.buffer("photograph", &[plane(0), plane(1), plane(2)].concat())
        };
        (0..pixels).step_by(most).map(tile).collect()
    }
}
