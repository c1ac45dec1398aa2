#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"

//! Adam over the planes of include/gaussian.glsl: beta 0.9 and 0.999, epsilon 1e-15.
//!
//! m = b1 m + (1 - b1) g, v = b2 v + (1 - b2) g^2, p -= rate / (1 - b1^t) m / (sqrt(v) / sqrt(1 - b2^t) + epsilon).
//! A workgroup's row is the column, along it each thread takes `FLOATS_PER_THREAD` floats. A gradient that is not finite
//! counts as zero, so that it poisons neither moment; log scales stay within bounds whose exp is finite.
//! Nothing changes while status[0] is set. Kingma and Ba 2015. Reference: `src/reference/adam.rs`.

layout(local_size_x = 256) in;

layout(constant_id = 0) const uint FLOATS_PER_THREAD = 4;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  column_count;         // columns that take part, from the first: rows of the dispatch
    uint  feature_count;        // of these, from FEATURES_COLUMN on
    float second_correction;    // 1 / sqrt(1 - b2^t)
    float rates[PLANE_COUNT];   // learning rates / (1 - b1^t), one per plane
};

layout(binding = 0)           buffer Parameters    { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer Gradients     { float gradients[]; };       // planes
layout(binding = 2)           buffer FirstMoments  { float first_moments[]; };   // planes
layout(binding = 3)           buffer SecondMoments { float second_moments[]; };  // planes
layout(binding = 4) readonly  buffer Status        { uint status[]; };

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;
// Its square is finite: an infinite second moment would freeze its parameter for good.
const float GRADIENT_BOUND = 1e18;
// The largest scale leaves the determinant of a projected covariance finite at the near plane, (f / 0.2)^2 times its square.
const float LOG_SCALE_MIN = -30.0;
const float LOG_SCALE_MAX = 13.0;

float rate_of(uint column) {
    uint plane = 0;
    while (plane + 1 < PLANE_COUNT && column >= plane_column(plane + 1, feature_count, column_count)) ++plane;
    return rates[plane];
}

// Positive phrasing: an infinite or NaN gradient fails the test.
float tame(float gradient) {
    return abs(gradient) < 3e38 ? clamp(gradient, -GRADIENT_BOUND, GRADIENT_BOUND) : 0.0;
}

void main() {
    uint column = gl_WorkGroupID.y;
    if (column >= column_count || status[0] != 0) return;
    float rate = rate_of(column);
    bool is_log_scale = column >= LOG_SCALES_COLUMN && column < LOG_SCALES_COLUMN + 3;
    uint first = gl_WorkGroupID.x * gl_WorkGroupSize.x * FLOATS_PER_THREAD + gl_LocalInvocationID.x;
    for (uint k = 0; k < FLOATS_PER_THREAD; ++k) {
        uint row = first + k * gl_WorkGroupSize.x;
        if (row >= gaussian_count) return;
        uint i = column * gaussian_count + row;
        float gradient = tame(gradients[i]);
        float m = BETA1 * first_moments[i] + (1.0 - BETA1) * gradient;
        float v = BETA2 * second_moments[i] + (1.0 - BETA2) * gradient * gradient;
        float value = parameters[i] - rate * m / (sqrt(v) * second_correction + EPSILON);
        first_moments[i] = m;
        second_moments[i] = v;
        parameters[i] = is_log_scale ? clamp(value, LOG_SCALE_MIN, LOG_SCALE_MAX) : value;
    }
}
