// From the gradient of a splat's conic to those of U = J W R S, where cov2d = U U^T + 0.3 I and conic is its inverse.

struct ConicGradient {
    vec3 u0;  // of U's rows
    vec3 u1;
    vec3 log_scale;
};

ConicGradient conic_backward(vec3 conic, vec3 u0, vec3 u1, vec3 d_conic) {
    // In conic U the large terms cancel, for a needle all of them; the closed form is (U1 x N, N x U0) with N = U0 x
    // U1.
    float a = conic.x, b = conic.y, c = conic.z;
    vec3 normal = cross(u0, u1);
    float det = dot(normal, normal) + DILATION * (dot(u0, u0) + dot(u1, u1)) + DILATION * DILATION;
    vec3 w0 = (cross(u1, normal) + DILATION * u0) / det;  // rows of conic U
    vec3 w1 = (cross(normal, u0) + DILATION * u1) / det;
    vec3 g0 = d_conic.x * w0 + 0.5 * d_conic.y * w1;
    vec3 g1 = 0.5 * d_conic.y * w0 + d_conic.z * w1;
    return ConicGradient(-2.0 * (a * g0 + b * g1), -2.0 * (b * g0 + c * g1), -2.0 * (w0 * g0 + w1 * g1));
}
