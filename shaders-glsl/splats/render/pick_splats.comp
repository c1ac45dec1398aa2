#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "splat.glsl"

//! Pick splats: for each pixel of a run of pixels, the splat at which the transmittance falls to 1/2, which has the
//! median depth of `blend_forward`. One thread per pixel, which walks the run of its tile.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uvec2 size;
    uint  tile_columns;
    uint  first_pixel;  // row by row
    uint  pixel_count;
    uint  has_limits;   // 1: `limits` has a depth for each pixel of the image
};

layout(binding = 0) readonly  buffer Ranges { uvec2 tile_ranges[]; };  // (tiles)
layout(binding = 1) readonly  buffer IntersectionIds { uint sorted_intersections[]; };
layout(binding = 2) readonly  buffer GaussianIds { uint gaussian_ids[]; };
layout(binding = 3) readonly  buffer Splats { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors { vec4 colors[]; };  // (Gaussians, COLOR_VECTORS); the last channel: depth
layout(binding = 5) readonly  buffer Limits { float limits[]; };  // (H, W) depth beyond which nothing is seen
layout(binding = 6) writeonly buffer Picks { uint picks[]; };  // (pixel_count, 2) splat, and the bits of its depth

const uint NO_SPLAT = 0xffffffffu;
// Splats of an iteration: some devices limit the iterations of an invocation.
const uint TURN = 4;

void main() {
    uint i = THREAD_INDEX;
    if (i >= pixel_count) return;
    picks[2 * i] = NO_SPLAT;
    picks[2 * i + 1] = 0;
    uint at = first_pixel + i;
    uvec2 pixel = uvec2(at % size.x, at / size.x);
    uvec2 range = tile_ranges[pixel.y / TILE_HEIGHT * tile_columns + pixel.x / TILE_WIDTH];
    float transmittance = 1.0;
    for (uint first = range.x; first < range.y; first += TURN) {
        [[unroll]] for (uint k = 0; k < TURN; k++) {
            uint id = gaussian_ids[sorted_intersections[min(first + k, range.y - 1)]];
            ProjectedSplat splat = splats[id];
            vec2 offset = splat.mean2d - (vec2(pixel) + 0.5);
            float peak = log2(splat.opacity);
            vec3 column = exponent_in_column(exponent_form(splat.conic), peak, offset.x);
            float exponent = exponent_at(column, offset.y);
            float alpha = first + k < range.y ? visible_alpha(exponent, peak, exp2(exponent)) : 0.0;
            float after = transmittance_after(transmittance, alpha);
            float depth = colors[COLOR_VECTORS * id + (CHANNELS - 1) / 4][(CHANNELS - 1) % 4];
            if (after < TRANSMITTANCE_MIN || has_limits != 0 && depth > limits[at]) return;
            if (after <= 0.5) {
                picks[2 * i] = id;
                picks[2 * i + 1] = floatBitsToUint(depth);
                return;
            }
            transmittance = after;
        }
    }
}
