// A pinhole camera: what a point in its view projects to, and how that changes.

// The Jacobian of the projection is taken no farther outside the image than this fraction of its width and height:
// beyond, the affine approximation of a splat explodes.
const float JACOBIAN_MARGIN = 0.15;

// x / z and y / z, clamped to the image and its margin.
vec2 clamped_slope(vec3 mean_in_view, vec2 focal, vec2 principal_point, uvec2 size) {
    vec2 margin = JACOBIAN_MARGIN * vec2(size);
    vec2 low = -(principal_point + margin) / focal;
    vec2 high = (vec2(size) - principal_point + margin) / focal;
    return clamp(mean_in_view.xy / mean_in_view.z, low, high);
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

// A quaternion of unit length; the identity where the length is not a positive number.
vec4 unit_quat(vec4 q) {
    float norm = length(q);
    return norm > 1e-12 ? q / norm : vec4(1.0, 0.0, 0.0, 0.0);
}
