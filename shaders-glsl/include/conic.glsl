// From the gradients of a splat's conic and compensation to those of U = J W R S, where cov2d = U U^T + 0.3 I and conic
// is its inverse.

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

// The gradient of the logarithm of the compensation, sqrt(det(U U^T) / det(cov2d)). The large terms of both
// determinants are cancelled by hand: of a wide splat only rounding would be left. A seen splat's det(U U^T) is not
// tiny.
ConicGradient compensation_backward(vec3 u0, vec3 u1) {
    float xx = dot(u0, u0), xy = dot(u0, u1), yy = dot(u1, u1);
    vec3 normal = cross(u0, u1);
    float area_squared = dot(normal, normal);
    float det = area_squared + DILATION * (xx + yy) + DILATION * DILATION;
    float shared_term = DILATION * (xy / area_squared) * ((xx + yy + DILATION) / det);
    float own0 = DILATION * ((yy / area_squared) * ((yy + DILATION) / det) + (xy / area_squared) * (xy / det));
    float own1 = DILATION * ((xx / area_squared) * ((xx + DILATION) / det) + (xy / area_squared) * (xy / det));
    vec3 d_u0 = own0 * u0 - shared_term * u1;
    vec3 d_u1 = own1 * u1 - shared_term * u0;
    return ConicGradient(d_u0, d_u1, u0 * d_u0 + u1 * d_u1);
}
