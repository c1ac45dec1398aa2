//! CPU references: one file per kernel, same name, same buffers, plain loops.
//!
//! They are written to be read beside the shader, line by line, and to be obviously right rather than fast; the tests
//! hold each kernel to its reference. What decides where a splat lies is f32, as in the shader; what makes light and
//! gradients is f64.

#![expect(clippy::needless_range_loop, reason = "keeps each line comparable to the shader")]

mod adam;
pub mod blend_backward;
pub mod blend_forward;
pub mod camera;
mod check_capacity;
mod compensated_sum;
pub mod curves;
mod densify_count;
mod densify_scatter;
mod dispatch_arguments;
mod emit;
pub mod gaussian;
mod l1;
mod loss_log;
pub(crate) mod luminance;
mod luminance_histogram;
mod order_counts;
mod percentile_select;
pub mod project;
pub mod project_backward;
pub mod real;
mod reduce_records;
mod scan_downsweep;
mod scan_spine;
mod scan_upsweep;
pub mod sh;
mod sort_downsweep;
mod sort_spine;
mod sort_upsweep;
pub mod splat;
pub mod ssim_backward;
pub mod ssim_forward;
mod tile_ranges;
pub mod tone;
mod tone_map;
mod tone_mix;
mod tone_statistics;
pub(crate) mod tone_table;

use compensated_sum::CompensatedSum;
