#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"

//! A 3x3 convolution with stride 1 and zero padding 1, and the gradient of its input, which is also a convolution.
//!
//! output[o](p) = activation(bias[o] + sum over i and t of weight[o, i, t] input[i](p + t)), t in {-1, 0, 1}^2.
//! TRANSPOSED: weight[i, o, -t] and no bias, which turns dL/d output into dL/d input; `in_channels` is the number of
//! channels read. A lane owns COLUMNS x ROWS pixels of OUT_BLOCK output channels in registers: an implicit matrix
//! product whose inner dimension is (i, t). The lanes of a subgroup are side by side; they load the weights of an input
//! channel together and broadcast them, so no shared memory and no barrier is needed. The SUBGROUPS of a workgroup have
//! the next output channels, and find the pixels in the cache. Reference: `src/reference/conv3x3.rs`.

layout(local_size_x_id = 100, local_size_y_id = 6) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint COLUMNS = 1;
layout(constant_id = 1) const uint ROWS = 8;
layout(constant_id = 2) const uint OUT_BLOCK = 8;
layout(constant_id = 3) const uint ACTIVATION = 0;      // one of those below
layout(constant_id = 4) const bool TRANSPOSED = false;
layout(constant_id = 5) const bool ACCUMULATE = false;  // add to the output
layout(constant_id = 6) const uint SUBGROUPS = 1;

layout(push_constant, scalar) uniform Params {
    uvec2 size;          // pixels
    uint  in_channels;
    uint  out_channels;
    uint offset;  // of the layer in `values`: weights (out, in, 3, 3), or (in, out, 3, 3) if TRANSPOSED, then biases
};

// Workgroups: (out blocks / SUBGROUPS, columns / (SUBGROUP_SIZE COLUMNS), rows / ROWS); neighbours share pixels.
layout(binding = 0) readonly buffer Values { float values[]; };
layout(binding = 1) readonly buffer Source { float source[]; };  // (in, H, W)
layout(binding = 2)          buffer Target { float target[]; };  // (out, H, W)

const uint RELU = 1, SIGMOID = 2;

const uint TAPS = 9;
const uint WEIGHT_LOADS = (TAPS * OUT_BLOCK + SUBGROUP_SIZE - 1) / SUBGROUP_SIZE;

float activate(float x) {
    uint activation = ACTIVATION;
    if (activation == RELU) return not_below_zero(x);
    if (activation == SIGMOID) return 1.0 / (1.0 + exp(-x));
    return x;
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint first_channel = (gl_WorkGroupID.x * SUBGROUPS + gl_SubgroupID) * OUT_BLOCK;
    if (first_channel >= out_channels) return;
    ivec2 origin = ivec2((gl_WorkGroupID.y * SUBGROUP_SIZE + lane) * COLUMNS, gl_WorkGroupID.z * ROWS);
    ivec2 last = ivec2(size) - 1;
    uint plane = size.x * size.y;

    // This lane's share of the weights of one input channel, and the offset to the next channel's.
    uint weight_at[WEIGHT_LOADS];
    uint weight_stride = TAPS;
    if (TRANSPOSED) weight_stride = TAPS * out_channels;
    [[unroll]] for (uint k = 0; k < WEIGHT_LOADS; ++k) {
        uint share = k * SUBGROUP_SIZE + lane;
        uint channel = min(first_channel + share / TAPS, out_channels - 1);
        uint tap = share % TAPS;
        if (TRANSPOSED) {
            weight_at[k] = offset + channel * TAPS + (TAPS - 1 - tap);
        } else {
            weight_at[k] = offset + channel * in_channels * TAPS + tap;
        }
    }

    float sum[OUT_BLOCK][ROWS][COLUMNS];
    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        float bias = 0.0;
        if (TRANSPOSED) {} else bias = values[offset + TAPS * in_channels * out_channels + min(first_channel + o,
            out_channels - 1)];
        [[unroll]] for (uint r = 0; r < ROWS; ++r)
            [[unroll]] for (uint c = 0; c < COLUMNS; ++c) sum[o][r][c] = bias;
    }

    for (uint i = 0; i < in_channels; ++i) {
        float weight[WEIGHT_LOADS];
        [[unroll]] for (uint k = 0; k < WEIGHT_LOADS; ++k) weight[k] = values[weight_at[k] + i * weight_stride];
        float pixels[ROWS + 2][COLUMNS + 2];
        [[unroll]] for (int r = 0; r < ROWS + 2; ++r) {
            [[unroll]] for (int c = 0; c < COLUMNS + 2; ++c) {
                ivec2 at = origin + ivec2(c, r) - 1;
                ivec2 held = clamp(at, ivec2(0), last);
                float value = source[i * plane + uint(held.y) * size.x + uint(held.x)];
                pixels[r][c] = at == held ? value : 0.0;
            }
        }
        [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
            [[unroll]] for (uint t = 0; t < TAPS; ++t) {
                uint share = o * TAPS + t;
                float w = subgroupBroadcast(weight[share / SUBGROUP_SIZE], share % SUBGROUP_SIZE);
                [[unroll]] for (uint r = 0; r < ROWS; ++r)
                    [[unroll]] for (uint c = 0; c < COLUMNS; ++c)
                        sum[o][r][c] += w * pixels[r + t / 3][c + t % 3];
            }
        }
    }

    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        [[unroll]] for (uint r = 0; r < ROWS; ++r) {
            [[unroll]] for (uint c = 0; c < COLUMNS; ++c) {
                uvec2 at = uvec2(origin) + uvec2(c, r);
                if (at.x < size.x && at.y < size.y && first_channel + o < out_channels) {
                    uint pixel = (first_channel + o) * plane + at.y * size.x + at.x;
                    float value = activate(sum[o][r][c]);
                    if (ACCUMULATE) value += target[pixel];
                    target[pixel] = value;
                }
            }
        }
    }
}
