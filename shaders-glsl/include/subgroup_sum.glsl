// Sums over a subgroup by shuffles, which are faster than subgroupAdd on a CPU and have a fixed order.
//
// The loops have constant bounds, so that drivers unroll them: subgroups have at most 128 lanes.

// The sum of `x` over the subgroup, in every lane: a butterfly.
float subgroup_sum(float x) {
    [[unroll]] for (uint bit = 0; bit < 7; bit++)
        if ((1u << bit) < SUBGROUP_SIZE) x += subgroupShuffle(x, gl_SubgroupInvocationID ^ (1u << bit));
    return x;
}

vec2 subgroup_sum(vec2 x) { return vec2(subgroup_sum(x.x), subgroup_sum(x.y)); }

vec4 subgroup_sum(vec4 x) { return vec4(subgroup_sum(x.xy), subgroup_sum(x.zw)); }

// The sum of `x` over this lane and those before it.
uint subgroup_inclusive_sum(uint x) {
    [[unroll]] for (uint bit = 0; bit < 7; bit++) {
        uint distance = 1u << bit;
        if (distance < SUBGROUP_SIZE) {
            uint before = subgroupShuffle(x, (gl_SubgroupInvocationID - distance) & (SUBGROUP_SIZE - 1));
            x += gl_SubgroupInvocationID < distance ? 0 : before;
        }
    }
    return x;
}
