use glam::Vec3;

use super::CompensatedSum;
use crate::gpu::Reference;
use crate::kernels::RankSearch;
use crate::kernels::luminance::{Constants, Kernel, Params, Slices};
use crate::kernels::rank_search::{FIRST_SHIFT, WORKGROUP};
use crate::photographs::tone::{luminance, measurable};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { image, luminances, sums, searches, histograms } = slices;
        for (search, rank) in searches[params.first_search as usize..].iter_mut().zip(params.ranks)
        {
            *search = RankSearch { prefix: 0, rank, histogram: 0 };
        }
        let pixel_count = params.pixel_count as usize;
        let thread_count = params.thread_count as usize;
        for thread in 0..thread_count {
            let mut total = CompensatedSum::default();
            // A workgroup takes a run of pixels, a thread every 256th of them.
            let size = WORKGROUP as usize;
            let run = pixel_count.div_ceil(size).div_ceil(thread_count / size) * size;
            let (workgroup, local) = (thread / size, thread % size);
            let end = pixel_count.min((workgroup + 1) * run);
            for i in (workgroup * run + local..end).step_by(size) {
                let [r, g, b] = [0, 1, 2].map(|plane| measurable(image[plane * pixel_count + i]));
                luminances[i] = luminance([r, g, b]);
                histograms[(luminances[i].to_bits() >> FIRST_SHIFT) as usize] += 1;
                total.add(Vec3::new(r, g, b));
            }
            sums[params.first_sum as usize + thread] = total.sum;
        }
    }
}
