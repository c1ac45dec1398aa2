#version 300 es
// What a splat leaves on a pixel, to be blended from back to front.
precision highp float;

in vec2 fromMean;
flat in vec3 conic;
flat in vec4 color;

out vec4 fragment;

@CONSTANTS@

void main() {
    vec2 d = fromMean;
    float sigma = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, color.a * exp(-sigma));
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) discard;
    fragment = vec4(color.rgb * alpha, alpha);
}
