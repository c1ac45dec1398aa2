#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "camera.glsl"
#include "rotation.glsl"
#include "sh.glsl"
#include "splat.glsl"
#include "lamp.glsl"
#include "instance.glsl"

//! Project: one thread per Gaussian, world space to image plane.
//!
//! EWA: cov2d = U U^T + 0.3 I with U = J W R S, where J is the camera's Jacobian at the mean, so it is positive
//! definite by construction, and its determinant is |U0 x U1|^2 + 0.3 trace(U U^T) + 0.09, which cannot cancel.
//! Compensation multiplies the opacity by the square root of det(U U^T) / det(cov2d), so that dilation does not add
//! light (Yu et al. 2024, Mip-Splatting, section 5.2). Colour is max(SH + 0.5, 0), what every viewer shows, or the
//! bare SH sum of LITA-GS, in the light of the lamp (include/lamp.glsl) before it is clamped; features are taken as
//! they are. The last channel can be the depth in the view. A culled
//! Gaussian gets the last depth key and covers no tile.
//!
//! With INSTANCES, the Gaussians are projected once for each of several instances of their model: a dispatch has the
//! workgroups of the first instance, then those of the next, and each has whole workgroups of splats, the last of which
//! may be culled for want of a Gaussian. The direction that SH are evaluated in is the model's.
//!
//! With SHARES_SORT, several views have one order, by the depth along an axis that they share, of all Gaussians, for
//! another view may show what this one does not. The first view writes it, the others keep it.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uint  camera_index;
    float near;       // near plane, world units
    uint  gaussian_count;
    uint  sh_degree;  // in use; at most SH_DEGREE
    uint  first_gaussian;  // Gaussians before those of this dispatch
    uint  first_instance;  // with INSTANCES
    uint  instance_count;
    uint  first_splat;     // that is bound
    uint  keeps_order;     // with SHARES_SORT, 1: keys and ids stay
    vec4  sort_axis;       // with SHARES_SORT: depth of (point in the view, 1)
};

layout(constant_id = 0) const uint SH_DEGREE = 3;  // stored
layout(constant_id = 5) const bool RAW_COLORS = false;
layout(constant_id = 6) const bool HALF_REST = false;  // SH above degree 0 in the format of include/half.glsl
layout(constant_id = 14) const bool ANTIALIASED = false;  // opacities are compensated for the dilation
layout(constant_id = 16) const bool LAMP = false;  // colours are lit by a lamp at the camera
layout(constant_id = 17) const bool INSTANCES = false;
layout(constant_id = 18) const bool SHARES_SORT = false;

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };    // planes
layout(binding = 1) writeonly buffer Splats     { ProjectedSplat splats[]; };
layout(binding = 2) writeonly buffer Colors { vec4 colors[]; };  // (gaussian_count, COLOR_VECTORS): CHANNELS, zeros
layout(binding = 3) writeonly buffer DepthKeys  { uint depth_keys[]; };
layout(binding = 4) writeonly buffer Ids        { uint ids[]; };
layout(binding = 5) writeonly buffer TileCounts { uint tile_counts[]; };
layout(binding = 6) readonly  buffer Cameras    { Camera cameras[]; };
layout(binding = 7) readonly  buffer LampNumbers { float lamp[]; };  // (LAMP_NUMBERS), read with LAMP
layout(binding = 8) readonly  buffer Instances  { InstanceView instances[]; };  // read with INSTANCES

// A depth key is how many sixteenfold roundings the depth is beyond `near`: 2e-6 of the depth each, over 32 octaves.
const uint DEPTH_BITS = 24;
const uint CULLED = (1u << DEPTH_BITS) - 1;  // the depth key of what is not seen: it sorts last
layout(constant_id = 11) const uint VIEW_DEPTHS = 0;  // 1: the last channel is the depth, not a feature
const uint FEATURE_COUNT = CHANNELS - 3 - VIEW_DEPTHS;

#include "rest.glsl"
#include "lamp_falloff.glsl"

// Depth is positive, so its bits sort like its value.
uint depth_key(float depth) {
    float nearest = max(near, NEAREST);
    uint beyond = floatBitsToUint(max(depth, nearest)) - floatBitsToUint(nearest);
    return min(beyond >> 4, CULLED - 1);
}

vec3 sh_color(uint i, vec3 direction) {
    float basis[16];
    sh_basis(sh_degree, direction, basis);
    vec3 color = basis[0] * LOAD_VEC3(parameters, DC_COLUMN, gaussian_count, i);
    // With constant bounds, the basis is in registers and the loads are issued together.
    [[unroll]] for (uint k = 1; k < MAX_COEFFICIENTS; k++) {
        if (k < sh_count(SH_DEGREE) && k < sh_count(sh_degree)) color += basis[k] * rest_coefficient(i, k);
    }
    if (RAW_COLORS) return color;
    return color + 0.5;
}

vec3 shown(vec3 color) {
    if (RAW_COLORS) return color;
    return max(color, vec3(0.0));
}

void main() {
    uint i = THREAD_INDEX, instance = 0;
    if (INSTANCES) {
        uint groups = (gaussian_count + gl_WorkGroupSize.x - 1) / gl_WorkGroupSize.x;
        instance = WORKGROUP_INDEX / groups;
        if (instance >= instance_count) return;
        i -= gl_WorkGroupSize.x * groups * instance;
        instance += first_instance;
    } else if (i >= gaussian_count) {
        return;
    }
    uint slot = i, first = first_gaussian;  // of the splats
    if (INSTANCES) {
        slot += instances[instance].first + first_gaussian - first_splat;
        first = first_splat;
    }
    bool orders = true;
    if (SHARES_SORT) orders = keeps_order == 0;
    if (orders) {
        ids[slot] = first + slot;
        depth_keys[slot] = CULLED;
    }
    tile_counts[slot] = 0;
    if (INSTANCES) {
        if (i >= gaussian_count) return;
    }

    Camera camera = cameras[camera_index];
    mat4x3 view = camera.view_from_world;
    if (INSTANCES) view = instances[instance].view_from_model;
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 mean_in_view = view * vec4(mean, 1.0);
    if (SHARES_SORT) {
        if (orders) depth_keys[slot] = depth_key(dot(sort_axis, vec4(mean_in_view, 1.0)));
    }
    float opacity = sigmoid(parameters[RAW_OPACITIES_COLUMN * gaussian_count + i]);
    if (INSTANCES) {
        opacity *= instances[instance].tint.a;
        bvec3 is_above = greaterThanEqual(mean, instances[instance].box_min);
        bvec3 is_below = lessThanEqual(mean, instances[instance].box_max);
        if (!(all(is_above) && all(is_below))) return;
    }
    float depth = camera_depth(mean_in_view, camera);
    // Positive phrasing: a NaN depth or opacity fails the test too.
    if (!(depth > near && opacity > ALPHA_MIN)) return;

    mat3 world_axes = rotation(unit_quat(LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i)));
    vec3 scale = exp(LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i));
    mat3 view_axes = mat3(view) * world_axes;
    for (uint k = 0; k < 3; k++) view_axes[k] *= scale[k];
    mat3 rows = transpose(view_axes);  // row k of W R S as rows[.][k]
    Jacobian jacobian = camera_jacobian(mean_in_view, camera);
    vec3 u0 = jacobian.scale.x * (rows * jacobian.row0);
    vec3 u1 = jacobian.scale.y * (rows * jacobian.row1);

    float xx = dot(u0, u0), xy = dot(u0, u1), yy = dot(u1, u1);
    vec3 normal = cross(u0, u1);
    float det = dot(normal, normal) + DILATION * (xx + yy) + DILATION * DILATION;
    vec3 cov2d = vec3(xx + DILATION, xy, yy + DILATION);
    vec2 mean2d = camera_project(mean_in_view, camera);
    // Positive phrasing: an overflow or a NaN is culled.
    if (!(det < 1e30 && all(lessThan(abs(mean2d), vec2(1e30))))) return;
    if (ANTIALIASED) {
        opacity *= sqrt(dot(normal, normal) / det);
        if (!(opacity > ALPHA_MIN)) return;
    }

    ProjectedSplat splat;
    splat.mean2d = mean2d;
    splat.conic = vec3(cov2d.z, -cov2d.y, cov2d.x) / det;
    splat.opacity = opacity;
    splat.half_extent = sqrt(splat_level(opacity) * cov2d.xz) + 0.01;
    splats[slot] = splat;

    vec3 center = -transpose(mat3(view)) * view[3];
    if (INSTANCES) center = instances[instance].camera_center;
    vec3 offset = mean - center;
    if (IS_ORTHOGRAPHIC) offset = transpose(mat3(view))[2];
    vec3 rgb = sh_color(i, normalize(offset * finite_scale(length(offset))));
    if (LAMP) rgb = lamp_lit(mean_in_view, rgb);
    rgb = shown(rgb);
    if (INSTANCES) rgb *= instances[instance].tint.rgb;
    uint features = FEATURES_COLUMN * gaussian_count + FEATURE_COUNT * i;
    [[unroll]] for (uint k = 0; k < COLOR_VECTORS; k++) {
        vec4 four = vec4(0);
        [[unroll]] for (uint c = 0; c < 4; c++) {
            uint channel = 4 * k + c;
            if (channel < 3) four[c] = rgb[c];
            else if (channel < 3 + FEATURE_COUNT) four[c] = parameters[features + channel - 3];
            else if (VIEW_DEPTHS != 0 && channel == 3 + FEATURE_COUNT) four[c] = depth;
        }
        colors[COLOR_VECTORS * slot + k] = four;
    }

    uint count = 0;
    uvec2 tile_rows = splat_tile_rows(splat, camera.size.y);
    for (uint row = tile_rows.x; row < tile_rows.y; row++) {
        uvec2 columns = splat_tiles(splat, row, camera.size.x);
        count += columns.y - columns.x;
    }
    tile_counts[slot] = count;
    if (SHARES_SORT) return;
    if (count > 0) depth_keys[slot] = depth_key(depth);
}
