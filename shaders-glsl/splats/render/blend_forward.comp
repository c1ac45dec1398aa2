#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_subgroup_uniform_control_flow : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "splat.glsl"
#include "tile.glsl"
#include "segments.glsl"
#include "status.glsl"

//! Blend forward: a subgroup owns a tile or a part of one, finds the tile's run of the sorted intersections and
//! composites it front to back.
//!
//! C = sum_i c_i alpha_i T_i + T background, T_i = prod_{j < i} (1 - alpha_j). The splats come in batches, each read by
//! all lanes. The tile's state stays in registers.
//!
//! With VIEW_DEPTHS the last channel is the depth in the view: a splat beyond a pixel's limit ends it, as the order is
//! front to back. The channel is the sum of the weighted depths, that sum over alpha, or the depth at which the
//! transmittance passes 1/2.

layout(push_constant, scalar) uniform Params {
    uvec2 size;
    uint tile_columns;
    uint longest_run;  // the most splats of a tile that this device can process
    float background[3];  // of the colours; that of other channels is 0
    uint has_limits;    // 1: `limits` has a depth for each pixel
    uint depth_kind;    // DEPTH_*: the last channel, with VIEW_DEPTHS
};

layout(binding = 0) readonly  buffer Counts     { uint counts[]; };        // [0]: intersections
layout(binding = 1) readonly  buffer IntersectionIds      { uint sorted_intersections[]; };
layout(binding = 2) readonly  buffer GaussianIds     { uint gaussian_ids[]; };
layout(binding = 3) readonly  buffer Splats     { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors     { vec4 colors[]; };      // (Gaussians, COLOR_VECTORS)
layout(binding = 5) writeonly buffer Render     { float render[]; };  // (CHANNELS, H, W)
layout(binding = 6) writeonly buffer Transmittances { float transmittances[]; };  // (H, W)
layout(binding = 7) readonly  buffer Tiles      { uint sorted_tiles[]; };
layout(binding = 8) writeonly buffer Ranges { uvec2 tile_ranges[]; };  // (tiles) first intersection, one past the last
layout(binding = 9)           buffer Status     { uint status[]; };
layout(binding = 10) readonly buffer Limits     { float limits[]; };  // (H, W) depth beyond which nothing is seen
layout(binding = 11) writeonly buffer SegmentStates { float segment_states[]; };  // include/segments.glsl

layout(constant_id = 11) const uint VIEW_DEPTHS = 0;  // 1: the last channel is the depth
const uint DEPTH_SUM = 0;
const uint DEPTH_MEDIAN = 1;
const uint DEPTH_MEAN = 2;  // 0 where nothing is visible
// The depth of a pixel without a limit, and of one where nothing is visible.
const float NO_DEPTH = 3.4e38;

#include "tile_run.glsl"
#include "batch.glsl"

// Subgroups that share a tile leave its loops each for itself.
void main() [[subgroup_uniform_control_flow]] {
    uint tile = WORKGROUP_INDEX;
    uint lane = gl_SubgroupInvocationID;
    uvec2 origin = tile_origin(tile, tile_columns);
    if (origin.y >= size.y) return;
    origin.y += gl_SubgroupID * PART_HEIGHT;
    uvec2 first_pixel = origin + lane_pixel();
    vec2 first_center = vec2(first_pixel) + 0.5;

    // Negative once the pixel is done; the magnitude is the transmittance.
    float transmittance[GROUPS];
    float color[GROUPS][CHANNELS];
    float limit[GROUPS], median[GROUPS];
    [[unroll]] for (uint g = 0; g < GROUPS; g++) {
        if (VIEW_DEPTHS != 0) {
            uvec2 pixel = min(first_pixel + group_offset(g), size - 1);
            limit[g] = has_limits != 0 ? limits[pixel.y * size.x + pixel.x] : NO_DEPTH;
            median[g] = NO_DEPTH;
        }
        // A pixel outside the image is done from the start.
        transmittance[g] = all(lessThan(first_pixel + group_offset(g), size)) ? 1.0 : -1.0;
        [[unroll]] for (uint c = 0; c < CHANNELS; c++) color[g][c] = 0.0;
    }

    uvec2 range = tile_run(tile, longest_run);
    if (gl_SubgroupID == 0 && subgroupElect()) tile_ranges[tile] = range;
    uint first = range.x;
    for (; first < range.y; first += BATCH) {
        bool alive = false;
        [[unroll]] for (uint g = 0; g < GROUPS; g++) alive = alive || transmittance[g] > 0.0;
        if (!subgroupAny(alive)) break;
        if (SEGMENT != 0 && first != range.x && (first - range.x) % SEGMENT == 0) {
            uint block = first / SEGMENT;
            [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                uint pixel = g * SUBGROUP_SIZE;
                segment_states[segment_state(block, 0) + pixel] = max(transmittance[g], 0.0);
                [[unroll]] for (uint c = 0; c < CHANNELS; c++)
                    segment_states[segment_state(block, 1 + c) + pixel] = color[g][c];
            }
        }

        uint batch = min(BATCH, range.y - first);
        uint id = gaussian_ids[sorted_intersections[first + min(lane, batch - 1)]];
        PreparedSplat mine = prepared_splat(id, 0, lane < batch, origin);
        uint waiting = stage(mine, batch);

        // Tested at its end: a processor's driver runs a loop tested at its head once more, with every lane off.
        if (SKIPS_GROUPS ? waiting > 0 : true) for (uint turn = 0; true;) {
            [[unroll]] for (uint k = 0; k < SPLATS_PER_TURN; k++) {
                if (SKIPS_GROUPS && k > 0 && turn + k >= waiting) continue;
                PreparedSplat splat = splat_of_batch(mine, turn + k);
                vec2 offset = splat.mean2d - first_center;
                vec3 exponents[COLUMNS];
                [[unroll]] for (uint i = 0; i < COLUMNS; i++)
                    exponents[i] = exponent_in_column(splat.form, splat.peak, offset.x - float(group_offset(i).x));

                // Choices are between names, both computed: a compiler makes branches of others.
                [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                    if ((splat.groups & 1u << g) == 0) continue;
                    float exponent = exponent_at(exponents[g % COLUMNS], offset.y - float(group_offset(g).y));
                    float alpha = visible_alpha(exponent, splat.peak, exp2(exponent));
                    float before = transmittance[g];
                    float after = transmittance_after(before, alpha);
                    bool is_done = after < TRANSMITTANCE_MIN;
                    if (VIEW_DEPTHS != 0) {
                        float depth = splat.color[(CHANNELS - 1) / 4][(CHANNELS - 1) % 4];
                        is_done = is_done || depth > limit[g];
                        if (before > 0.5 && after <= 0.5 && !is_done) median[g] = depth;
                    }
                    float last = -abs(before), weight = alpha * before;
                    transmittance[g] = is_done ? last : after;
                    weight = is_done ? 0.0 : weight;
                    [[unroll]] for (uint c = 0; c < CHANNELS; c++) color[g][c] += weight * splat.color[c / 4][c % 4];
                }
            }
            turn += SPLATS_PER_TURN;
            if (turn >= waiting) break;
        }
        order_shared_memory();
    }

    if (SEGMENT != 0) {
        // In segments after the end every pixel is done.
        uint segments = max((first - range.x + SEGMENT - 1) / SEGMENT, 1);
        for (uint start = range.x + segments * SEGMENT; start < range.y; start += SEGMENT) {
            [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                [[unroll]] for (uint value = 0; value <= CHANNELS; value++)
                    segment_states[segment_state(start / SEGMENT, value) + g * SUBGROUP_SIZE] = 0.0;
            }
        }
    }
    [[unroll]] for (uint g = 0; g < GROUPS; g++) {
        uvec2 pixel = first_pixel + group_offset(g);
        if (all(lessThan(pixel, size))) {
            uint at = pixel.y * size.x + pixel.x;
            float last = abs(transmittance[g]);
            transmittances[at] = last;
            [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
                render[c * size.x * size.y + at] = color[g][c] + (c < 3 ? last * background[c] : 0.0);
            }
            if (VIEW_DEPTHS != 0 && depth_kind != DEPTH_SUM) {
                float alpha = 1.0 - last;
                float mean = alpha > 0.0 ? color[g][CHANNELS - 1] / alpha : 0.0;
                render[(CHANNELS - 1) * size.x * size.y + at] = depth_kind == DEPTH_MEDIAN ? median[g] : mean;
            }
        }
    }
}
