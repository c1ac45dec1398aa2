#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "ciconv.glsl"

//! The Gaussian colour model of an image, smoothed along its rows and differentiated along them.
//!
//! One thread per pixel: E, E_lambda and E_lambda_lambda of each of the 13 pixels around it, zero beyond the border.
//! Lengyel et al. 2021. Reference: `src/reference/ciconv_rows.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint width;   // pixels
    uint height;  // pixels
};

layout(binding = 0) readonly  buffer Image  { float image[]; };  // (3, H, W)
layout(binding = 1) writeonly buffer Smooth { vec3 smooth_rows[]; };  // (H, W, 3), E, E_l, E_ll
layout(binding = 2) writeonly buffer Slope  { vec3 slope_rows[]; };   // (H, W, 3)

// Columns: the contributions of R, G and B to E, E_l, E_ll (Geusebroek et al. 2001).
const mat3 COLOR_MODEL = mat3(0.06, 0.30, 0.34, 0.63, 0.04, -0.60, 0.27, -0.35, 0.17);

void main() {
    uint pixels = width * height;
    uint i = THREAD_INDEX;
    if (i >= pixels) return;
    int x = int(i % width);
    vec3 smoothed = vec3(0);
    vec3 slope = vec3(0);
    for (int u = -RADIUS; u <= RADIUS; ++u) {
        bool inside = x + u >= 0 && x + u < int(width);
        uint from = inside ? uint(int(i) + u) : 0;
        vec3 rgb = vec3(image[from], image[pixels + from], image[2 * pixels + from]);
        vec3 color = inside ? COLOR_MODEL * rgb : vec3(0);
        smoothed += SMOOTH[abs(u)] * color;
        slope += sign(float(u)) * SLOPE[abs(u)] * color;
    }
    smooth_rows[i] = smoothed;
    slope_rows[i] = slope;
}
