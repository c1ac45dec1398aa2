use crate::gpu::Reference;
use crate::kernels::luminance_histogram::{Constants, Kernel, Params, Slices};
use crate::kernels::rank_search::{BINS, DIGIT_BITS, SEARCHES};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { luminances, searches, histograms }: Slices<'_>,
    ) {
        let searches = &searches[params.first_search as usize..][..SEARCHES as usize];
        for luminance in &luminances[..params.pixel_count as usize] {
            let digits = luminance.to_bits() >> params.shift;
            let mut matching =
                searches.iter().filter(|search| search.prefix == digits >> DIGIT_BITS);
            if let Some(search) = matching.next() {
                histograms[(search.histogram * BINS + digits % BINS) as usize] += 1;
            }
        }
    }
}
