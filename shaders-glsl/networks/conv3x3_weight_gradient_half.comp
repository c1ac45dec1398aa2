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

//! The partial sums of `conv3x3_weight_gradient` for the weights, as products of cooperative matrices: factors of 16
//! bits, sums in single precision.
//!
//! d_weight(M out, N in) of tap t += d_target(M out, K pixels) input_t(K pixels, N in) for every K pixels of every row
//! of a strip, both packed. A subgroup owns a matrix of output channels by one of input channels. For the taps of
//! TAP_COLUMNS columns at a time it goes down K columns of the image after K columns: a matrix of input is loaded once,
//! and meets the gradients of the three rows around it. The SUBGROUPS of a workgroup have the next input channels, and
//! find the gradients in the cache. `pack_map` states the rounding error. Reference:
//! `src/reference/conv3x3_weight_gradient_half.rs`.

layout(local_size_x_id = 100, local_size_y_id = 4) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint M = 8;       // output channels of a matrix
layout(constant_id = 1) const uint N = 8;       // input channels of a matrix
layout(constant_id = 2) const uint K = 8;       // pixels of a matrix, side by side
layout(constant_id = 3) const uint ROWS = 4;    // of a strip
layout(constant_id = 4) const uint SUBGROUPS = 1;
layout(constant_id = 5) const uint TAP_COLUMNS = 3;  // 1 or 3: sums in registers

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  in_channels;
    uint  out_channels;
};

// Workgroups: (packed in channels / (N SUBGROUPS), out channels / M, strips).
layout(binding = 0) readonly  buffer SourceBound  { uint source_bound[]; };
layout(binding = 1) readonly  buffer DTargetBound { uint d_target_bound[]; };
layout(binding = 2) readonly  buffer Source   { HALVES source[]; };    // (rows, columns, in)
layout(binding = 3) readonly  buffer DTarget  { HALVES d_target[]; };  // (rows, columns, out)
layout(binding = 4) writeonly buffer Partials { float partials[]; };   // (strips, out, in, 9)

#ifdef REFLECTION
void main() {}
#else

const uint TAPS = 9;

shared float sums[SUBGROUPS * M * N];

void main() {
    uint from = packed_channels(in_channels), to = packed_channels(out_channels);
    uint columns = packed_size(size).x;
    // Subgroups beyond the last channels repeat sums, which are discarded.
    uint first_in = (gl_WorkGroupID.x * SUBGROUPS + gl_SubgroupID) * N;
    bool is_channel = first_in < from;
    first_in = min(first_in, from - N);
    uint first_out = gl_WorkGroupID.y * M;
    uint top = gl_WorkGroupID.z * ROWS;
    uint end = min(top + ROWS, size.y);

    uint set = gl_WorkGroupID.z * TAPS * in_channels * out_channels;
    uint first_sum = gl_SubgroupID * M * N;
    for (uint column = 0; column < 3; column += TAP_COLUMNS) {
        coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator> sum[3][TAP_COLUMNS];
        [[unroll]] for (uint r = 0; r < 3; ++r)
            [[unroll]] for (uint c = 0; c < TAP_COLUMNS; ++c)
                sum[r][c] = coopmat<float, gl_ScopeSubgroup, M, N, gl_MatrixUseAccumulator>(0.0);

        for (uint first = 0; first < size.x; first += K) {
            // Of rows y, y - 1, y - 2 of the output; row y of the packed input is above row y of the output.
            coopmat<float16_t, gl_ScopeSubgroup, M, K, gl_MatrixUseA> gradients[3];
            for (uint y = top; y < end + 2; ++y) {
                gradients[2] = gradients[1];
                gradients[1] = gradients[0];
                if (y < end)
                    coopMatLoad(gradients[0], d_target, ((y + 1) * columns + first + 1) * to + first_out, to,
                        gl_CooperativeMatrixLayoutColumnMajor);
                [[unroll]] for (uint c = 0; c < TAP_COLUMNS; ++c) {
                    coopmat<float16_t, gl_ScopeSubgroup, K, N, gl_MatrixUseB> neighbours;
                    coopMatLoad(neighbours, source, (y * columns + first + column + c) * from + first_in, from,
                        gl_CooperativeMatrixLayoutRowMajor);
                    [[unroll]] for (uint r = 0; r < 3; ++r)
                        if (y >= top + r && y < end + r)
                            sum[r][c] = coopMatMulAdd(gradients[r], neighbours, sum[r][c]);
                }
            }
        }

        [[unroll]] for (uint r = 0; r < 3; ++r) {
            [[unroll]] for (uint c = 0; c < TAP_COLUMNS; ++c) {
                barrier();
                coopMatStore(sum[r][c], sums, first_sum, N, gl_CooperativeMatrixLayoutRowMajor);
                barrier();
                // Unrolled: around a loop that stays one, the index of a matrix is no constant and moves all to memory.
                [[unroll]] for (uint k = 0; k < M * N; k += SUBGROUP_SIZE) {
                    uint i = k + gl_SubgroupInvocationID;
                    uint channel = first_out + i / N, other = first_in + i % N;
                    if (i < M * N && is_channel && channel < out_channels && other < in_channels)
                        partials[set + (channel * in_channels + other) * TAPS + 3 * r + column + c] =
                            unpacked(sums[first_sum + i], d_target_bound[0], source_bound[0]);
                }
            }
        }
    }
}
#endif
