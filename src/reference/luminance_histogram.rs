use crate::gpu::Reference;
use crate::kernels::luminance_histogram::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { luminances, searches, histograms }: Slices<'_>,
    ) {
        for luminance in &luminances[..params.pixel_count as usize] {
            let bits = luminance.to_bits();
            let prefix = bits >> params.shift >> 8;
            let digit = bits >> params.shift & 255;
            if let Some(search) = searches.iter().find(|search| search.prefix == prefix) {
                histograms[(search.histogram * 256 + digit) as usize] += 1;
            }
        }
    }
}
