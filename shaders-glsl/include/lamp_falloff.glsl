// The functions of the lamp of include/lamp.glsl: the factor on a colour, and its gradients.
//
// The kernel declares `lamp`, an array of LAMP_NUMBERS floats, before it includes this file.

struct Lamp {
    vec3  position;  // in view space, world units
    vec3  tangents;  // (x, y, 1) along the axis
    float ambient;
    float exponent;
    vec2  falloffs;
    float reference_distance;
    float slope;
    float black;
    float reach;
};

// The numbers that factor and gradient of a point have in common.
struct LampPoint {
    vec3  axis;
    vec3  towards;   // r / d
    float radius;       // |r|
    float distance;  // within its bounds
    float away;      // u
    float beam;      // the lamp's light over that on the axis at the reference distance
    float light;
};

float softplus(float x) { return max(x, 0.0) + log(1.0 + exp(-abs(x))); }

// From the array `lamp`, which the kernel declares.
Lamp load_lamp() {
    Lamp loaded;
    loaded.reference_distance = lamp[LAMP_REFERENCE_DISTANCE];
    loaded.slope = lamp[LAMP_SLOPE];
    loaded.black = lamp[LAMP_BLACK];
    loaded.reach = lamp[LAMP_REACH];
    loaded.position = LAMP_STEP * loaded.reference_distance * vec3(lamp[0], lamp[1], lamp[2]);
    loaded.tangents = vec3(LAMP_STEP * lamp[3], LAMP_STEP * lamp[4], 1.0);
    loaded.ambient = LAMP_LEAST_AMBIENT + (1.0 - LAMP_LEAST_AMBIENT) * sigmoid(lamp[LAMP_AMBIENT]);
    loaded.exponent = LAMP_LARGEST_EXPONENT * sigmoid(lamp[LAMP_EXPONENT]);
    loaded.falloffs = LAMP_FALLOFF_STEP * vec2(softplus(lamp[LAMP_FALLOFFS]), softplus(lamp[LAMP_FALLOFFS + 1]));
    return loaded;
}

LampPoint lamp_at(Lamp loaded, vec3 point) {
    LampPoint at;
    vec3 offset = point - loaded.position;
    at.radius = length(offset);
    at.distance = loaded.reference_distance * clamp(at.radius / loaded.reference_distance, LAMP_NEAREST, LAMP_FARTHEST);
    at.axis = loaded.tangents / length(loaded.tangents);
    at.towards = offset / at.distance;
    at.away = 1.0 - clamp(dot(at.towards, at.axis), -1.0, 1.0);
    float decay = loaded.exponent * log(at.distance / loaded.reference_distance);
    at.beam = exp(-decay - (loaded.falloffs.x + loaded.falloffs.y * at.away) * at.away);
    at.light = loaded.ambient + (1.0 - loaded.ambient) * at.beam;
    return at;
}

float lamp_factor(Lamp loaded, LampPoint at) { return exp(loaded.slope * log(at.light)); }

float lamp_tone(Lamp loaded, float x) {
    float bent = x / loaded.reach;
    if (loaded.reach == 0.0 || bent < 0.0) return x;
    float line = 1.0 - LAMP_LEFT + LAMP_LEFT * (bent - LAMP_KNEE);
    return loaded.reach * (bent < LAMP_KNEE ? 1.0 - exp(-bent) : line);
}

float lamp_tone_inverse(Lamp loaded, float above) {
    float share = above / loaded.reach;
    if (loaded.reach == 0.0 || share < 0.0) return above;
    float line = LAMP_KNEE + (share - (1.0 - LAMP_LEFT)) / LAMP_LEFT;
    return loaded.reach * (share < 1.0 - LAMP_LEFT ? -log(1.0 - share) : line);
}

// d tone / dx
float lamp_tone_slope(Lamp loaded, float x) {
    return loaded.reach == 0.0 || x < 0.0 ? 1.0 : exp(-min(x / loaded.reach, LAMP_KNEE));
}

// d ln light / d ln beam
float lamp_share(Lamp loaded, LampPoint at) { return (1.0 - loaded.ambient) * at.beam / at.light; }

// The steepness of the falloff: -d ln beam / du.
float lamp_turn(Lamp loaded, LampPoint at) { return loaded.falloffs.x + 2.0 * loaded.falloffs.y * at.away; }

// The gradient of ln factor with respect to the point.
vec3 lamp_point_gradient(Lamp loaded, LampPoint at) {
    if (at.radius > LAMP_FARTHEST * loaded.reference_distance) return vec3(0.0);
    float turn = lamp_turn(loaded, at);
    vec3 gradient = turn * at.axis;
    if (at.radius >= LAMP_NEAREST * loaded.reference_distance)
        gradient -= (loaded.exponent + turn * dot(at.towards, at.axis)) * at.towards;
    return loaded.slope * lamp_share(loaded, at) / at.distance * gradient;
}

// A colour in the light at a point.
vec3 lamp_lit(vec3 point, vec3 color) {
    Lamp loaded = load_lamp();
    float factor = lamp_factor(loaded, lamp_at(loaded, point));
    for (uint c = 0; c < 3; c++)
        color[c] = loaded.black + lamp_tone(loaded, factor * lamp_tone_inverse(loaded, color[c] - loaded.black));
    return color;
}

// From the gradient of a lit colour to that of the colour without the lamp; the gradient of the point is added.
void lamp_lit_backward(vec3 point, vec3 lit, inout vec3 d_color, inout vec3 d_point) {
    Lamp loaded = load_lamp();
    LampPoint at = lamp_at(loaded, point);
    float factor = lamp_factor(loaded, at), d_log_factor = 0.0;
    for (uint c = 0; c < 3; c++) {
        float x = lamp_tone_inverse(loaded, lit[c] - loaded.black), d_x = d_color[c] * lamp_tone_slope(loaded, x);
        d_log_factor += d_x * x;
        d_color[c] = d_x * factor / lamp_tone_slope(loaded, x / factor);
    }
    d_point += d_log_factor * lamp_point_gradient(loaded, at);
}

// Adds the gradient of the learned numbers, from that of the colour without the lamp, which is black + tone(x): a lit
// colour is black + tone(factor x).
void lamp_add_gradient(Lamp loaded, vec3 point, vec3 lit, vec3 d_color, inout float sums[LAMP_WIDTH]) {
    LampPoint at = lamp_at(loaded, point);
    float factor = lamp_factor(loaded, at), d_log_factor = 0.0;
    for (uint c = 0; c < 3; c++) {
        float x = lamp_tone_inverse(loaded, lit[c] - loaded.black) / factor;
        d_log_factor += d_color[c] * x * lamp_tone_slope(loaded, x);
    }
    float gradient[LAMP_WIDTH];
    float share = loaded.slope * lamp_share(loaded, at), turn = share * lamp_turn(loaded, at);
    vec3 d_position = -LAMP_STEP * loaded.reference_distance * lamp_point_gradient(loaded, at);
    vec3 d_axis = at.radius > LAMP_FARTHEST * loaded.reference_distance ? vec3(0.0) : turn * at.towards;
    vec3 d_tangents = LAMP_STEP * (d_axis - at.axis * dot(at.axis, d_axis)) / length(loaded.tangents);
    [[unroll]] for (uint k = 0; k < 3; k++) gradient[k] = d_position[k];
    [[unroll]] for (uint k = 0; k < 2; k++) gradient[3 + k] = d_tangents[k];
    float raised = sigmoid(lamp[LAMP_AMBIENT]), bent = sigmoid(lamp[LAMP_EXPONENT]);
    gradient[LAMP_AMBIENT] =
        loaded.slope * (1.0 - at.beam) / at.light * (1.0 - LAMP_LEAST_AMBIENT) * raised * (1.0 - raised);
    gradient[LAMP_EXPONENT] =
        -share * log(at.distance / loaded.reference_distance) * LAMP_LARGEST_EXPONENT * bent * (1.0 - bent);
    gradient[LAMP_FALLOFFS] = -share * at.away * LAMP_FALLOFF_STEP * sigmoid(lamp[LAMP_FALLOFFS]);
    gradient[LAMP_FALLOFFS + 1] =
        -share * at.away * at.away * LAMP_FALLOFF_STEP * sigmoid(lamp[LAMP_FALLOFFS + 1]);
    [[unroll]] for (uint n = 0; n < LAMP_WIDTH; n++) sums[n] += d_log_factor * gradient[n];
}
