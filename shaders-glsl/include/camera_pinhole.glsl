// The pinhole: focal * (x / z, y / z) + principal point. Included by camera.glsl.

// The Jacobian is evaluated at most this fraction of width and height outside the view.
const float JACOBIAN_MARGIN = 0.15;

float pinhole_depth(vec3 point) { return point.z; }

vec2 pinhole_project(vec3 point, Camera camera) {
    return camera.focal * point.xy / point.z + camera.principal_point;
}

// x / z and y / z, clamped to the range of the Jacobian.
vec2 clamped_slope(vec3 point, Camera camera) {
    return clamp(point.xy / point.z, camera.min_slope, camera.max_slope);
}

Jacobian pinhole_jacobian(vec3 point, Camera camera) {
    vec2 slope = clamped_slope(point, camera);
    return Jacobian(camera.focal / point.z, vec3(1.0, 0.0, -slope.x), vec3(0.0, 1.0, -slope.y));
}

// A clamped slope has no gradient.
vec3 pinhole_backward(vec3 point, Camera camera, vec2 d_pixel, vec3 d_row0, vec3 d_row1) {
    float z = point.z;
    vec2 free_slope = point.xy / z;
    vec2 slope = clamped_slope(point, camera);
    vec2 d_slope = -camera.focal / z * vec2(d_row0.z, d_row1.z);
    bvec2 is_free = equal(free_slope, slope);
    vec2 d_xy = camera.focal * d_pixel / z + mix(vec2(0.0), d_slope / z, is_free);
    float d_z = -(camera.focal.x * (d_row0.x - slope.x * d_row0.z)
        + camera.focal.y * (d_row1.y - slope.y * d_row1.z)) / (z * z)
        - dot(d_xy, free_slope);
    return vec3(d_xy, d_z);
}

float pinhole_depth_change(vec3 offset) { return offset.z; }

vec3 pinhole_at_depth(vec3 point, float depth) { return vec3(point.xy, depth); }
