#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "camera.glsl"
#include "splat.glsl"
#include "sh.glsl"
#include "lamp.glsl"

//! Lamp backward: the sums of the gradients of the lamp's numbers over chunks of Gaussians, after `project_backward`.
//!
//! `project_backward` has written SH_C0 times the gradient of the unlit colour, as that of the coefficients of degree
//! 0. It is 0 for a Gaussian that the view does not show. A subgroup sums `CHUNK` Gaussians in a fixed order: the
//! partition of a sum does not depend on the device.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"
layout(constant_id = 17) const uint CHUNK = 1024;

layout(push_constant) uniform Params {
    uint camera_index;
    uint gaussian_count;
    uint first_chunk;  // of those of this dispatch
};

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };  // planes
layout(binding = 1) readonly  buffer Cameras { Camera cameras[]; };
layout(binding = 2) readonly  buffer LampNumbers { float lamp[]; };  // (LAMP_NUMBERS)
layout(binding = 3) readonly  buffer Colors { vec4 colors[]; };  // (gaussian_count, COLOR_VECTORS), lit
layout(binding = 4) readonly  buffer Gradients { float gradients[]; };  // trained planes
layout(binding = 5) writeonly buffer Partials { float partials[]; };  // (chunks, LAMP_WIDTH)

#include "lamp_falloff.glsl"
#include "trained.glsl"

void main() {
    uint chunk = WORKGROUP_INDEX;
    if (chunk * CHUNK >= gaussian_count) return;
    uint end = min((chunk + 1) * CHUNK, gaussian_count);
    Lamp loaded = load_lamp();
    float sums[LAMP_WIDTH];
    [[unroll]] for (uint n = 0; n < LAMP_WIDTH; n++) sums[n] = 0.0;
    for (uint i = chunk * CHUNK + gl_SubgroupInvocationID; i < end; i += SUBGROUP_SIZE) {
        uint dc = trained_place(DC_COLUMN * gaussian_count + 3 * i);
        vec3 d_dc = vec3(gradients[dc], gradients[dc + 1], gradients[dc + 2]);
        if (d_dc == vec3(0.0)) continue;
        vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
        vec3 point = cameras[camera_index].view_from_world * vec4(mean, 1.0);
        lamp_add_gradient(loaded, point, colors[COLOR_VECTORS * i].rgb, d_dc / SH_C0, sums);
    }
    [[unroll]] for (uint n = 0; n < LAMP_WIDTH; n++) {
        float sum = subgroup_sum(sums[n]);
        if (subgroupElect()) partials[LAMP_WIDTH * (first_chunk + chunk) + n] = sum;
    }
}
