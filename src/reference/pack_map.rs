//! Feature maps, packed.

use glam::UVec2;

use super::packed::{channels, eight, extent, scale};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_map::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { largest, source, packed }: Slices<'_>) {
        let Params { size, channels: count } = *params;
        let (extent, padded, scale) = (extent(size), channels(count), scale(largest[0]));
        let value = |x: u32, y: u32, channel: u32| {
            let at = UVec2::new(x, y).wrapping_sub(UVec2::ONE);
            if at.x >= size.x || at.y >= size.y || channel >= count {
                return 0.0;
            }
            scale * f64::from(source[((channel * size.y + at.y) * size.x + at.x) as usize])
        };
        for i in 0..extent.element_product() * padded / 8 {
            let (first, pixel) = (8 * i % padded, 8 * i / padded);
            let of = |channel| value(pixel % extent.x, pixel / extent.x, first + channel);
            packed[i as usize] = eight(of);
        }
    }

    /// The next half above or below.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { packed: Tolerance::Halves }
    }
}
