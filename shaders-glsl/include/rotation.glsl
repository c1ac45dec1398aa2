// Quaternions (w, x, y, z) and the rotations that they are.

// The rotation of a unit quaternion (w, x, y, z).
mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    );
}

// What a vector is multiplied by before its length counts, where that is too large or not finite: beyond 1e19 the
// squares of its numbers are infinite.
float finite_scale(float length) { return length < 1e18 ? 1.0 : 1e-25; }

// A quaternion of unit length; the identity where the length is not a positive number.
vec4 unit_quat(vec4 q) {
    q *= finite_scale(length(q));
    float norm = length(q);
    return norm > 1e-12 ? q / norm : vec4(1.0, 0.0, 0.0, 0.0);
}
