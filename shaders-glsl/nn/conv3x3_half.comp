#version 460
#extension GL_GOOGLE_include_directive : require
#ifndef REFLECTION
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#endif
#include "kernel.glsl"

//! The 3x3 convolution of `conv3x3` as a product of cooperative matrices: factors of 16 bits, sums in single precision.
//!
//! output(M channels, N pixels) += weight_t(M, K) input_t(K, N) for each tap t and every K input channels. A subgroup
//! owns BLOCKS matrices of channels by ROWS rows of pixels and brings both factors to shared memory; the pixels lie there
//! once for each column of taps, because a matrix begins at a multiple of sixteen bytes.
//! A power of two brings the largest pixel of the tile to 2^14, another the weights to 2^8 times themselves, so that
//! neither small gradients nor large features leave the range of 16 bits; weights may have magnitudes up to 255.
//! Rounding a factor costs 2^-10 at most: the sum errs by 2^-9 of its terms' magnitudes, beside what `conv3x3` errs by.
//! Reference: `src/reference/conv3x3.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint M = 8;       // output channels of a matrix
layout(constant_id = 1) const uint N = 8;       // pixels of a matrix, side by side
layout(constant_id = 2) const uint K = 8;       // input channels of a matrix
layout(constant_id = 3) const uint BLOCKS = 4;  // matrices of output channels
layout(constant_id = 4) const uint ROWS = 4;    // of pixels
layout(constant_id = 5) const bool TRANSPOSED = false;
layout(constant_id = 6) const bool ACCUMULATE = false;

layout(push_constant, scalar) uniform Params {
    uvec2 size;          // pixels
    uint  in_channels;
    uint  out_channels;
    uint  offset;        // as in `conv3x3`
};

// Workgroups: (out channels / (M BLOCKS), columns / N, rows / ROWS).
layout(binding = 0) readonly buffer Values { float values[]; };
layout(binding = 1) readonly buffer Source { float source[]; };  // (in, H, W)
layout(binding = 2)          buffer Target { float target[]; };  // (out, H, W)

#ifdef REFLECTION
void main() {}
#else

const uint TAPS = 9;
const uint TILE_ROWS = ROWS + 2;

shared float16_t pixels[3 * TILE_ROWS * K * N];  // (column of taps, row, K, N)
shared float16_t weights[BLOCKS * M * K];        // (BLOCKS M, K) of one tap
shared float sums[M * N];

float padded(uint channel, ivec2 at) {
    ivec2 held = clamp(at, ivec2(0), ivec2(size) - 1);
    float value = source[(min(channel, in_channels - 1) * size.y + uint(held.y)) * size.x + uint(held.x)];
    return at == held && channel < in_channels ? value : 0.0;
}

float weight(uint to, uint from, uint tap) {
    if (to >= out_channels || from >= in_channels) return 0.0;
    if (TRANSPOSED) return values[offset + (from * out_channels + to) * TAPS + (TAPS - 1 - tap)];
    return values[offset + (to * in_channels + from) * TAPS + tap];
}

// The biased exponent of the tile's largest pixel, within what leaves both scales normal numbers.
uint largest_exponent(ivec2 corner) {
    float largest = 0.0;
    uint columns = N + 2;
    for (uint i = gl_SubgroupInvocationID; i < in_channels * TILE_ROWS * columns; i += SUBGROUP_SIZE) {
        ivec2 at = corner + ivec2(i % columns, i / columns % TILE_ROWS);
        largest = max(largest, abs(padded(i / (columns * TILE_ROWS), at)));
    }
    return clamp(floatBitsToUint(subgroupMax(largest)) >> 23, 23u, 254u);
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint first_channel = gl_WorkGroupID.x * BLOCKS * M;
    uvec2 origin = gl_WorkGroupID.yz * uvec2(N, ROWS);
    ivec2 corner = ivec2(origin) - 1;
    uint exponent = largest_exponent(corner);
    float pixel_scale = uintBitsToFloat((127 + 14 + 127 - exponent) << 23);
    float weight_scale = 256.0;
    float unscale = uintBitsToFloat((exponent - 14 - 8) << 23);

    coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator> sum[BLOCKS][ROWS];
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b)
        [[unroll]] for (uint r = 0; r < ROWS; ++r)
            sum[b][r] = coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator>(0.0);

    for (uint first = 0; first < in_channels; first += K) {
        barrier();
        for (uint i = lane; i < 3 * TILE_ROWS * K * N; i += SUBGROUP_SIZE) {
            uvec2 in_tile = uvec2(i % N + i / (N * K * TILE_ROWS), i / (N * K) % TILE_ROWS);
            pixels[i] = float16_t(pixel_scale * padded(first + i / N % K, corner + ivec2(in_tile)));
        }
        for (uint t = 0; t < TAPS; ++t) {
            barrier();
            for (uint i = lane; i < BLOCKS * M * K; i += SUBGROUP_SIZE)
                weights[i] = float16_t(weight_scale * weight(first_channel + i / K, first + i % K, t));
            barrier();
            coopmat<float16_t, gl_ScopeSubgroup, K, N, gl_MatrixUseB> neighbours[ROWS];
            [[unroll]] for (uint r = 0; r < ROWS; ++r)
                coopMatLoad(neighbours[r], pixels, (t % 3 * TILE_ROWS + r + t / 3) * K * N, N, gl_CooperativeMatrixLayoutRowMajor);
            [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
                coopmat<float16_t, gl_ScopeSubgroup, M, K, gl_MatrixUseA> factor;
                coopMatLoad(factor, weights, b * M * K, K, gl_CooperativeMatrixLayoutRowMajor);
                [[unroll]] for (uint r = 0; r < ROWS; ++r) sum[b][r] = coopMatMulAdd(factor, neighbours[r], sum[b][r]);
            }
        }
    }

    uint biases = offset + TAPS * in_channels * out_channels;
    [[unroll]] for (uint b = 0; b < BLOCKS; ++b) {
        [[unroll]] for (uint r = 0; r < ROWS; ++r) {
            barrier();
            coopMatStore(sum[b][r], sums, 0, N, gl_CooperativeMatrixLayoutRowMajor);
            barrier();
            for (uint i = lane; i < M * N; i += SUBGROUP_SIZE) {
                uint channel = first_channel + b * M + i / N;
                uvec2 at = origin + uvec2(i % N, r);
                if (channel < out_channels && at.x < size.x && at.y < size.y) {
                    uint pixel = (channel * size.y + at.y) * size.x + at.x;
                    float value = unscale * sums[i];
                    if (TRANSPOSED) {} else value += values[biases + channel];
                    if (ACCUMULATE) value += target[pixel];
                    target[pixel] = value;
                }
            }
        }
    }
}
#endif
