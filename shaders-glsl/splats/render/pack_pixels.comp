#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"
#include "pixels.glsl"

//! Pack pixels: planes of a render to the pixels of a host's image, premultiplied, and to its depths.
//!
//! A render is display-referred and before a black background: c = sum_i c_i alpha_i T_i, and alpha = 1 - T. Where the
//! image is linear, the colour before the coverage goes through the sRGB curve and takes the exposure:
//! C = EOTF(c / alpha) exposure alpha. Over the host's picture U the result is C + T U, else C + T background. HDR10
//! has them in the primaries of BT.2020 (BT.2087) and by the curve of ST 2084, where 1 is `nits` of 10 000.
//!
//! A depth z in the view is stored as d = e where depth is reversed and as d = 1 - e else:
//! e = near (far - z) / (z (far - near)), e = near / z before an infinite far plane, and e = (far - z) / (far - near)
//! of an orthographic camera.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uint  pixel_count;
    uint  storage;     // STORED_*
    uint  light;       // LIGHT_*
    uint  swaps;       // 1: blue comes first
    uint  is_over;     // 1: over the pixels of `under`
    float exposure;    // of a linear image
    float nits;        // of light 1 in HDR10
    vec3  background;  // as the image counts colours, in the primaries of the render
    uint  depth_plane; // of the render; 0: none
    uint  is_mean;     // 1: the depths are weighted sums, else medians
    uint  is_linear_depth; // 1: depths are stored as they are
    uint  is_reversed;
    uint  is_orthographic;
    float near;        // world units
    float far;         // 0: infinite
    uint  has_scene;   // 1: where nothing is seen, the depth is that of `scene`
    uint  has_color;   // 1: the colour is stored
};

layout(binding = 0) readonly  buffer Render { float render[]; };  // (channels, pixels)
layout(binding = 1) readonly  buffer Transmittances { float transmittances[]; };  // (pixels)
layout(binding = 2) readonly  buffer Under  { uint under[]; };    // as `pixels`
layout(binding = 3) readonly  buffer Scene  { uint scene[]; };    // (pixels) as `depths`
layout(binding = 4) writeonly buffer Pixels { uint pixels[]; };   // (pixels, words)
layout(binding = 5) writeonly buffer Depths { float depths[]; };  // (pixels) in the view: infinite if nothing is seen

// Below this, a channel of sRGB is linear.
const float LINEAR_END = 0.04045;
const float LARGEST_FLOAT = 3.40282347e38;
const float LARGEST_HALF = 65504.0;
const float LARGEST_OF_11 = 65024.0;
const float LARGEST_OF_10 = 64512.0;
const float LEAST_NORMAL = 6.103515625e-5;  // of floats with 5 bits of exponent
const float NOTHING_SEEN = 3.3e38;
const uint INFINITE = 0x7f800000u;

// From the primaries of BT.709 to those of BT.2020, column by column.
const mat3 BT2020 = mat3(0.627403896, 0.069097289, 0.016391439, 0.329283038, 0.919540395, 0.088013308,
                         0.043313066, 0.011362316, 0.895595253);
const float PQ_M1 = 0.1593017578125;
const float PQ_M2 = 78.84375;
const float PQ_C1 = 0.8359375;
const float PQ_C2 = 18.8515625;
const float PQ_C3 = 18.6875;
const float PQ_NITS = 10000.0;  // of code 1

vec3 eotf(vec3 c) {
    vec3 curved = pow((max(c, vec3(LINEAR_END)) + 0.055) / 1.055, vec3(2.4));
    return mix(curved, c / 12.92, lessThanEqual(c, vec3(LINEAR_END)));
}

vec3 inverse_eotf(vec3 c) {
    return mix(1.055 * pow(max(c, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055, 12.92 * c, lessThanEqual(c, vec3(0.0031308)));
}

vec3 pq_eotf(vec3 code) {
    vec3 p = pow(code, vec3(1.0 / PQ_M2));
    return PQ_NITS / nits * pow(max(p - PQ_C1, vec3(0.0)) / (PQ_C2 - PQ_C3 * p), vec3(1.0 / PQ_M1));
}

vec3 inverse_pq_eotf(vec3 c) {
    vec3 p = pow(clamp(c * (nits / PQ_NITS), vec3(0.0), vec3(1.0)), vec3(PQ_M1));
    return pow((PQ_C1 + PQ_C2 * p) / (1.0 + PQ_C3 * p), vec3(PQ_M2));
}

bool is_linear() { return light != LIGHT_DISPLAY; }

// A colour of the render as the image counts it.
vec3 encoded(vec3 color) {
    color = max(color, vec3(0.0));
    return is_linear() ? eotf(color) * exposure : color;
}

// A NaN is 0, and nothing is beyond `largest`.
float bounded(float x, float largest) { return is_nan(x) ? 0.0 : clamp(x, -largest, largest); }

vec4 bounded(vec4 x, float largest) {
    return vec4(bounded(x.r, largest), bounded(x.g, largest), bounded(x.b, largest), bounded(x.a, largest));
}

// The nearest float without sign, of 5 bits of exponent and `mantissa` bits; a tie is even.
uint small_float(float x, uint mantissa, float largest) {
    x = x > 0.0 ? min(x, largest) : 0.0;
    if (x < LEAST_NORMAL) return uint(roundEven(x * float(1u << 14u + mantissa)));
    uint bits = floatBitsToUint(x), dropped = 23u - mantissa;
    uint half_below = (1u << dropped - 1u) - 1u;
    return (bits + half_below + (bits >> dropped & 1u) >> dropped) - (127u - 15u << mantissa);
}

// A half has the same exponents.
float of_small_float(uint bits, uint mantissa) { return unpackHalf2x16(bits << 10u - mantissa).x; }

vec4 load(uint at) {
    if (storage == STORED_HALVES) return vec4(unpackHalf2x16(under[2 * at]), unpackHalf2x16(under[2 * at + 1]));
    if (storage == STORED_FLOATS) {
        return uintBitsToFloat(uvec4(under[4 * at], under[4 * at + 1], under[4 * at + 2], under[4 * at + 3]));
    }
    uint word = under[at];
    if (storage == STORED_SMALL_FLOATS) {
        return vec4(of_small_float(word & 0x7ffu, 6), of_small_float(word >> 11 & 0x7ffu, 6),
                    of_small_float(word >> 22, 5), 1.0);
    }
    vec4 pixel = unpackUnorm4x8(word);
    if (storage == STORED_TENS) {
        uvec4 codes = uvec4(word, word >> 10, word >> 20, word >> 30) & uvec4(uvec3(1023u), 3u);
        pixel = vec4(codes) / vec4(vec3(1023.0), 3.0);
    }
    if (swaps != 0) pixel = pixel.bgra;
    if (light == LIGHT_SRGB) pixel.rgb = eotf(pixel.rgb);
    if (light == LIGHT_HDR10) pixel.rgb = pq_eotf(pixel.rgb);
    return pixel;
}

void store(uint at, vec4 pixel) {
    if (storage == STORED_HALVES) {
        pixel = bounded(pixel, LARGEST_HALF);
        pixels[2 * at] = packHalf2x16(pixel.rg);
        pixels[2 * at + 1] = packHalf2x16(pixel.ba);
        return;
    }
    pixel = bounded(pixel, LARGEST_FLOAT);
    if (storage == STORED_FLOATS) {
        for (uint c = 0; c < 4; c++) pixels[4 * at + c] = floatBitsToUint(pixel[c]);
        return;
    }
    if (storage == STORED_SMALL_FLOATS) {
        pixels[at] = small_float(pixel.r, 6, LARGEST_OF_11) | small_float(pixel.g, 6, LARGEST_OF_11) << 11
            | small_float(pixel.b, 5, LARGEST_OF_10) << 22;
        return;
    }
    if (light == LIGHT_SRGB) pixel.rgb = inverse_eotf(min(pixel.rgb, vec3(1.0)));
    if (light == LIGHT_HDR10) pixel.rgb = inverse_pq_eotf(pixel.rgb);
    if (swaps != 0) pixel = pixel.bgra;
    if (storage == STORED_TENS) {
        uvec4 tens = uvec4(round(clamp(pixel, 0.0, 1.0) * vec4(vec3(1023.0), 3.0)));
        pixels[at] = tens.r | tens.g << 10 | tens.b << 20 | tens.a << 30;
        return;
    }
    pixels[at] = packUnorm4x8(pixel);
}

// A depth in the view as the image has it.
float stored_depth(float depth, uint at) {
    bool is_seen = depth < NOTHING_SEEN;
    if (!is_seen && has_scene != 0) return uintBitsToFloat(scene[at]);
    if (is_linear_depth != 0) return is_seen ? depth : uintBitsToFloat(INFINITE);
    float e = near / depth;
    if (far > 0.0) e *= (far - depth) / (far - near);
    if (is_orthographic != 0) e = (far - depth) / (far - near);
    e = is_seen ? clamp(e, 0.0, 1.0) : 0.0;
    return is_reversed != 0 ? e : 1.0 - e;
}

void main() {
    uint at = THREAD_INDEX;
    if (at >= pixel_count) return;
    float transmittance = transmittances[at];
    float alpha = 1.0 - transmittance;
    if (depth_plane != 0) {
        float depth = render[depth_plane * pixel_count + at];
        if (is_mean != 0) depth = alpha > 0.0 ? depth / alpha : NOTHING_SEEN;
        depths[at] = stored_depth(depth, at);
    }
    if (has_color == 0) return;
    vec3 color = vec3(render[at], render[pixel_count + at], render[2 * pixel_count + at]);
    // A linear image mixes light, any other mixes what is shown.
    vec3 seen = is_linear() && alpha > 0.0 ? encoded(color / alpha) * alpha : max(color, vec3(0.0));
    if (is_over == 0) seen += transmittance * background;
    if (light == LIGHT_HDR10) seen = BT2020 * seen;
    vec4 pixel = vec4(seen, alpha);
    if (is_over != 0) pixel += transmittance * load(at);
    store(at, pixel);
}
