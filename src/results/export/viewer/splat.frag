#version 300 es
// What a splat leaves on a pixel, to be blended from back to front.
precision highp float;

in vec2 fromMean;
flat in vec3 conic;
flat in vec4 color;

uniform float counts;  // 1: splats are counted, else 0

out vec4 fragment;

@CONSTANTS@

void main() {
    vec2 d = fromMean;
    float sigma = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, color.a * exp(-sigma));
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) discard;
    // Branches would cost software devices more.
    fragment = vec4(color.rgb * max(alpha, counts), alpha * (1.0 - counts));
}
