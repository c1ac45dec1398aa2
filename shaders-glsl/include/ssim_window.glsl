// SSIM of a pixel, and its window (Wang et al. 2004, the window of 3DGS): 11 x 11 Gaussian, sigma 1.5, zero padding.
//
// The includer has the parameters `loss_begin` and `loss_end`.

const float C1 = 0.0001;  // (0.01 L)^2, L = 1
const float C2 = 0.0009;  // (0.03 L)^2

const int RADIUS = 5;             // of the window, pixels
const uint PENDING = 2 * RADIUS;  // rows of outputs in reach, other than the completed one

// exp(-d^2 / (2 sigma^2)) / sum for d = 0..RADIUS.
const float TAPS[RADIUS + 1] =
    float[](0.2660117248617943, 0.21300553771125366, 0.1093606895097, 0.03600077212843082, 0.007598758135239184,
        0.0010283800844791099);

// Whether a pixel is in the loss region, which may be the whole view.
bool is_inside(uint x, uint y) {
    return x >= loss_begin.x && x < loss_end.x && y >= loss_begin.y && y < loss_end.y;
}

// S at one pixel from the blurred a, b, a^2 + b^2 and ab, and its derivatives with respect to E[a], E[aa] and E[ab].
float ssim(vec4 moments, out vec3 d_moments) {
    float a = moments.x, b = moments.y;
    float a1 = 2.0 * a * b + C1;
    float a2 = 2.0 * (moments.w - a * b) + C2;
    float b1 = a * a + b * b + C1;
    // Variances are not negative: only cancellation of large bright values reaches the floor.
    float b2 = max(moments.z - (a * a + b * b), 0.0) + C2;
    float scale = 1.0 / (b1 * b2);
    float s = a1 * a2 * scale;
    d_moments = vec3(2.0 * (b * (a2 - a1) * scale - a * s * (1.0 / b1 - 1.0 / b2)), -s / b2, 2.0 * a1 * scale);
    return s;
}

// The derivative of the SSIM term with respect to a value, from the blurred derivatives.
float d_ssim(float a, float b, vec3 d) {
    // A value outside all windows has no gradient, even if it is NaN.
    return d.x + (d.y == 0.0 ? 0.0 : 2.0 * a * d.y) + b * d.z;
}
