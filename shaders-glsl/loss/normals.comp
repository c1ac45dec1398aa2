#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "map_normal.glsl"

//! The normals of the rendered depth against those of a normal map: partial sums of 1 - n g, and its gradient with
//! respect to the differences of points.
//!
//! The pixel p is seen at the point z(p) r(p). With u and v the differences of the points right and left of it, and
//! below and above it, the surface has the normal n = m / |m|, m = v x u, which faces the camera. A pixel counts if the
//! map has a normal g there and alpha is high at it and its four neighbours. With d = (n (n g) - g) / |m|, the gradient
//! of m, that of u is d x v and that of v is u x d. Reference: `src/reference/normals.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint VALUES_PER_THREAD = 8;

layout(push_constant) uniform Params {
    uvec2 size;             // pixels
    vec2  focal;            // pixels
    vec2  principal_point;  // pixels
    uint  first;            // the first value of the depth in render
};

layout(binding = 0) readonly  buffer Render         { float render[]; };          // (channels, H, W), mean depth
layout(binding = 1) readonly  buffer Transmittances { float transmittances[]; };  // (H, W)
layout(binding = 2) readonly  buffer Normals        { uint normals[]; };          // (H, W), include/map_normal.glsl
layout(binding = 3) writeonly buffer DDifferences   { vec4 d_differences[]; };    // (H, W, 2) of u and v; 0 if none
layout(binding = 4) writeonly buffer Partials       { float partials[]; };        // one per workgroup

// The largest transmittance of a pixel whose depth is that of a surface.
const float MOST_TRANSMITTANCE = 0.2;

bool is_opaque(uvec2 p) { return transmittances[p.y * size.x + p.x] <= MOST_TRANSMITTANCE; }

vec3 point(uvec2 p) { return render[first + p.y * size.x + p.x] * pixel_ray(p, focal, principal_point); }

void main() {
    uint start = WORKGROUP_INDEX * SUBGROUP_SIZE * VALUES_PER_THREAD;
    if (start >= size.x * size.y) return;
    start += gl_LocalInvocationID.x;
    const uvec2 RIGHT = uvec2(1, 0), DOWN = uvec2(0, 1);
    float sum = 0.0;
    for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        uint i = start + k * SUBGROUP_SIZE;
        if (i >= size.x * size.y) continue;
        uvec2 p = uvec2(i % size.x, i / size.x);
        vec3 d_u = vec3(0.0), d_v = vec3(0.0);
        bool is_inside = all(greaterThan(p, uvec2(0))) && all(lessThan(p + 1, size));
        if (is_inside && normals[i] != NO_NORMAL && is_opaque(p) && is_opaque(p - RIGHT) && is_opaque(p + RIGHT)
            && is_opaque(p - DOWN) && is_opaque(p + DOWN)) {
            vec3 u = point(p + RIGHT) - point(p - RIGHT), v = point(p + DOWN) - point(p - DOWN);
            vec3 m = cross(v, u), g = map_normal(normals[i]);
            float area = length(m);
            // Written so that a NaN counts and reaches the sum.
            if (!(area == 0.0)) {
                vec3 n = m / area;
                float cosine = dot(n, g);
                vec3 d = (n * cosine - g) / area;
                d_u = cross(d, v);
                d_v = cross(u, d);
                sum += 1.0 - cosine;
            }
        }
        d_differences[2 * i] = vec4(d_u, 0.0);
        d_differences[2 * i + 1] = vec4(d_v, 0.0);
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) partials[WORKGROUP_INDEX] = sum;
}
