// A camera: the projection of a point, and its derivatives.
//
// Every model has the same functions in a file of its own; those at the end of this file select one. A kernel is
// specialised for one model, or defines CAMERA_MODEL as `camera.model` to select at run time. In view space, x points
// right, y down and z forward, in world units.

const uint CAMERA_PINHOLE = 0;
const uint CAMERA_FISHEYE = 1;
const uint CAMERA_ORTHOGRAPHIC = 2;

// Selected at run time are the cameras of training views, none of which is orthographic.
#ifdef CAMERA_MODEL
#define IS_ORTHOGRAPHIC false
#else
layout(constant_id = 7) const uint CAMERA_MODEL = 0;  // CAMERA_*
#define IS_ORTHOGRAPHIC (CAMERA_MODEL == CAMERA_ORTHOGRAPHIC)
#endif

struct Camera {
    mat4x3 view_from_world;
    vec2  focal;            // pixels; orthographic: pixels per world unit
    vec2  principal_point;  // pixels
    uvec2 size;             // pixels
    vec2  min_slope;      // pinhole: the smallest x / z and y / z for the Jacobian
    vec2  max_slope;       // and the largest: beyond, the affine approximation of a splat diverges
    vec4  distortion;       // fisheye: coefficients of the angle's powers 3, 5, 7 and 9
    float largest_angle;    // fisheye: angles off the axis from this one on are not seen, radians
    uint  model;            // CAMERA_*
};

// The derivative of a pixel's two coordinates with respect to the point: scale.x * row0 and scale.y * row1.
struct Jacobian {
    vec2 scale;
    vec3 row0;
    vec3 row1;
};

// The near plane of a renderer without one, in world units.
const float NEAREST = 1e-4;

#include "camera_pinhole.glsl"
#include "camera_fisheye.glsl"
#include "camera_orthographic.glsl"

// The depth of a point, for sorting and the near plane; not positive if the model does not see it.
float camera_depth(vec3 point, Camera camera) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_depth(point, camera);
    return pinhole_depth(point);
}

// The pixel of a point of positive depth.
vec2 camera_project(vec3 point, Camera camera) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_project(point, camera);
    if (IS_ORTHOGRAPHIC) return orthographic_project(point, camera);
    return pinhole_project(point, camera);
}

// The derivative of the pixel with respect to the point.
Jacobian camera_jacobian(vec3 point, Camera camera) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_jacobian(point, camera);
    if (IS_ORTHOGRAPHIC) return orthographic_jacobian(camera);
    return pinhole_jacobian(point, camera);
}

// The gradient of the point, from those of its pixel and of the Jacobian's rows, scaled.
vec3 camera_backward(vec3 point, Camera camera, vec2 d_pixel, vec3 d_row0, vec3 d_row1) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_backward(point, camera, d_pixel, d_row0, d_row1);
    return pinhole_backward(point, camera, d_pixel, d_row0, d_row1);
}

// The first-order change of depth between a point and another at an offset.
float camera_depth_change(vec3 point, vec3 offset, Camera camera) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_depth_change(point, offset);
    return pinhole_depth_change(offset);
}

// The point moved to another depth.
vec3 camera_at_depth(vec3 point, float depth, Camera camera) {
    if (CAMERA_MODEL == CAMERA_FISHEYE) return fisheye_at_depth(point, depth);
    return pinhole_at_depth(point, depth);
}
