// Real spherical harmonics to degree 3, in the order and with the signs that splat viewers use. The viewer of exported
// pages includes this file, too: it is also valid GLSL ES 3.00.

#ifdef GL_ES
#define PRECISE_OUT out
#else
#define PRECISE_OUT precise out
#endif

const uint MAX_SH_DEGREE = 3u;
const uint MAX_COEFFICIENTS = 16u;

const float SH_C0 = 0.28209479177387814;  // 1 / (2 sqrt(pi)): the constant basis function
const float SH_C1 = 0.4886025119029199;
const float SH_C2[5] = float[](
    1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396
);
const float SH_C3[7] = float[](
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435
);

uint sh_count(uint degree) { return (degree + 1u) * (degree + 1u); }

// The basis in the unit direction d; entries above `degree` are zero. `precise`: every kernel computes the same bits.
void sh_basis(uint degree, vec3 d, PRECISE_OUT float basis[16]) {
    for (uint k = 0u; k < 16u; k++) basis[k] = 0.0;
    float x = d.x, y = d.y, z = d.z;
    basis[0] = SH_C0;
    if (degree > 0u) {
        basis[1] = -SH_C1 * y;
        basis[2] = SH_C1 * z;
        basis[3] = -SH_C1 * x;
    }
    if (degree > 1u) {
        basis[4] = SH_C2[0] * x * y;
        basis[5] = SH_C2[1] * y * z;
        basis[6] = SH_C2[2] * (2.0 * z * z - x * x - y * y);
        basis[7] = SH_C2[3] * x * z;
        basis[8] = SH_C2[4] * (x * x - y * y);
    }
    if (degree > 2u) {
        basis[9]  = SH_C3[0] * y * (3.0 * x * x - y * y);
        basis[10] = SH_C3[1] * x * y * z;
        basis[11] = SH_C3[2] * y * (4.0 * z * z - x * x - y * y);
        basis[12] = SH_C3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
        basis[13] = SH_C3[4] * x * (4.0 * z * z - x * x - y * y);
        basis[14] = SH_C3[5] * z * (x * x - y * y);
        basis[15] = SH_C3[6] * x * (x * x - 3.0 * y * y);
    }
}

// The derivative of the basis with respect to x, y, z of the direction.
void sh_basis_gradient(uint degree, vec3 d, out vec3 gradient[16]) {
    for (uint k = 0u; k < 16u; k++) gradient[k] = vec3(0.0);
    float x = d.x, y = d.y, z = d.z;
    if (degree > 0u) {
        gradient[1] = vec3(0.0, -SH_C1, 0.0);
        gradient[2] = vec3(0.0, 0.0, SH_C1);
        gradient[3] = vec3(-SH_C1, 0.0, 0.0);
    }
    if (degree > 1u) {
        gradient[4] = SH_C2[0] * vec3(y, x, 0.0);
        gradient[5] = SH_C2[1] * vec3(0.0, z, y);
        gradient[6] = SH_C2[2] * vec3(-2.0 * x, -2.0 * y, 4.0 * z);
        gradient[7] = SH_C2[3] * vec3(z, 0.0, x);
        gradient[8] = SH_C2[4] * vec3(2.0 * x, -2.0 * y, 0.0);
    }
    if (degree > 2u) {
        gradient[9]  = SH_C3[0] * vec3(6.0 * x * y, 3.0 * (x * x - y * y), 0.0);
        gradient[10] = SH_C3[1] * vec3(y * z, x * z, x * y);
        gradient[11] = SH_C3[2] * vec3(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z);
        gradient[12] = SH_C3[3] * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * (x * x + y * y));
        gradient[13] = SH_C3[4] * vec3(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z);
        gradient[14] = SH_C3[5] * vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y);
        gradient[15] = SH_C3[6] * vec3(3.0 * (x * x - y * y), -6.0 * x * y, 0.0);
    }
}
