#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "ciconv.glsl"

//! The colour invariant W of an image, its logarithm, and the partial moments that normalise it.
//!
//! Smoothing and differentiating the output of `ciconv_rows` along the columns gives E and the derivatives along x and
//! y of E, E_l and E_ll; W = sum (d / (max(E, 0) + 1e-5))^2 over the six. One thread per pixel. A workgroup is one
//! subgroup and writes the mean of its ln(W + 1e-5) and their sum of squares about that mean: nothing cancels, however
//! far from 0 they are. Lengyel et al. 2021. Reference: `src/reference/ciconv_columns.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint width;              // pixels
    uint height;             // pixels
    uint pixels_per_moment;  // a workgroup's
};

layout(binding = 0) readonly  buffer Smooth  { vec3 smooth_rows[]; };  // (H, W, 3), E, E_l, E_ll
layout(binding = 1) readonly  buffer Slope   { vec3 slope_rows[]; };   // (H, W, 3)
layout(binding = 2) writeonly buffer Logs    { float logs[]; };        // (H, W), ln(W + 1e-5)
layout(binding = 3) writeonly buffer Moments { vec2 moments[]; };  // mean and sum of squares about it, per workgroup

const float EPSILON = 1e-5;

float log_invariant(uint i) {
    int y = int(i / width);
    vec3 color = vec3(0);     // smoothed along both
    vec3 along_x = vec3(0);
    vec3 along_y = vec3(0);
    for (int u = -RADIUS; u <= RADIUS; ++u) {
        bool inside = y + u >= 0 && y + u < int(height);
        uint from = inside ? uint(int(i) + u * int(width)) : 0;
        vec3 smoothed = inside ? smooth_rows[from] : vec3(0);
        vec3 slope = inside ? slope_rows[from] : vec3(0);
        color += SMOOTH[abs(u)] * smoothed;
        along_x += SMOOTH[abs(u)] * slope;
        along_y += sign(float(u)) * SLOPE[abs(u)] * smoothed;
    }
    // Noise below black has no colour.
    float scale = 1.0 / (max(color.x, 0.0) + EPSILON);
    along_x *= scale;
    along_y *= scale;
    return log(dot(along_x, along_x) + dot(along_y, along_y) + EPSILON);
}

void main() {
    uint i = WORKGROUP_INDEX * pixels_per_moment + gl_LocalInvocationID.x;
    bool inside = i < width * height;
    float value = inside ? log_invariant(i) : 0.0;
    if (inside) logs[i] = value;
    float mean = subgroupAdd(value) / subgroupAdd(inside ? 1.0 : 0.0);
    float deviation = inside ? value - mean : 0.0;
    float squares = subgroupAdd(deviation * deviation);
    if (inside && subgroupElect()) moments[WORKGROUP_INDEX] = vec2(mean, squares);
}
