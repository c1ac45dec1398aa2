use crate::gpu::Reference;
use crate::kernels::RankSearch;
use crate::kernels::percentile_select::{Constants, Kernel, Params, Slices};
use crate::kernels::rank_search::{BINS, SEARCHES};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { searches, histograms }: Slices<'_>) {
        let searches = &mut searches[params.first_search as usize..][..SEARCHES as usize];
        for search in searches.iter_mut() {
            let first = search.histogram * BINS;
            let mut digit = 0;
            while digit < (1 << params.digit_bits) - 1
                && search.rank >= histograms[(first + digit) as usize]
            {
                search.rank -= histograms[(first + digit) as usize];
                digit += 1;
            }
            search.prefix = search.prefix << params.digit_bits | digit;
        }
        for thread in 0..searches.len() {
            let RankSearch { prefix, .. } = searches[thread];
            let first = searches.iter().position(|search| search.prefix == prefix);
            searches[thread].histogram = first.unwrap_or(thread) as u32;
        }
        histograms[..4096].fill(0);
    }
}
