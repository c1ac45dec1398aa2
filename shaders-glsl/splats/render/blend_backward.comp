#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_subgroup_uniform_control_flow : require
#include "kernel.glsl"
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "splat.glsl"
#include "tile.glsl"
#include "subgroup_sum.glsl"

//! Blend backward: a tile's subgroups, most often one, record the gradient of every intersection in its slot.
//!
//! Walks front to back again, as the forward pass did, with the light still to come, L_i = sum_{k >= i} c_k alpha_k
//! T_k + T background, which starts as the render itself: dC / dalpha_i = (c_i T_i - L_i) / (1 - alpha_i). Of both,
//! the product with dL/dC is all that is needed: one number a pixel, however many channels. No atomics: a slot is
//! written by the one tile it belongs to, and the sums over a tile's parts and over a Gaussian's slots come in a
//! fixed order.

// This many channels, from the first, move and shape the splats; of the others only the colours learn.
layout(constant_id = 8) const uint SHAPING_CHANNELS = 3;

layout(push_constant, scalar) uniform Params { uvec2 size; uint tile_columns; };

layout(binding = 0) readonly  buffer Ranges  { uvec2 tile_ranges[]; };
layout(binding = 1) readonly  buffer IntersectionIds   { uint sorted_intersections[]; };
layout(binding = 2) readonly  buffer GaussianIds  { uint gaussian_ids[]; };
layout(binding = 3) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors  { vec4 colors[]; };  // (Gaussians, COLOR_VECTORS)
layout(binding = 5) readonly  buffer Render  { float render[]; };    // (CHANNELS, H, W)
layout(binding = 6) readonly  buffer DRender { float d_render[]; };  // (CHANNELS, H, W)
// (slots, RECORD_VECTORS): mean2d 2, conic 3, opacity 1, colour CHANNELS, zeros
layout(binding = 7) writeonly buffer GradientRecords { vec4 gradient_records[]; };

// What every part but the first adds to the records of a batch; a tile of one part has room for one that is not used.
shared float shares[(SUBGROUPS_PER_TILE - 1 + 1 / SUBGROUPS_PER_TILE) * RECORD * SUBGROUP_SIZE];
shared uint are_alive[SUBGROUPS_PER_TILE];

// Whether any lane of any part says so; every lane has to ask.
bool tile_any(bool says) {
    bool any = subgroupAny(says);
    if (tile_is_shared()) {
        if (subgroupElect()) are_alive[gl_SubgroupID] = uint(any);
        barrier();
        for (uint part = 0; part < SUBGROUPS_PER_TILE; part++) any = any || are_alive[part] != 0;
    }
    return any;
}

// Subgroups that share a tile leave its loops each for itself.
void main() [[subgroup_uniform_control_flow]] {
    uint tile = WORKGROUP_INDEX;
    uint lane = gl_SubgroupInvocationID;
    uvec2 origin = tile_origin(tile, tile_columns);
    if (origin.y >= size.y) return;
    origin.y += gl_SubgroupID * PART_HEIGHT;
    uvec2 first_pixel = origin + lane_pixel();

    float transmittance[GROUPS];    // zero once the pixel is done
    float light[GROUPS];            // still to come, times d_pixel
    float d_pixel[GROUPS][CHANNELS];
    [[unroll]] for (uint g = 0; g < GROUPS; g++) {
        uvec2 pixel = first_pixel + group_offset(g);
        bool inside = all(lessThan(pixel, size));
        uint at = inside ? pixel.y * size.x + pixel.x : 0;
        transmittance[g] = inside ? 1.0 : 0.0;
        light[g] = 0.0;
        [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
            d_pixel[g][c] = d_render[c * size.x * size.y + at];
            if (c < SHAPING_CHANNELS) light[g] += render[c * size.x * size.y + at] * d_pixel[g][c];
        }
    }

    uvec2 range = tile_ranges[tile];
    uint first = range.x;
    for (; first < range.y; first += SUBGROUP_SIZE) {
        bool alive = false;
        [[unroll]] for (uint g = 0; g < GROUPS; g++) alive = alive || transmittance[g] > 0.0;
        if (!tile_any(alive)) break;

        uint batch = min(SUBGROUP_SIZE, range.y - first);
        uint slot = sorted_intersections[first + min(lane, batch - 1)];
        uint id = gaussian_ids[slot];
        ProjectedSplat mine = splats[id];
        vec4 my_color[COLOR_VECTORS];
        [[unroll]] for (uint k = 0; k < COLOR_VECTORS; k++) my_color[k] = colors[COLOR_VECTORS * id + k];
        uint my_groups = splat_groups(mine, origin);
        if (lane >= batch) mine.opacity = 0.0;
        vec2 my_d_mean2d = vec2(0.0);
        vec3 my_d_conic = vec3(0.0);
        float my_d_opacity = 0.0;
        float my_d_color[CHANNELS];
        [[unroll]] for (uint c = 0; c < CHANNELS; c++) my_d_color[c] = 0.0;

        // Tested at its end: a processor's driver runs a loop tested at its head once more, with every lane off.
        for (uint turn = 0; true;) {
            [[unroll]] for (uint k = 0; k < SPLATS_PER_TURN; k++) {
                uint j = turn + k;
                uint groups = subgroupShuffle(my_groups, j);
                // What misses all of the part leaves nothing to sum.
                if (SKIPS_GROUPS && groups == 0) continue;
                vec2 offset = subgroupShuffle(mine.mean2d, j) - (vec2(first_pixel) + 0.5);
                vec3 conic = subgroupShuffle(mine.conic, j);
                float opacity = subgroupShuffle(mine.opacity, j);
                float splat_color[CHANNELS];
                [[unroll]] for (uint c = 0; c < CHANNELS; c++)
                    splat_color[c] = subgroupShuffle(my_color[c / 4][c % 4], j);
                // Moments of dL/dsigma over the pixels: what every gradient of the ellipse is made of.
                float moment = 0.0;
                vec2 moment_x_y = vec2(0.0);
                vec3 moment_xx_xy_yy = vec3(0.0);
                float d_color[CHANNELS];
                [[unroll]] for (uint c = 0; c < CHANNELS; c++) d_color[c] = 0.0;

                [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                    if ((groups >> g & 1) == 0) continue;
                    vec2 d = offset - vec2(group_offset(g));
                    float sigma = splat_sigma(conic, d);
                    float falloff = exp(-sigma);
                    float alpha = min(ALPHA_MAX, opacity * falloff);
                    float before = transmittance[g];
                    bool counts = sigma >= 0.0 && alpha >= ALPHA_MIN && before > 0.0;
                    // What does not count has alpha 0: the lanes never part.
                    alpha = counts ? alpha : 0.0;
                    float after = before * (1.0 - alpha);
                    bool is_done = after < TRANSMITTANCE_MIN;
                    transmittance[g] = is_done ? 0.0 : after;
                    float weight = is_done ? 0.0 : alpha * before;
                    float shade = 0.0;
                    [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
                        d_color[c] += weight * d_pixel[g][c];
                        if (c < SHAPING_CHANNELS) shade += splat_color[c] * d_pixel[g][c];
                    }
                    float d_alpha = before * shade - light[g];
                    light[g] -= weight * shade;
                    // At the cap alpha no longer depends on the splat.
                    bool is_free = !is_done && opacity * falloff <= ALPHA_MAX;
                    d_alpha = is_free ? d_alpha / (1.0 - alpha) : 0.0;
                    float d_sigma = -alpha * d_alpha;
                    vec2 first_moment = d_sigma * d;
                    moment += d_sigma;
                    moment_x_y += first_moment;
                    moment_xx_xy_yy += first_moment.xxy * d.xyy;
                }
                moment = subgroup_sum(moment);
                moment_x_y = vec2(subgroup_sum(moment_x_y.x), subgroup_sum(moment_x_y.y));
                [[unroll]] for (uint i = 0; i < 3; i++) moment_xx_xy_yy[i] = subgroup_sum(moment_xx_xy_yy[i]);
                if (lane == j) {
                    my_d_mean2d = vec2(dot(conic.xy, moment_x_y), dot(conic.yz, moment_x_y));
                    my_d_conic = vec3(0.5, 1.0, 0.5) * moment_xx_xy_yy;
                    // dL/dsigma = -opacity falloff dL/dalpha below the cap.
                    my_d_opacity = -moment / opacity;
                }
                [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
                    float sum = subgroup_sum(d_color[c]);
                    if (lane == j) my_d_color[c] = sum;
                }
            }
            turn += SPLATS_PER_TURN;
            if (turn >= batch) break;
        }
        float record[4 * RECORD_VECTORS];
        [[unroll]] for (uint k = 0; k < 4 * RECORD_VECTORS; k++) record[k] = 0.0;
        record[0] = my_d_mean2d.x;
        record[1] = my_d_mean2d.y;
        record[2] = my_d_conic.x;
        record[3] = my_d_conic.y;
        record[4] = my_d_conic.z;
        record[5] = my_d_opacity;
        [[unroll]] for (uint c = 0; c < CHANNELS; c++) record[RECORD_HEAD + c] = my_d_color[c];
        if (tile_is_shared()) {
            if (gl_SubgroupID > 0) {
                uint share = (gl_SubgroupID - 1) * RECORD * SUBGROUP_SIZE + lane;
                [[unroll]] for (uint k = 0; k < RECORD; k++) shares[share + k * SUBGROUP_SIZE] = record[k];
            }
            barrier();
        }
        if (gl_SubgroupID == 0 && lane < batch) {
            for (uint part = 1; part < SUBGROUPS_PER_TILE; part++) {
                uint share = (part - 1) * RECORD * SUBGROUP_SIZE + lane;
                [[unroll]] for (uint k = 0; k < RECORD; k++) record[k] += shares[share + k * SUBGROUP_SIZE];
            }
            [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++)
                gradient_records[RECORD_VECTORS * slot + k] =
                    vec4(record[4 * k], record[4 * k + 1], record[4 * k + 2], record[4 * k + 3]);
        }
    }
    // After a tile that is done every gradient is zero.
    for (uint i = first + gl_LocalInvocationIndex; i < range.y; i += SUBGROUP_SIZE * SUBGROUPS_PER_TILE) {
        uint at = RECORD_VECTORS * sorted_intersections[i];
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) gradient_records[at + k] = vec4(0.0);
    }
}
