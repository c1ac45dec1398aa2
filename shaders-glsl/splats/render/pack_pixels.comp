#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "pixels.glsl"

//! Pack pixels: planes of a render to the pixels of a host's image, premultiplied, and to its depths.
//!
//! A render is display-referred and before a black background: c = sum_i c_i alpha_i T_i, and alpha = 1 - T. Where the
//! image is linear, the colour before the coverage goes through the sRGB curve and takes the exposure:
//! C = EOTF(c / alpha) exposure alpha. Over the host's picture U the result is C + T U, else C + T background.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uint  pixel_count;
    uint  encoding;    // PIXELS_*
    uint  swaps;       // 1: blue comes first
    uint  is_over;     // 1: over the pixels of `under`
    float exposure;    // of a linear image
    vec3  background;  // as the image counts colours
    uint  depth_plane; // of the render; 0: none
    uint  is_mean;     // 1: the depths are weighted sums, else medians
    uint  has_color;   // 1: the colour is stored
};

layout(binding = 0) readonly  buffer Render { float render[]; };  // (channels, pixels)
layout(binding = 1) readonly  buffer Transmittances { float transmittances[]; };  // (pixels)
layout(binding = 2) readonly  buffer Under  { uint under[]; };    // as `pixels`
layout(binding = 3) writeonly buffer Pixels { uint pixels[]; };   // (pixels, words)
layout(binding = 4) writeonly buffer Depths { float depths[]; };  // (pixels) world units; infinite: nothing is seen

// Below this, a channel of sRGB is linear.
const float LINEAR_END = 0.04045;
const float LARGEST_HALF = 65504.0;
const float NOTHING_SEEN = 3.3e38;
const uint INFINITE = 0x7f800000u;

vec3 eotf(vec3 c) {
    vec3 curved = pow((max(c, vec3(LINEAR_END)) + 0.055) / 1.055, vec3(2.4));
    return mix(curved, c / 12.92, lessThanEqual(c, vec3(LINEAR_END)));
}

vec3 inverse_eotf(vec3 c) {
    return mix(1.055 * pow(max(c, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055, 12.92 * c, lessThanEqual(c, vec3(0.0031308)));
}

bool is_half() { return encoding <= PIXELS_DISPLAY_HALF; }
bool is_linear() { return encoding == PIXELS_LINEAR_HALF || encoding == PIXELS_SRGB; }

// A colour of the render as the image counts it.
vec3 encoded(vec3 color) {
    color = max(color, vec3(0.0));
    return is_linear() ? eotf(color) * exposure : color;
}

vec4 load(uint at) {
    if (is_half()) return vec4(unpackHalf2x16(under[2 * at]), unpackHalf2x16(under[2 * at + 1]));
    vec4 pixel = unpackUnorm4x8(under[at]);
    if (swaps != 0) pixel = pixel.bgra;
    if (encoding == PIXELS_SRGB) pixel.rgb = eotf(pixel.rgb);
    return pixel;
}

void store(uint at, vec4 pixel) {
    if (is_half()) {
        pixel = min(pixel, vec4(LARGEST_HALF));
        pixels[2 * at] = packHalf2x16(pixel.rg);
        pixels[2 * at + 1] = packHalf2x16(pixel.ba);
        return;
    }
    if (encoding == PIXELS_SRGB) pixel.rgb = inverse_eotf(min(pixel.rgb, vec3(1.0)));
    if (swaps != 0) pixel = pixel.bgra;
    pixels[at] = packUnorm4x8(pixel);
}

void main() {
    uint at = THREAD_INDEX;
    if (at >= pixel_count) return;
    float transmittance = transmittances[at];
    float alpha = 1.0 - transmittance;
    if (depth_plane != 0) {
        float depth = render[depth_plane * pixel_count + at];
        if (is_mean != 0) depth = alpha > 0.0 ? depth / alpha : NOTHING_SEEN;
        depths[at] = depth >= NOTHING_SEEN ? uintBitsToFloat(INFINITE) : depth;
    }
    if (has_color == 0) return;
    vec3 color = vec3(render[at], render[pixel_count + at], render[2 * pixel_count + at]);
    // A linear image mixes light, any other mixes what is shown.
    vec3 seen = is_linear() && alpha > 0.0 ? encoded(color / alpha) * alpha : max(color, vec3(0.0));
    vec4 pixel = vec4(seen, alpha);
    if (is_over != 0) pixel += transmittance * load(at);
    else pixel.rgb += transmittance * background;
    store(at, pixel);
}
