//! CPU references: one file per kernel, same name, same buffers, plain loops.
//!
//! They are written to be read next to the shader, line by line, and to be obviously correct rather than fast; tests
//! compare each kernel with its reference. Coverage of pixels by splats is computed in f32, as in the shader; alphas,
//! colours and gradients are computed in f64.

#![expect(clippy::needless_range_loop, reason = "keeps each line comparable to the shader")]

mod adam;
mod adam_gaussian;
pub mod blend_backward;
pub mod blend_forward;
mod blending;
pub mod camera;
mod ceiling;
mod ciconv_columns;
mod ciconv_moments;
mod ciconv_normalize;
mod ciconv_rows;
pub mod conv3x3;
mod conv3x3_half;
pub mod conv3x3_weight_gradient;
mod conv3x3_weight_gradient_half;
mod conv_strided;
mod crop_gather;
mod crop_scatter;
mod denoising;
mod densify_decide;
mod densify_moments;
pub mod densify_scatter;
mod densify_score;
mod depth_boxes;
pub mod depth_correlation;
mod depth_gradient;
mod depth_limits;
mod depth_moments;
mod emit;
pub mod expose;
mod expose_backward;
pub mod exposure_center;
mod exposure_gradient;
mod first_not_finite;
pub mod gaussian;
mod l1;
pub mod lamp;
mod lamp_backward;
mod lamp_gradient;
mod largest_magnitude;
mod loss_log;
mod mask_gradient;
mod mask_render;
mod max_pool;
mod motion_vectors;
pub mod norm;
mod norm_backward;
mod norm_backward_half;
mod norm_backward_merge;
mod norm_backward_sums;
mod norm_backward_sums_half;
mod norm_forward;
mod norm_forward_half;
mod norm_merge;
mod norm_statistics;
mod norm_statistics_half;
pub mod normals;
mod normals_backward;
mod order_counts;
mod pack_map;
pub mod pack_pixels;
mod pack_weights;
mod packed;
pub mod parameter_terms;
mod photograph_light;
mod pick_splats;
mod place_pairs;
mod product;
mod product_backward;
pub mod project;
pub mod project_backward;
mod pseudo_gt;
mod random;
mod reduce_strips;
mod relu_backward;
pub mod residual;
pub mod residual_backward;
pub mod rotation;
pub mod rounding;
mod scan_downsweep;
mod scan_upsweep;
mod self_test;
pub mod sh;
mod smoothing_floor;
mod sort_downsweep;
mod sort_tiles;
mod sort_upsweep;
pub mod splat;
pub mod ssim;
mod ssim_backward;
mod ssim_forward;
mod structure_l1;
mod tile_begins;
mod unpack_map;

use glam::UVec2;

/// Whether index `i` of planes of `width` x `height` is in the columns and rows from `begin` to before `end`.
fn inside(i: usize, [width, height]: [u32; 2], [begin, end]: [UVec2; 2]) -> bool {
    let row = i as u32 / width;
    let pixel = UVec2::new(i as u32 % width, row % height);
    pixel.cmpge(begin).all() && pixel.cmplt(end).all()
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}
