#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Partial sums of the gradient of a 3x3 convolution's weights and biases, one set per strip of ROWS rows.
//!
//! d weight[o, i, t] = sum over p of d_output[o](p) input[i](p + t), d bias[o] = sum over p of d_output[o](p). A
//! subgroup processes one input channel, OUT_BLOCK output channels and one strip, its lanes side by side, and slides a
//! window of three rows down the strip: an input value is loaded three times per strip instead of nine. The SUBGROUPS
//! of a workgroup have the next input channels, and find the gradient in the cache. `reduce_strips` sums the sets.
//! Reference: `src/reference/conv3x3_weight_gradient.rs`.

layout(local_size_x_id = 100, local_size_y_id = 2) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint ROWS = 16;
layout(constant_id = 1) const uint OUT_BLOCK = 8;
layout(constant_id = 2) const uint SUBGROUPS = 1;

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  in_channels;
    uint  out_channels;
};

// Workgroups: (in channels / SUBGROUPS, out blocks, strips).
layout(binding = 0) readonly  buffer Source   { float source[]; };    // (in, H, W)
layout(binding = 1) readonly  buffer DTarget  { float d_target[]; };  // (out, H, W)
layout(binding = 2) writeonly buffer Partials { float partials[]; };  // (strips, out in 9 + out): weights, then biases

const uint TAPS = 9;

float padded(uint plane, ivec2 at) {
    ivec2 held = clamp(at, ivec2(0), ivec2(size) - 1);
    float value = source[plane + uint(held.y) * size.x + uint(held.x)];
    return at == held ? value : 0.0;
}

void main() {
    uint channel = gl_WorkGroupID.x * SUBGROUPS + gl_SubgroupID;
    if (channel >= in_channels) return;
    uint first_channel = gl_WorkGroupID.y * OUT_BLOCK;
    uint strip = gl_WorkGroupID.z;
    uint top = strip * ROWS;
    uint end = min(top + ROWS, size.y);
    uint pixel_count = size.x * size.y;
    uint plane = channel * pixel_count;

    float d_weight[OUT_BLOCK][TAPS];
    float d_bias[OUT_BLOCK];
    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        d_bias[o] = 0.0;
        [[unroll]] for (uint t = 0; t < TAPS; ++t) d_weight[o][t] = 0.0;
    }
    for (uint first = 0; first < size.x; first += SUBGROUP_SIZE) {
        int x = int(first + gl_SubgroupInvocationID);
        bool is_inside = x < int(size.x);
        float window[3][3];
        [[unroll]] for (int r = 0; r < 2; ++r)
            [[unroll]] for (int c = 0; c < 3; ++c) window[r][c] = padded(plane, ivec2(x + c - 1, int(top) + r - 1));
        for (uint y = top; y < end; ++y) {
            [[unroll]] for (int c = 0; c < 3; ++c) window[2][c] = padded(plane, ivec2(x + c - 1, int(y) + 1));
            [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
                uint out_channel = min(first_channel + o, out_channels - 1);
                float d = d_target[out_channel * pixel_count + y * size.x + uint(min(x, int(size.x) - 1))];
                d = is_inside ? d : 0.0;
                d_bias[o] += d;
                [[unroll]] for (uint t = 0; t < TAPS; ++t) d_weight[o][t] += d * window[t / 3][t % 3];
            }
            [[unroll]] for (int c = 0; c < 3; ++c) {
                window[0][c] = window[1][c];
                window[1][c] = window[2][c];
            }
        }
    }

    uint weight_count = TAPS * in_channels * out_channels;
    uint set = strip * (weight_count + out_channels);
    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        uint out_channel = first_channel + o;
        bool is_mine = out_channel < out_channels && gl_SubgroupInvocationID == 0;
        [[unroll]] for (uint t = 0; t < TAPS; ++t) {
            float sum = subgroupAdd(d_weight[o][t]);
            if (is_mine) partials[set + (out_channel * in_channels + channel) * TAPS + t] = sum;
        }
        float sum = subgroupAdd(d_bias[o]);
        if (is_mine && channel == 0) partials[set + weight_count + out_channel] = sum;
    }
}
