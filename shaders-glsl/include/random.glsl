// Counter-based random numbers: each is a function of its key, without state.

// One step of PCG-RXS-M-XS as a hash (Jarzynski and Olano 2020).
uint random_bits(uint key) {
    uint state = key * 747796405u + 2891336453u;
    uint word = ((state >> ((state >> 28) + 4u)) ^ state) * 277803737u;
    return (word >> 22) ^ word;
}

// Uniform in (0, 1]: its logarithm is finite.
float random_uniform(uint key) {
    return float((random_bits(key) >> 8) + 1u) * (1.0 / 16777216.0);
}

// Three draws of the standard normal distribution (Box and Muller 1958).
vec3 random_normal3(uint key) {
    const float TAU = 6.283185307179586;
    vec2 radius = sqrt(-2.0 * log(vec2(random_uniform(key), random_uniform(key + 1u))));
    vec2 angle = TAU * vec2(random_uniform(key + 2u), random_uniform(key + 3u));
    return vec3(radius.x * cos(angle.x), radius.x * sin(angle.x), radius.y * cos(angle.y));
}
