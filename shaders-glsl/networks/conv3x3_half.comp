#version 460
#extension GL_GOOGLE_include_directive : require
#ifdef REFLECTION
#define HALVES uvec4
#else
#define HALVES float16_t
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#extension GL_EXT_shader_16bit_storage : require
#endif
#include "kernel.glsl"
#include "packed.glsl"

//! The 3x3 convolution of `conv3x3` as a product of cooperative matrices: factors of 16 bits, sums in single precision.
//!
//! output(M channels, N pixels) += weight_t(M, K) input_t(K, N) for each tap t and every K input channels, with weights
//! from `pack_weights` and the input from `pack_map`. A subgroup owns BLOCKS matrices of channels by PACKED_ROWS rows
//! of pixels; a loaded row is used for the three vertical taps. The gradient of the input is the same product with
//! transposed weights. Rounding the factors adds an error of 2^-9 of the terms' magnitudes to that of the sums.
//! Reference: `src/reference/conv3x3_half.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint M = 8;       // output channels of a matrix
layout(constant_id = 1) const uint N = 8;       // pixels of a matrix, side by side
layout(constant_id = 2) const uint K = 8;       // input channels of a matrix
layout(constant_id = 3) const uint BLOCKS = 4;  // matrices of output channels
layout(constant_id = 4) const bool BIASED = true;
layout(constant_id = 5) const bool ACCUMULATE = false;

layout(push_constant, scalar) uniform Params {
    uvec2 size;          // pixels
    uint  in_channels;
    uint  out_channels;
    uint  biases;        // their offset in `values`, if BIASED
};

// Workgroups: (out channels / (M BLOCKS), columns / N, rows / PACKED_ROWS).
layout(binding = 0) readonly buffer LargestWeight { uint largest_weight[]; };  // as for `pack_weights`
layout(binding = 1) readonly buffer LargestSource { uint largest_source[]; };  // as for `pack_map`
layout(binding = 2) readonly buffer Values  { float values[]; };
layout(binding = 3) readonly buffer Weights { HALVES weights[]; };  // (tap, out, in)
layout(binding = 4) readonly buffer Source  { HALVES source[]; };   // (rows, columns, in)
layout(binding = 5)          buffer Target  { float target[]; };    // (out, H, W)

#ifdef REFLECTION
void main() {}
#else

shared float sums[M * N];

void main() {
    uint from = packed_channels(in_channels), to = packed_channels(out_channels);
    uint row_length = packed_size(size).x * from;
    uint first_channel = gl_WorkGroupID.x * BLOCKS * M;
    uvec2 origin = gl_WorkGroupID.yz * uvec2(N, PACKED_ROWS);
    uint corner = origin.y * row_length + origin.x * from;

    coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator> sum[BLOCKS][PACKED_ROWS];
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
        [[unroll]] for (uint r = 0; r < PACKED_ROWS; ++r)
            sum[b][r] = coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator>(0.0);

    for (uint first = 0; first < from; first += K) {
        for (uint column = 0; column < 3; ++column) {
            coopmat<float16_t, gl_ScopeSubgroup, K, N, gl_MatrixUseB> neighbours[PACKED_ROWS + 2];
            [[unroll]] for (uint r = 0; r < PACKED_ROWS + 2; ++r)
                coopMatLoad(neighbours[r], source, corner + r * row_length + column * from + first, from,
                    gl_CooperativeMatrixLayoutColumnMajor);
            [[unroll]] for (uint row = 0; row < 3; ++row) {
                [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
                    // Blocks beyond the last channels repeat sums, which are discarded.
                    uint channel = min(first_channel + b * M, to - M);
                    coopmat<float16_t, gl_ScopeSubgroup, M, K, gl_MatrixUseA> factor;
                    coopMatLoad(factor, weights, ((3 * row + column) * to + channel) * from + first, from,
                        gl_CooperativeMatrixLayoutRowMajor);
                    [[unroll]] for (uint r = 0; r < PACKED_ROWS; ++r)
                        sum[b][r] = coopMatMulAdd(factor, neighbours[r + row], sum[b][r]);
                }
            }
        }
    }

    [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
        [[unroll]] for (uint r = 0; r < PACKED_ROWS; ++r) {
            barrier();
            coopMatStore(sum[b][r], sums, 0, N, gl_CooperativeMatrixLayoutRowMajor);
            barrier();
            // Unrolled: around a loop that stays one, the index of a matrix is no constant and moves all to memory.
            [[unroll]] for (uint k = 0; k < M * N; k += SUBGROUP_SIZE) {
                uint i = k + gl_SubgroupInvocationID;
                uint channel = first_channel + b * M + i / N;
                uvec2 at = origin + uvec2(i % N, r);
                if (i < M * N && channel < out_channels && at.x < size.x && at.y < size.y) {
                    uint pixel = (channel * size.y + at.y) * size.x + at.x;
                    float value = unpacked(sums[i], largest_weight[0], largest_source[0]);
                    if (BIASED) value += values[biases + channel];
                    if (ACCUMULATE) value += target[pixel];
                    target[pixel] = value;
                }
            }
        }
    }
}
#endif
