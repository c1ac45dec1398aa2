// One Gaussian after projection onto the image plane, and its coverage of pixels. Kerbl et al. 2023, section 4; the
// exact tile rows follow from the ellipse alpha = 1/255.

// A splat of lower alpha does not contribute to a pixel.
const float ALPHA_MIN = 1.0 / 255.0;
// A pixel is done before its transmittance falls to this.
const float TRANSMITTANCE_MIN = 1e-4;
// Added to both diagonal entries of cov2d, in pixels^2: a splat covers at least about a pixel.
const float DILATION = 0.3;

// The largest alpha: keeps 1 / (1 - alpha) finite in the backward pass.
layout(constant_id = 1) const float ALPHA_MAX = 0.99;
// The most values per pixel.
const uint MAX_CHANNELS = 11;
// Values per pixel: RGB first.
layout(constant_id = 2) const uint CHANNELS = 3;
// Values of a gradient record before its channels: the moments 1, x, y, xx, xy, yy of dL/dsigma over the pixels, with
// offsets from pixel to mean, of which the gradients of mean2d, conic and opacity are multiples, and the sum of its
// magnitudes.
const uint RECORD_HEAD = 7;
const uint RECORD = RECORD_HEAD + CHANNELS;
// The vectors of four floats of a record and of a splat's values, filled up with zeros: a device loads sixteen bytes at
// once.
const uint RECORD_VECTORS = (RECORD + 3) / 4;
const uint COLOR_VECTORS = (CHANNELS + 3) / 4;
// In pixels; a subgroup owns at most 32 rows of lanes.
layout(constant_id = 3) const uint TILE_WIDTH = 16;
layout(constant_id = 4) const uint TILE_HEIGHT = 16;

// In memory, each half has sixteen bytes.
struct ProjectedSplat {
    vec2  mean2d;       // pixels
    vec2  half_extent;  // pixels: the box around the ellipse alpha = 1/255, slightly enlarged
    vec3  conic;        // upper triangle (xx, xy, yy) of the inverse cov2d, 1 / pixels^2
    float opacity;      // after the sigmoid
};

// The exponent of alpha to base 2 before its cap, log2(opacity) - sigma log2(e), where sigma = (conic.x x x + conic.z y
// y) / 2 + conic.y x y: the coefficients of its quadratic form.
vec3 exponent_form(vec3 conic) {
    const float LOG2_E = 1.44269504;
    precise vec3 form = vec3(-0.5, -1.0, -0.5) * LOG2_E * conic;
    return form;
}

// The exponent along a column of pixels that is `x` from the mean: the coefficients of a polynomial in y. `peak` is the
// exponent at the mean.
vec3 exponent_in_column(vec3 form, float peak, float x) {
    precise vec3 by_power = vec3(fma(form.x * x, x, peak), form.y * x, form.z);
    return by_power;
}

// The exponent at `y` from the mean. Both passes round it alike, and so blend the same splats.
float exponent_at(vec3 by_power, float y) {
    precise float exponent = fma(fma(by_power.z, y, by_power.y), y, by_power.x);
    return exponent;
}

// The alpha that is blended: zero above the peak, as rounding puts it, below ALPHA_MIN and where anything is NaN. A
// choice between computed values: the lanes never part.
float visible_alpha(float exponent, float peak, float free_alpha) {
    const float LEAST_EXPONENT = -7.99435344;  // log2(ALPHA_MIN)
    float alpha = min(ALPHA_MAX, free_alpha);
    bool counts = all(bvec2(exponent <= peak, exponent >= LEAST_EXPONENT));
    return counts ? alpha : 0.0;
}

// The transmittance behind a splat. Both passes round it alike, and so end a pixel at the same splat.
float transmittance_after(float before, float alpha) {
    precise float after = fma(-alpha, before, before);
    return after;
}

// Twice the sigma at which alpha falls to 1/255, slightly enlarged so that rounding never loses a pixel.
float splat_level(float opacity) {
    precise float level = 2.002 * log(255.0 * opacity) + 1e-3;
    return level;
}

// The columns of pixels [first, last] whose centres are in the ellipse somewhere between the pixel rows `top` and
// `bottom`; empty if last < first. No term cancels: the half width at height y is sqrt(level / conic.xx) sqrt(1 - (y /
// half_extent.y)^2) about the shear line -conic.xy / conic.xx y.
ivec2 splat_columns(ProjectedSplat splat, float top, float bottom) {
    precise float y0 = top + 0.5 - splat.mean2d.y;
    precise float y1 = bottom + 0.5 - splat.mean2d.y;
    vec2 extent = splat.half_extent;
    // Written so that a NaN covers nothing.
    if (!(y0 <= extent.y && y1 >= -extent.y)) return ivec2(1, 0);
    precise float shear = -splat.conic.y / splat.conic.x;
    precise float rightmost = -splat.conic.y / splat.conic.z * extent.x;
    precise float y_right = clamp(rightmost, y0, y1);
    precise float y_left = clamp(-rightmost, y0, y1);
    precise float width = sqrt(splat_level(splat.opacity) / splat.conic.x);
    precise float right = y_right / extent.y;
    precise float left = y_left / extent.y;
    right = splat.mean2d.x + shear * y_right + width * sqrt(max(0.0, 1.0 - right * right)) + 0.01;
    left = splat.mean2d.x + shear * y_left - width * sqrt(max(0.0, 1.0 - left * left)) - 0.01;
    // Beyond any image; keeps the conversion to integers defined.
    left = clamp(left, -1e6, 1e6);
    right = clamp(right, -1e6, 1e6);
    return ivec2(int(ceil(left - 0.5)), int(floor(right - 0.5)));
}

// The tile columns [x, y) that the splat intersects in a row of tiles of an image `width` pixels wide.
uvec2 splat_tiles(ProjectedSplat splat, uint tile_row, uint width) {
    float top = float(tile_row * TILE_HEIGHT);
    ivec2 columns = splat_columns(splat, top, top + float(TILE_HEIGHT - 1));
    columns = ivec2(max(columns.x, 0), min(columns.y, int(width) - 1));
    if (columns.y < columns.x) return uvec2(0);
    return uvec2(uint(columns.x) / TILE_WIDTH, uint(columns.y) / TILE_WIDTH + 1);
}

// The rows of tiles [x, y) that the splat's box intersects in an image `height` pixels high.
uvec2 splat_tile_rows(ProjectedSplat splat, uint height) {
    float top = clamp(splat.mean2d.y - splat.half_extent.y, 0.0, float(height));
    float bottom = clamp(splat.mean2d.y + splat.half_extent.y, 0.0, float(height));
    return uvec2(uint(top) / TILE_HEIGHT, (uint(ceil(bottom)) + TILE_HEIGHT - 1) / TILE_HEIGHT);
}
