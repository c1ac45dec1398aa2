// A box of flat colour. After a change:
// glslangValidator -V --target-env vulkan1.3 -g0 box.vert -o box.vert.spv, and box.frag alike.
#version 450

layout(push_constant) uniform Box {
    mat4 clip_from_world;
    vec4 center;
    vec4 half_size;
    vec4 color;
};

layout(location = 0) flat out vec4 shade;

const vec2 CORNERS[6] = vec2[](
    vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(-1, 1), vec2(1, -1), vec2(1, 1)
);

// 36 vertices: two triangles for each of the six faces.
void main() {
    int axis = gl_VertexIndex / 12;
    vec2 corner = CORNERS[gl_VertexIndex % 6];
    vec3 at;
    at[axis] = gl_VertexIndex % 12 < 6 ? -1 : 1;
    at[(axis + 1) % 3] = corner.x;
    at[(axis + 2) % 3] = corner.y;
    gl_Position = clip_from_world * vec4(center.xyz + half_size.xyz * at, 1);
    shade = vec4(color.rgb * (1 - 0.2 * axis), 1);
}
