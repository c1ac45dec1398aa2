// A pinhole camera: what a point in its view projects to, and how that changes.

// It looks along +z, x to the right and y down.
struct Camera {
    mat4x3 view_from_world;
    vec2  focal;            // pixels
    vec2  principal_point;  // pixels
    uvec2 size;             // pixels
    vec2  least_slope;      // where the Jacobian of the projection is taken at the least
    vec2  most_slope;       // and at the most: beyond, the affine approximation of a splat explodes
};

// A renderer without a near plane counts from here, in world units.
const float NEAREST = 1e-4;

// x / z and y / z, no farther than the Jacobian is taken.
vec2 clamped_slope(vec3 mean_in_view, Camera camera) {
    return clamp(mean_in_view.xy / mean_in_view.z, camera.least_slope, camera.most_slope);
}

// The rotation of a unit quaternion (w, x, y, z).
mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    );
}

// What a vector is multiplied by before its length counts, where that is too large or not finite: beyond 1e19 the squares
// of its numbers are infinite.
float finite_scale(float length) { return length < 1e18 ? 1.0 : 1e-25; }

// A quaternion of unit length; the identity where the length is not a positive number.
vec4 unit_quat(vec4 q) {
    q *= finite_scale(length(q));
    float norm = length(q);
    return norm > 1e-12 ? q / norm : vec4(1.0, 0.0, 0.0, 0.0);
}
