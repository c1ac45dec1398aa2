//! CPU references: one file per kernel, same name, same buffers, plain loops.
//!
//! They are written to be read beside the shader, line by line, and to be obviously right rather than fast; the tests
//! hold each kernel to its reference.

#![expect(
    clippy::needless_range_loop,
    clippy::neg_cmp_op_on_partial_ord,
    reason = "keeps each line comparable to the shader; a NaN must fail the test"
)]

mod adam;
mod compensated_sum;
mod densify_count;
mod densify_scatter;
mod dispatch_arguments;
mod l1;
mod loss_log;
pub(crate) mod luminance;
mod luminance_histogram;
mod percentile_select;
mod scan_downsweep;
mod scan_spine;
mod scan_upsweep;
mod sort_downsweep;
mod sort_spine;
mod sort_upsweep;
pub mod ssim_backward;
pub mod ssim_forward;
mod tile_ranges;
pub mod tone;
mod tone_map;
mod tone_statistics;

use compensated_sum::CompensatedSum;
