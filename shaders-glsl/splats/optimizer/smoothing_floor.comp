#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#define CAMERA_MODEL camera.model
#include "camera.glsl"

//! Smoothing floor: one thread per Gaussian raises the standard deviations that no training view resolves.
//!
//! A view samples the scene at depth d once every d / focal world units. The finest sampling of a Gaussian is that of
//! the views that see its mean. Gaussians that are convolved with one of a standard deviation of some pixels of that
//! view, as by the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, section 5.1), are those whose standard
//! deviations are at least as large: a bound on the parameters replaces the convolution, and files need no filter. A
//! Gaussian that no view sees keeps its scales.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  camera_count;
    float near;   // world units
    float width;  // the smallest standard deviation, in pixels of the view of the finest sampling
};

layout(binding = 0)          buffer Parameters { float parameters[]; };  // planes
layout(binding = 1) readonly buffer Cameras    { Camera cameras[]; };    // (camera_count)
layout(binding = 2) readonly buffer Status     { uint status[]; };       // nothing changes while the first is not 0

// A mean is seen up to this share of width and height outside a view, since its Gaussian reaches in.
const float SEEN_MARGIN = 0.15;

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count || status[0] != 0) return;
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    float sampling = 1e30;
    for (uint k = 0; k < camera_count; ++k) {
        Camera camera = cameras[k];
        vec3 mean_in_view = camera.view_from_world * vec4(mean, 1.0);
        float depth = camera_depth(mean_in_view, camera);
        if (!(depth > near)) continue;
        vec2 position = camera_project(mean_in_view, camera) / vec2(camera.size) - 0.5;
        if (all(lessThanEqual(abs(position), vec2(0.5 + SEEN_MARGIN))))
            sampling = min(sampling, depth / max(camera.focal.x, camera.focal.y));
    }
    if (!(sampling < 1e30)) return;
    float lowest = log(width * sampling);
    for (uint k = 0; k < 3; ++k) {
        uint at = LOG_SCALES_COLUMN * gaussian_count + 3 * i + k;
        // Written so that a NaN stays one, and is found.
        if (parameters[at] < lowest) parameters[at] = lowest;
    }
}
