// Quaternions (w, x, y, z) and their rotations.

// The rotation of a unit quaternion (w, x, y, z).
mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    );
}

// A factor for a vector before its length is computed, if it is too large or not finite: beyond 1e19, squares of
// components are infinite.
float finite_scale(float length) { return length < 1e18 ? 1.0 : 1e-25; }

// A quaternion of unit length; the identity if the length is not a positive number.
vec4 unit_quat(vec4 q) {
    q *= finite_scale(length(q));
    float norm = length(q);
    return norm > 1e-12 ? q / norm : vec4(1.0, 0.0, 0.0, 0.0);
}
