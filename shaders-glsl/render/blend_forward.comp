#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "splat.glsl"
#include "tile.glsl"

//! Blend forward: one subgroup owns a tile and composites its splats front to back.
//!
//! C = sum_i c_i alpha_i T_i + T background, T_i = prod_{j < i} (1 - alpha_j). Each lane loads one splat of a batch and
//! finds the groups of pixels that its ellipse meets; the batch is then broadcast splat by splat, and only those groups
//! are touched. The tile's state lives in shared memory, but every lane only ever touches its own pixels: no barrier.

layout(local_size_x_id = 100) in;

layout(push_constant, scalar) uniform Params { uvec2 size; uint tile_columns; float background[MAX_CHANNELS]; };

layout(binding = 0) readonly  buffer Ranges     { uvec2 tile_ranges[]; };
layout(binding = 1) readonly  buffer Slots      { uint sorted_slots[]; };
layout(binding = 2) readonly  buffer Owners     { uint owners[]; };
layout(binding = 3) readonly  buffer Splats     { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors     { float colors[]; };
layout(binding = 5) writeonly buffer Render     { float render[]; };  // (CHANNELS, H, W)
layout(binding = 6) writeonly buffer Transmittances { float transmittances[]; };  // (H, W)

// Negative once the pixel is done; the magnitude is the transmittance.
shared float transmittance[TILE_PIXELS];
shared float color[CHANNELS * TILE_PIXELS];

void main() {
    uint tile = WORKGROUP_INDEX;
    uint lane = gl_SubgroupInvocationID;
    uvec2 origin = uvec2(tile % tile_columns * TILE_WIDTH, tile / tile_columns * TILE_HEIGHT);
    if (origin.y >= size.y) return;
    for (uint p = lane; p < TILE_PIXELS; p += SUBGROUP_SIZE) {
        uvec2 pixel = origin + uvec2(p % TILE_WIDTH, p / TILE_WIDTH);
        // A pixel outside the image is done from the start.
        transmittance[p] = all(lessThan(pixel, size)) ? 1.0 : -1.0;
        for (uint c = 0; c < CHANNELS; c++) color[c * TILE_PIXELS + p] = 0.0;
    }

    uvec2 range = tile_ranges[tile];
    uint alive = 0xffffffffu >> (32 - GROUPS);
    for (uint first = range.x; first < range.y && alive != 0; first += SUBGROUP_SIZE) {
        uint batch = min(SUBGROUP_SIZE, range.y - first);
        // Lanes beyond the batch load its last splat and are never broadcast.
        uint id = owners[sorted_slots[first + min(lane, batch - 1)]];
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
            for (; groups != 0; groups &= groups - 1) {
                uint p = findLSB(groups) * SUBGROUP_SIZE + lane;
                vec2 d = mean2d - (vec2(origin + uvec2(p % TILE_WIDTH, p / TILE_WIDTH)) + 0.5);
                float sigma = splat_sigma(conic, d);
                float alpha = min(ALPHA_MAX, opacity * exp(-sigma));
                float before = transmittance[p];
                if (sigma >= 0.0 && alpha >= ALPHA_MIN && before > 0.0) {
                    float after = before * (1.0 - alpha);
                    if (after < TRANSMITTANCE_MIN) {
                        transmittance[p] = -before;
                    } else {
                        transmittance[p] = after;
                        for (uint c = 0; c < CHANNELS; c++) {
                            color[c * TILE_PIXELS + p] += alpha * before * splat_color[c];
                        }
                    }
                }
            }
        }
        for (uint groups = alive; groups != 0; groups &= groups - 1) {
            uint group = findLSB(groups);
            if (subgroupAll(transmittance[group * SUBGROUP_SIZE + lane] < 0.0)) alive &= ~(1u << group);
        }
    }

    for (uint p = lane; p < TILE_PIXELS; p += SUBGROUP_SIZE) {
        uvec2 pixel = origin + uvec2(p % TILE_WIDTH, p / TILE_WIDTH);
        if (all(lessThan(pixel, size))) {
            uint at = pixel.y * size.x + pixel.x;
            float last = abs(transmittance[p]);
            transmittances[at] = last;
            for (uint c = 0; c < CHANNELS; c++) {
                render[c * size.x * size.y + at] = color[c * TILE_PIXELS + p] + last * background[c];
            }
        }
    }
}
