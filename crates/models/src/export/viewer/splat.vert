#version 300 es
// One corner of a splat: the projection of the kernels (EWA), with their constants and harmonics, on textures of three
// and of (degree + 1)^2 texels a Gaussian.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D geometry;  // mean and opacity; covariance xx xy xz yy; yz zz, coverage
uniform sampler2D harmonics; // coefficients, RGB
uniform mat4 viewFromWorld;
uniform vec3 eye;
uniform vec2 focal, principalPoint, size;  // pixels of the view
uniform vec2 offset, scale;                // pixels of the view to clip space
uniform float near;
uniform vec2 fog;  // how much hides what no photograph shows, and what is nearer than a depth
uniform uint degree;  // of the harmonics
uniform bool isLit;   // by a lamp at the camera
uniform vec3 lampPosition, lampAxis;  // in the view
uniform vec2 lampFalloffs;
uniform vec4 lampLight;  // ambient, exponent, reference distance, slope of the tone curve
uniform vec2 lampTones;  // the target of no light; the reach of the tone curve

in vec2 corner;
in uint id;

out vec2 fromMean;  // pixels
flat out vec3 conic;
flat out vec4 color;
flat out float depth;

@CONSTANTS@
@HARMONICS@

vec4 texel(sampler2D plane, int index) {
    int width = textureSize(plane, 0).x;
    return texelFetch(plane, ivec2(index % width, index / width), 0);
}

vec3 shaded(int first, vec3 direction) {
    float basis[16];
    sh_basis(degree, direction, basis);
    vec3 sum = vec3(0.5);
    for (uint k = 0u; k < sh_count(degree); k++) sum += basis[k] * texel(harmonics, first + int(k)).rgb;
    return sum;
}

// The law of include/lamp.glsl at a point in the view.
float lampFactor(vec3 point) {
    vec3 offset = (point - lampPosition) / lampLight.z;
    float d = clamp(length(offset), LAMP_NEAREST, LAMP_FARTHEST);
    float away = 1.0 - clamp(dot(offset / d, lampAxis), -1.0, 1.0);
    float beam = exp(-lampLight.y * log(d) - (lampFalloffs.x + lampFalloffs.y * away) * away);
    return pow(lampLight.x + (1.0 - lampLight.x) * beam, lampLight.w);
}

float lampTone(float x) {
    float reach = lampTones.y, bent = x / reach;
    if (reach == 0.0 || bent < 0.0) return x;
    return reach * (bent < LAMP_KNEE ? 1.0 - exp(-bent) : 1.0 - LAMP_LEFT + LAMP_LEFT * (bent - LAMP_KNEE));
}

float lampToneInverse(float above) {
    float reach = lampTones.y, part = above / reach;
    if (reach == 0.0 || part < 0.0) return above;
    return reach * (part < 1.0 - LAMP_LEFT ? -log(1.0 - part) : LAMP_KNEE + (part - (1.0 - LAMP_LEFT)) / LAMP_LEFT);
}

vec3 lit(vec3 rgb, float factor) {
    for (int c = 0; c < 3; c++) rgb[c] = lampTones.x + lampTone(factor * lampToneInverse(rgb[c] - lampTones.x));
    return rgb;
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, unless it is seen
    int i = int(id);
    vec4 a = texel(geometry, 3 * i), b = texel(geometry, 3 * i + 1), c = texel(geometry, 3 * i + 2);
    vec3 mean = (viewFromWorld * vec4(a.xyz, 1.0)).xyz;
    if (!(mean.z > near && a.w > ALPHA_MIN)) return;

    vec2 margin = JACOBIAN_MARGIN * size;
    vec2 slope = clamp(mean.xy / mean.z, -(principalPoint + margin) / focal, (size - principalPoint + margin) / focal);
    mat3 covariance = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
    mat3 turn = mat3(viewFromWorld);
    vec3 u = transpose(turn) * vec3(1.0, 0.0, -slope.x) * (focal.x / mean.z);
    vec3 v = transpose(turn) * vec3(0.0, 1.0, -slope.y) * (focal.y / mean.z);
    float xx = dot(u, covariance * u) + DILATION, xy = dot(u, covariance * v), yy = dot(v, covariance * v) + DILATION;
    float determinant = xx * yy - xy * xy;
    if (!(determinant > 0.0)) return;
    float opacity = a.w * mix(1.0, c.z * smoothstep(near, near + max(fog.y, 1e-4), mean.z), fog.x);
    if (ANTIALIASED) {
        float undilated = determinant - DILATION * (xx + yy) + DILATION * DILATION;
        opacity *= sqrt(max(undilated, 0.0) / determinant);
    }
    if (!(opacity > ALPHA_MIN)) return;
    conic = vec3(yy, -xy, xx) / determinant;

    vec2 reach = sqrt(2.0 * log(opacity / ALPHA_MIN) * vec2(xx, yy)) + 0.5;
    fromMean = corner * reach;
    vec2 pixel = focal * mean.xy / mean.z + principalPoint + fromMean;
    depth = mean.z;
    vec3 rgb = shaded(int(sh_count(degree)) * i, normalize(a.xyz - eye));
    if (isLit) rgb = lit(rgb, lampFactor(mean));
    color = vec4(max(rgb, vec3(0.0)), opacity);
    gl_Position = vec4((pixel + offset) * scale + vec2(-1.0, 1.0), 0.0, 1.0);
}
