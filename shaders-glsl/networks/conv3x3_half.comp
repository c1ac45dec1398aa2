#version 460
#extension GL_GOOGLE_include_directive : require
#ifndef REFLECTION
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#endif
#include "kernel.glsl"
#include "packed.glsl"

//! The 3x3 convolution of `conv3x3` without biases, as a product of cooperative matrices: packed factors and result,
//! sums in single precision.
//!
//! output(M channels, N pixels) += weight_t(M, K) input_t(K, N) for each tap t and every K input channels, with weights
//! from `pack_weights`. A subgroup owns BLOCKS matrices of channels by PACKED_ROWS rows of pixels, and a workgroup has
//! SUBGROUPS of these below each other. It copies K input channels of its pixels and weights to shared memory, which
//! all nine taps read. The gradient of the input is the same product with transposed weights, added to `shortcut`. The
//! bound of a sum is that of its terms times their number. Rounding the factors adds an error of 2^-9 of the terms'
//! magnitudes to that of the sums. Reference: `src/reference/conv3x3_half.rs`.

layout(local_size_x_id = 100, local_size_y_id = 4) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint M = 8;       // output channels of a matrix
layout(constant_id = 1) const uint N = 8;       // pixels of a matrix, side by side
layout(constant_id = 2) const uint K = 8;       // input channels of a matrix
layout(constant_id = 3) const uint BLOCKS = 4;  // matrices of output channels
layout(constant_id = 4) const uint SUBGROUPS = 4;
layout(constant_id = 5) const bool ACCUMULATE = false;  // add `shortcut`

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  in_channels;
    uint  out_channels;
    uint  largest_index;  // in `shortcut_largest`
};

// Workgroups: (packed out channels / (M BLOCKS), columns / N, rows / (SUBGROUPS PACKED_ROWS)).
layout(binding = 0) readonly  buffer WeightBound     { uint weight_bound[]; };
layout(binding = 1) readonly  buffer SourceBound     { uint source_bound[]; };
layout(binding = 2) readonly  buffer ShortcutLargest { uint shortcut_largest[]; };  // magnitudes, as bits
layout(binding = 3) readonly  buffer ShortcutBound   { uint shortcut_bound[]; };
layout(binding = 4) readonly  buffer Weights         { uvec4 weights[]; };   // (tap, out, in), eight halves each
layout(binding = 5) readonly  buffer Source          { uvec4 source[]; };    // (rows, columns, in)
layout(binding = 6) readonly  buffer Shortcut        { uvec4 shortcut[]; };  // (rows, columns, out)
layout(binding = 7) writeonly buffer TargetBound     { uint target_bound[]; };
layout(binding = 8) writeonly buffer Target          { uvec4 target[]; };    // (rows, columns, out), not its border

#ifdef REFLECTION
void main() {}
#else

const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;
const uint EIGHTS = K / 8;
// From a pixel or an output channel to the next: one eight more than K, so that rows of a matrix differ in their banks.
const uint STEP = EIGHTS + 1;
const uint COLUMNS = N + 2, ROWS = SUBGROUPS * PACKED_ROWS + 2;
const uint CHANNELS = M * BLOCKS;
shared uvec4 pixels[ROWS * COLUMNS * STEP];
shared uvec4 factors[9 * CHANNELS * STEP];
shared float sums[SUBGROUPS * M * N];

// Copies K input channels from `first` on of the workgroup's pixels and weights, the nearest instead of those beyond.
void stage(uvec2 origin, uint first_channel, uint first) {
    uint from = packed_channels(in_channels), to = packed_channels(out_channels);
    uvec2 extent = packed_size(size);
    for (uint i = gl_LocalInvocationIndex; i < ROWS * COLUMNS * EIGHTS; i += THREADS) {
        uint pixel = i / EIGHTS, eight = i % EIGHTS;
        uvec2 at = min(origin + uvec2(pixel % COLUMNS, pixel / COLUMNS), extent - 1);
        pixels[pixel * STEP + eight] = source[((at.y * extent.x + at.x) * from + first) / 8 + eight];
    }
    for (uint i = gl_LocalInvocationIndex; i < 9 * CHANNELS * EIGHTS; i += THREADS) {
        uint row = i / EIGHTS, eight = i % EIGHTS;
        uint channel = min(first_channel + row % CHANNELS, to - 1);
        factors[row * STEP + eight] = weights[((row / CHANNELS * to + channel) * from + first) / 8 + eight];
    }
}

void main() {
    uint from = packed_channels(in_channels), to = packed_channels(out_channels);
    uint first_channel = gl_WorkGroupID.x * CHANNELS;
    uvec2 origin = gl_WorkGroupID.yz * uvec2(N, SUBGROUPS * PACKED_ROWS);
    uint row = gl_SubgroupID * PACKED_ROWS;  // the subgroup's first

    coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator> sum[BLOCKS][PACKED_ROWS];
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
        [[unroll]] for (uint r = 0; r < PACKED_ROWS; ++r)
            sum[b][r] = coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator>(0.0);

    for (uint first = 0; first < from; first += K) {
        barrier();
        stage(origin, first_channel, first);
        barrier();
        [[unroll]] for (uint column = 0; column < 3; ++column) {
            coopmat<float16_t, gl_ScopeSubgroup, M, K, gl_MatrixUseA> taps[BLOCKS][3];
            [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
                [[unroll]] for (uint t = 0; t < 3; ++t)
                    coopMatLoad(taps[b][t], factors, ((3 * t + column) * CHANNELS + b * M) * STEP, STEP,
                        gl_CooperativeMatrixLayoutRowMajor);
            [[unroll]] for (uint r = 0; r < PACKED_ROWS + 2; ++r) {
                coopmat<float16_t, gl_ScopeSubgroup, K, N, gl_MatrixUseB> neighbours;
                coopMatLoad(neighbours, pixels, ((row + r) * COLUMNS + column) * STEP, STEP,
                    gl_CooperativeMatrixLayoutColumnMajor);
                [[unroll]] for (uint t = 0; t < 3; ++t)
                    if (r >= t && r < PACKED_ROWS + t)
                        [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
                            sum[b][r - t] = coopMatMulAdd(taps[b][t], neighbours, sum[b][r - t]);
            }
        }
    }

    precise float most = float(9 * in_channels) * uintBitsToFloat(weight_bound[0]) * uintBitsToFloat(source_bound[0]);
    if (ACCUMULATE) most += uintBitsToFloat(shortcut_largest[largest_index]);
    uint bound = floatBitsToUint(most);
    if (gl_WorkGroupID == uvec3(0) && gl_LocalInvocationIndex == 0) target_bound[0] = bound;
    float scale = packed_scale(packed_exponent(bound));
    float shortcut_inverse = packed_inverse(packed_exponent(shortcut_bound[0]));

    uint first_sum = gl_SubgroupID * M * N;
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
        [[unroll]] for (uint r = 0; r < PACKED_ROWS; ++r) {
            barrier();
            coopMatStore(sum[b][r], sums, first_sum, M, gl_CooperativeMatrixLayoutColumnMajor);
            barrier();
            // Unrolled: around a loop that stays one, the index of a matrix is no constant and moves all to memory.
            [[unroll]] for (uint k = 0; k < M * N / 8; k += SUBGROUP_SIZE) {
                uint i = k + gl_SubgroupInvocationID;
                uint channel = first_channel + b * M + 8 * i % M;
                uvec2 at = origin + uvec2(8 * i / M, row + r);
                if (i >= M * N / 8 || channel >= to || at.x >= size.x || at.y >= size.y) continue;
                uint eight = packed_index(size, out_channels, at) + channel / 8;
                float values[8] = float[8](0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
                if (ACCUMULATE) values = unpacked_eight(shortcut[eight], shortcut_inverse);
                [[unroll]] for (uint c = 0; c < 8; ++c)
                    values[c] += unpacked(sums[first_sum + 8 * i + c], weight_bound[0], source_bound[0]);
                target[eight] = packed_eight(values, scale);
            }
        }
    }
}
#endif
