// A normal of a normal map, in the view: x right, y down, z forward.

// Three signed numbers of ten bits, of any length together; 0: the map has no normal here.
const uint NO_NORMAL = 0;

vec3 map_normal(uint bits) {
    ivec3 numbers = ivec3(bitfieldExtract(int(bits), 0, 10), bitfieldExtract(int(bits), 10, 10),
        bitfieldExtract(int(bits), 20, 10));
    return normalize(vec3(numbers));
}

// The direction in which a pinhole sees a pixel, of depth 1.
vec3 pixel_ray(uvec2 pixel, vec2 focal, vec2 principal_point) {
    return vec3((vec2(pixel) + 0.5 - principal_point) / focal, 1.0);
}
