#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The gradients of u mean(a - b)^2 + v TV(a) with respect to the denoised image a and the render b, and partial sums.
//!
//! TV(a) = 2 (mean of squared differences of neighbours along y + the same along x). Means are over the loss region,
//! and over pairs inside it; outside, both gradients are 0. A thread marches down `ROWS` pixels of one column of one
//! channel. Reference: `src/reference/denoising.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint ROWS = 16;

layout(push_constant) uniform Params {
    uint  width;           // pixels
    uint  height;          // pixels
    uvec2 loss_begin;  // the first pixel
    uvec2 loss_end;    // one past the last
    float mse_weight;      // u
    float tv_weight;       // v
    float mean_scale;      // 1 / (3hw), h x w the loss region
    float x_scale;         // 2 / (3h(w-1)), 0 for one column
    float y_scale;         // 2 / (3(h-1)w), 0 for one row
};

layout(binding = 0) readonly  buffer Denoised    { float denoised[]; };     // (3, H, W)
layout(binding = 1) readonly  buffer Render      { float render[]; };       // (3, H, W)
layout(binding = 2) writeonly buffer DDenoised   { float d_denoised[]; };   // (3, H, W)
layout(binding = 3) writeonly buffer DRender     { float d_render[]; };     // (3, H, W)
layout(binding = 4) writeonly buffer MsePartials { float mse_partials[]; };  // one per workgroup, sums of squares
layout(binding = 5) writeonly buffer TvPartials  { float tv_partials[]; };   // one per workgroup, parts of TV

void main() {
    uint down = (height + ROWS - 1) / ROWS;
    uint thread = WORKGROUP_INDEX * SUBGROUP_SIZE;
    if (thread >= 3 * down * width) return;
    thread += gl_LocalInvocationID.x;
    uint x = thread % width;
    uint strip = thread / width;
    uint first_row = strip % down * ROWS;
    uint plane = strip / down * width * height;
    // A workgroup's last threads can be beyond the image: they have no rows, but take part in the sums.
    uint end_row = strip < 3 * down ? min(first_row + ROWS, height) : first_row;
    bool in_columns = x >= loss_begin.x && x < loss_end.x;
    bool has_left = in_columns && x > loss_begin.x;
    bool has_right = in_columns && x + 1 < loss_end.x;

    float squares = 0.0;
    vec2 pairs = vec2(0);  // squared differences along x, y
    for (uint y = first_row; y < end_row; ++y) {
        uint i = plane + y * width + x;
        bool inside = in_columns && y >= loss_begin.y && y < loss_end.y;
        bool has_up = inside && y > loss_begin.y;
        bool has_down = inside && y + 1 < loss_end.y;
        float a = denoised[i];
        float left = inside && has_left ? a - denoised[i - 1] : 0.0;
        float right = inside && has_right ? denoised[i + 1] - a : 0.0;
        float above = has_up ? a - denoised[i - width] : 0.0;
        float below = has_down ? denoised[i + width] - a : 0.0;
        float difference = inside ? a - render[i] : 0.0;
        float d_mse = 2.0 * mse_weight * mean_scale * difference;
        d_render[i] = -d_mse;
        d_denoised[i] = d_mse + 2.0 * tv_weight * (x_scale * (left - right) + y_scale * (above - below));
        squares += difference * difference;
        pairs += vec2(right * right, below * below);
    }
    squares = subgroupAdd(squares);
    float tv = subgroupAdd(x_scale * pairs.x + y_scale * pairs.y);
    if (subgroupElect()) {
        mse_partials[WORKGROUP_INDEX] = squares;
        tv_partials[WORKGROUP_INDEX] = tv;
    }
}
