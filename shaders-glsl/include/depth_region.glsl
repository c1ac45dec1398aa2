// Intermediate results of the depth loss: moments of chunks of a region, then the gradient over the region.

// Of the rendered depth a and the estimated depth b, relative to the region's first pixel.
struct DepthMoments {
    vec2 mean;      // of a, b
    vec3 products;  // sums of aa, ab, bb about the means
};

// dP/da = a_scale (a - mean of a) + b_scale (b - mean of b).
struct DepthGradient {
    vec2 mean;
    float a_scale;
    float b_scale;
};
