#version 300 es
// What a splat leaves on a pixel, to be blended from back to front.
precision highp float;

in vec2 fromMean;
flat in vec3 conic;
flat in vec4 color;
flat in float depth;

uniform int layer;  // 0: colours, 1: depths, 2: alphas, 3: numbers

out vec4 fragment;

@CONSTANTS@

void main() {
    vec2 d = fromMean;
    float sigma = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, color.a * exp(-sigma));
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) discard;
    if (layer == 3) fragment = vec4(1.0, 0.0, 0.0, 0.0);
    else fragment = vec4((layer == 1 ? vec3(depth) : color.rgb) * alpha, alpha);
}
