#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "splat.glsl"
#include "tile.glsl"

//! Blend backward: one subgroup owns a tile and records the gradient of every intersection in its slot.
//!
//! Walks front to back again, as the forward pass did, with the light still to come, L_i = sum_{k >= i} c_k alpha_k T_k +
//! T background, which starts as the render itself: dC / dalpha_i = (c_i T_i - L_i) / (1 - alpha_i). No atomics: a slot
//! is written by the one tile it belongs to, and the sum over a Gaussian's slots comes in a fixed order.

layout(local_size_x_id = 100) in;

layout(push_constant, scalar) uniform Params { uvec2 size; uint tile_columns; };

layout(binding = 0) readonly  buffer Ranges  { uvec2 tile_ranges[]; };
layout(binding = 1) readonly  buffer Slots   { uint sorted_slots[]; };
layout(binding = 2) readonly  buffer Owners  { uint owners[]; };
layout(binding = 3) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors  { float colors[]; };
layout(binding = 5) readonly  buffer Render  { float render[]; };    // (CHANNELS, H, W)
layout(binding = 6) readonly  buffer DRender { float d_render[]; };  // (CHANNELS, H, W)
// (slots, RECORD): mean2d 2, conic 3, opacity 1, colour CHANNELS
layout(binding = 7) writeonly buffer Records { float records[]; };

const uint RECORD = 6 + CHANNELS;

shared float transmittance[TILE_PIXELS];           // zero once the pixel is done
shared float light[CHANNELS * TILE_PIXELS];        // still to come
shared float d_pixel[CHANNELS * TILE_PIXELS];

void main() {
    uint tile = WORKGROUP_INDEX;
    uint lane = gl_SubgroupInvocationID;
    uvec2 origin = uvec2(tile % tile_columns * TILE_WIDTH, tile / tile_columns * TILE_HEIGHT);
    if (origin.y >= size.y) return;
    for (uint p = lane; p < TILE_PIXELS; p += SUBGROUP_SIZE) {
        uvec2 pixel = origin + uvec2(p % TILE_WIDTH, p / TILE_WIDTH);
        bool inside = all(lessThan(pixel, size));
        uint at = inside ? pixel.y * size.x + pixel.x : 0;
        transmittance[p] = inside ? 1.0 : 0.0;
        for (uint c = 0; c < CHANNELS; c++) {
            light[c * TILE_PIXELS + p] = render[c * size.x * size.y + at];
            d_pixel[c * TILE_PIXELS + p] = d_render[c * size.x * size.y + at];
        }
    }

    uvec2 range = tile_ranges[tile];
    uint alive = 0xffffffffu >> (32 - GROUPS);
    for (uint first = range.x; first < range.y; first += SUBGROUP_SIZE) {
        uint batch = min(SUBGROUP_SIZE, range.y - first);
        uint slot = sorted_slots[first + min(lane, batch - 1)];
        float my_d_splat[6] = float[](0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        float my_d_color[CHANNELS];
        for (uint c = 0; c < CHANNELS; c++) my_d_color[c] = 0.0;
        // Behind a tile that is done every gradient is zero.
        if (alive != 0) {
            uint id = owners[slot];
            ProjectedSplat mine = splats[id];
            float my_color[CHANNELS];
            for (uint c = 0; c < CHANNELS; c++) my_color[c] = colors[CHANNELS * id + c];
            uint my_groups = splat_groups(mine, origin);

            for (uint j = 0; j < batch; j++) {
                uint groups = subgroupShuffle(my_groups, j) & alive;
                if (groups == 0) continue;
                vec2 mean2d = subgroupShuffle(mine.mean2d, j);
                vec3 conic = subgroupShuffle(mine.conic, j);
                float opacity = subgroupShuffle(mine.opacity, j);
                float splat_color[CHANNELS];
                for (uint c = 0; c < CHANNELS; c++) splat_color[c] = subgroupShuffle(my_color[c], j);
                float d_splat[6] = float[](0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
                float d_color[CHANNELS];
                for (uint c = 0; c < CHANNELS; c++) d_color[c] = 0.0;
                for (; groups != 0; groups &= groups - 1) {
                    uint p = findLSB(groups) * SUBGROUP_SIZE + lane;
                    vec2 d = mean2d - (vec2(origin + uvec2(p % TILE_WIDTH, p / TILE_WIDTH)) + 0.5);
                    float sigma = splat_sigma(conic, d);
                    float falloff = exp(-sigma);
                    float alpha = min(ALPHA_MAX, opacity * falloff);
                    float before = transmittance[p];
                    if (sigma >= 0.0 && alpha >= ALPHA_MIN && before > 0.0) {
                        float after = before * (1.0 - alpha);
                        if (after < TRANSMITTANCE_MIN) {
                            transmittance[p] = 0.0;
                        } else {
                            transmittance[p] = after;
                            float weight = alpha * before;
                            float d_alpha = 0.0;
                            for (uint c = 0; c < CHANNELS; c++) {
                                float d_c = d_pixel[c * TILE_PIXELS + p];
                                float to_come = light[c * TILE_PIXELS + p];
                                d_color[c] += weight * d_c;
                                d_alpha += (before * splat_color[c] - to_come) * d_c;
                                light[c * TILE_PIXELS + p] = to_come - weight * splat_color[c];
                            }
                            d_alpha /= 1.0 - alpha;
                            // At the cap alpha no longer depends on the splat.
                            if (opacity * falloff <= ALPHA_MAX) {
                                float d_sigma = -alpha * d_alpha;
                                d_splat[0] += d_sigma * (conic.x * d.x + conic.y * d.y);
                                d_splat[1] += d_sigma * (conic.y * d.x + conic.z * d.y);
                                d_splat[2] += d_sigma * 0.5 * d.x * d.x;
                                d_splat[3] += d_sigma * d.x * d.y;
                                d_splat[4] += d_sigma * 0.5 * d.y * d.y;
                                d_splat[5] += falloff * d_alpha;
                            }
                        }
                    }
                }
                for (uint k = 0; k < 6; k++) {
                    float sum = subgroupAdd(d_splat[k]);
                    if (lane == j) my_d_splat[k] = sum;
                }
                for (uint c = 0; c < CHANNELS; c++) {
                    float sum = subgroupAdd(d_color[c]);
                    if (lane == j) my_d_color[c] = sum;
                }
            }
            for (uint groups = alive; groups != 0; groups &= groups - 1) {
                uint group = findLSB(groups);
                if (subgroupAll(transmittance[group * SUBGROUP_SIZE + lane] == 0.0)) alive &= ~(1u << group);
            }
        }
        if (lane < batch) {
            for (uint k = 0; k < 6; k++) records[RECORD * slot + k] = my_d_splat[k];
            for (uint c = 0; c < CHANNELS; c++) records[RECORD * slot + 6 + c] = my_d_color[c];
        }
    }
}
