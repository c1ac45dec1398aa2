use crate::gpu::Reference;
use crate::kernels::luminance_histogram::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { luminances, searches, histograms }: Slices<'_>,
    ) {
        let searches = &searches[params.first_search as usize..][..4];
        for luminance in &luminances[..params.pixel_count as usize] {
            let digits = luminance.to_bits() >> params.shift;
            let mut matching = searches.iter().filter(|search| search.prefix == digits >> 10);
            if let Some(search) = matching.next() {
                histograms[(search.histogram * 1024 + digits % 1024) as usize] += 1;
            }
        }
    }
}
