#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"

//! The gradient of (1 - w) mean|a - b| + w (1 - mean SSIM) with respect to a render a, from the derivatives that
//! `ssim_forward` writes, and the means of |a - b| and SSIM into the step's slot of the log: the second of two passes
//! that together are `ssim` and `loss_log`.
//!
//! A subgroup blurs the derivatives of a strip (include/ssim_strip.glsl). The last one to finish adds up the partial
//! sums of all, in a fixed order. The first term of a step writes the gradient,
//! the others add to it. Reference: `src/reference/ssim_backward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const bool ADDS = false;

layout(push_constant, scalar) uniform Params {
    uint  width;       // pixels
    uint  height;      // pixels
    uint  rows;        // of a strip
    uvec2 loss_begin;  // the first pixel
    uvec2 loss_end;    // one past the last
    float l1_scale;    // (1 - w) / (3hw), h x w the loss region
    float ssim_scale;  // w / (3hw)
    float mean_scale;  // 1 / (3hw)
    uint  strips;      // workgroups, and partial sums of each term
    uint  slot;        // row of `log`
    uint  term_count;  // columns of `log`
    uvec2 terms;       // a column each
};

layout(binding = 0) readonly  buffer Render   { float render[]; };    // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Target   { float target[]; };    // (3, H, W)
layout(binding = 2) readonly  buffer DMean    { float d_mean[]; };    // (3, H, W), dS/dE[a]
layout(binding = 3) readonly  buffer DSquare  { float d_square[]; };  // (3, H, W), dS/dE[aa]
layout(binding = 4) readonly  buffer DProduct { float d_product[]; };  // (3, H, W), dS/dE[ab]
layout(binding = 5)           buffer DRender  { float d_render[]; };  // (3, H, W)
layout(binding = 6) coherent  buffer L1Partials   { float l1_partials[]; };    // one per strip: sum of |a - b|
layout(binding = 7) readonly  buffer SsimPartials { float ssim_partials[]; };  // one per strip: sum of S
layout(binding = 8) writeonly buffer Log      { float log[]; };       // (slots, term_count)
layout(binding = 9) writeonly buffer Statuses { uint statuses[]; };   // (slots,), status[0] after the step
layout(binding = 10)          buffer Status   { uint status[]; };
layout(binding = 11) coherent buffer Arrivals { uint arrivals[]; };

#include "ssim_window.glsl"
#include "ssim_strip.glsl"
#include "last_workgroup.glsl"
#include "log_row.glsl"

shared vec3 shared_rows[2 * ROW];

// Loads the derivatives of row `y`; zero outside the image.
void load_row(Strip strip, int y, uint first) {
    [[unroll]] for (uint k = 0; k < LOADS; ++k) {
        uint column = k * SUBGROUP_SIZE + gl_SubgroupInvocationID;
        if (column >= ROW) continue;
        vec3 loaded = vec3(0.0);
        if (is_in_image(strip, column, y)) {
            uint at = index_of(strip, column, y);
            loaded = vec3(d_mean[at], d_square[at], d_product[at]);
        }
        shared_rows[first + column] = loaded;
    }
}

// The derivatives around a place of shared memory, blurred along x.
vec3 blur(uint centre) {
    vec3 sum = TAPS[0] * shared_rows[centre];
    [[unroll]] for (int d = 1; d <= RADIUS; ++d) sum += TAPS[d] * (shared_rows[centre - d] + shared_rows[centre + d]);
    return sum;
}

void main() {
    Strip strip = strip_of(WORKGROUP_INDEX);
    if (strip.channel >= 3) return;
    uint x = strip.x + gl_SubgroupInvocationID;
    vec3 pending[PENDING];
    [[unroll]] for (uint k = 0; k < PENDING; ++k) pending[k] = vec3(0.0);

    float sum = 0.0;
    for (int y = strip.y - RADIUS; y < strip.end + RADIUS; ++y) {
        uint first = (uint(y) & 1) * ROW;
        load_row(strip, y, first);
        int done = y - RADIUS;
        bool is_output = done >= strip.y && x < width;
        uint at = is_output ? (strip.channel * height + uint(done)) * width + x : 0;
        float a = render[at], b = target[at];
        share_rows();
        vec3 value = blur(first + gl_SubgroupInvocationID + RADIUS);
        vec3 d = pending[0] + TAPS[RADIUS] * value;
        [[unroll]] for (int k = 1; k < PENDING; ++k) pending[k - 1] = pending[k] + TAPS[abs(k - RADIUS)] * value;
        pending[PENDING - 1] = TAPS[RADIUS] * value;

        if (!is_output) continue;
        float difference = is_inside(x, uint(done)) ? a - b : 0.0;
        float gradient = l1_scale * sign(difference) - ssim_scale * d_ssim(a, b, d);
        d_render[at] = ADDS ? d_render[at] + gradient : gradient;
        sum += abs(difference);
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) l1_partials[WORKGROUP_INDEX] = sum;

    if (!is_last_workgroup(strips)) return;
    vec2 sums = vec2(0.0);
    ADD_PARTIALS(l1_partials, strips, sums.x)
    ADD_PARTIALS(ssim_partials, strips, sums.y)
    vec2 means = vec2(subgroupAdd(sums.x), subgroupAdd(sums.y)) * mean_scale;
    if (subgroupElect()) write_row(means, bvec2(true));
}
