#version 460
#extension GL_GOOGLE_include_directive : require
#ifndef REFLECTION
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#endif
#include "kernel.glsl"

//! The partial sums of `conv3x3_weight_gradient` as products of cooperative matrices: factors of 16 bits, sums in single
//! precision.
//!
//! d_weight(M out, N in) of tap t += d_target(M out, K pixels) input_t(K pixels, N in) for every K pixels of every row of a
//! strip. A subgroup owns BLOCKS matrices of output channels by one of input channels, for all nine taps, and marches down
//! K columns after K columns. The three rows of input that the taps see lie in shared memory, once for each column of taps,
//! because a matrix begins at a multiple of sixteen bytes; of these a row is brought in as one is done.
//! A power of two brings the largest number of each factor in the strip to 2^14: what rounding a factor costs is said in
//! `conv3x3_half`. Biases are summed in single precision. Reference: `src/reference/conv3x3_weight_gradient_half.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint M = 8;       // output channels of a matrix
layout(constant_id = 1) const uint N = 8;       // input channels of a matrix
layout(constant_id = 2) const uint K = 8;       // pixels of a matrix, side by side
layout(constant_id = 3) const uint BLOCKS = 2;  // matrices of output channels
layout(constant_id = 4) const uint ROWS = 4;    // of a strip

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  in_channels;
    uint  out_channels;
};

// Workgroups: (in channels / N, out channels / (M BLOCKS), strips).
layout(binding = 0) readonly  buffer Source   { float source[]; };    // (in, H, W)
layout(binding = 1) readonly  buffer DTarget  { float d_target[]; };  // (out, H, W)
layout(binding = 2) writeonly buffer Partials { float partials[]; };  // (strips, out in 9 + out): weights, then biases

#ifdef REFLECTION
void main() {}
#else

const uint TAPS = 9;

shared float16_t pixels[3 * 3 * N * K];     // (column of taps, row, N, K)
shared float16_t d_pixels[BLOCKS * M * K];  // (BLOCKS M, K)
shared float sums[M * N];

float source_at(uint channel, ivec2 at) {
    ivec2 held = clamp(at, ivec2(0), ivec2(size) - 1);
    float value = source[(min(channel, in_channels - 1) * size.y + uint(held.y)) * size.x + uint(held.x)];
    return at == held && channel < in_channels ? value : 0.0;
}

float d_target_at(uint channel, uvec2 at) {
    uvec2 held = min(at, size - 1);
    float value = d_target[(min(channel, out_channels - 1) * size.y + held.y) * size.x + held.x];
    return at == held && channel < out_channels ? value : 0.0;
}

// The biased exponent of the largest number, within what leaves a scale and its inverse normal numbers.
uint exponent_of(float largest) {
    return clamp(floatBitsToUint(subgroupMax(largest)) >> 23, 23u, 254u);
}

float scale_of(uint exponent) { return uintBitsToFloat((127 + 14 + 127 - exponent) << 23); }

float inverse_scale_of(uint exponent) { return uintBitsToFloat((exponent - 14) << 23); }

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint first_in = gl_WorkGroupID.x * N;
    uint first_out = gl_WorkGroupID.y * BLOCKS * M;
    uint top = gl_WorkGroupID.z * ROWS;
    uint end = min(top + ROWS, size.y);

    float largest = 0.0, largest_d = 0.0;
    for (uint i = lane; i < N * (ROWS + 2) * size.x; i += SUBGROUP_SIZE) {
        uint row = i / size.x;
        largest = max(largest, abs(source_at(first_in + row / (ROWS + 2), ivec2(i % size.x, int(top + row % (ROWS + 2)) - 1))));
    }
    for (uint i = lane; i < BLOCKS * M * (end - top) * size.x; i += SUBGROUP_SIZE) {
        uint row = i / size.x;
        largest_d = max(largest_d, abs(d_target_at(first_out + row / (end - top), uvec2(i % size.x, top + row % (end - top)))));
    }
    uint exponent = exponent_of(largest), d_exponent = exponent_of(largest_d);
    float scale = scale_of(exponent), d_scale = scale_of(d_exponent);

    coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator> sum[BLOCKS][TAPS];
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
        [[unroll]] for (uint t = 0; t < TAPS; ++t)
            sum[b][t] = coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator>(0.0);

    for (uint first = 0; first < size.x; first += K) {
        // Rows of input from the one above the strip on; from the third on one of the strip has all that it sees.
        for (uint row = 0; row < end - top + 2; ++row) {
            barrier();
            for (uint i = lane; i < N * (K + 2); i += SUBGROUP_SIZE) {
                uint n = i / (K + 2), column = i % (K + 2);
                ivec2 at = ivec2(first + column, top + row) - 1;
                float16_t value = float16_t(scale * source_at(first_in + n, at));
                [[unroll]] for (uint c = 0; c < 3; ++c)
                    if (column - c < K) pixels[((3 * c + row % 3) * N + n) * K + column - c] = value;
            }
            if (row < 2) continue;
            for (uint i = lane; i < BLOCKS * M * K; i += SUBGROUP_SIZE)
                d_pixels[i] = float16_t(d_scale * d_target_at(first_out + i / K, uvec2(first + i % K, top + row - 2)));
            barrier();
            coopmat<float16_t, gl_ScopeSubgroup, M, K, gl_MatrixUseA> factor[BLOCKS];
            [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
                coopMatLoad(factor[b], d_pixels, b * M * K, K, gl_CooperativeMatrixLayoutRowMajor);
            [[unroll]] for (uint t = 0; t < TAPS; ++t) {
                coopmat<float16_t, gl_ScopeSubgroup, K, N, gl_MatrixUseB> neighbours;
                uint from = (3 * (t % 3) + (row - 2 + t / 3) % 3) * N * K;
                coopMatLoad(neighbours, pixels, from, K, gl_CooperativeMatrixLayoutColumnMajor);
                [[unroll]] for (uint b = 0; b < BLOCKS; ++b) sum[b][t] = coopMatMulAdd(factor[b], neighbours, sum[b][t]);
            }
        }
    }

    uint weight_count = TAPS * in_channels * out_channels;
    uint set = gl_WorkGroupID.z * (weight_count + out_channels);
    // The smaller first: nothing is infinite on the way to a number that is not.
    float small = inverse_scale_of(min(exponent, d_exponent)), large = inverse_scale_of(max(exponent, d_exponent));
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
        [[unroll]] for (uint t = 0; t < TAPS; ++t) {
            barrier();
            coopMatStore(sum[b][t], sums, 0, N, gl_CooperativeMatrixLayoutRowMajor);
            barrier();
            for (uint i = lane; i < M * N; i += SUBGROUP_SIZE) {
                uint to = first_out + b * M + i / N, from = first_in + i % N;
                if (to < out_channels && from < in_channels)
                    partials[set + (to * in_channels + from) * TAPS + t] = sums[i] * small * large;
            }
        }
    }

    if (first_in > 0) return;
    for (uint to = first_out; to < min(first_out + BLOCKS * M, out_channels); ++to) {
        float bias = 0.0;
        uint begin = (to * size.y + top) * size.x;
        for (uint i = lane; i < (end - top) * size.x; i += SUBGROUP_SIZE) bias += d_target[begin + i];
        bias = subgroupAdd(bias);
        if (lane == 0) partials[set + weight_count + to] = bias;
    }
}
#endif
