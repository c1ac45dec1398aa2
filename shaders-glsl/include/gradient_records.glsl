// Sums of gradient records, for a kernel that declares `gradient_records` and has SUBGROUP_SIZE lanes, and the
// gradients of a splat from the moments of dL/dsigma that are first in a record.

vec2 mean2d_gradient(vec3 conic, vec2 moments_x_y) {
    return vec2(dot(conic.xy, moments_x_y), dot(conic.yz, moments_x_y));
}

vec3 conic_gradient(vec3 moments_xx_xy_yy) { return vec3(0.5, 1.0, 0.5) * moments_xx_xy_yy; }

// sigma is the logarithm of the opacity, sign reversed, up to a term without it.
float opacity_gradient(float opacity, float moment) { return -moment / opacity; }

// The record of the Gaussian with these slots, summed in slot order.
//
// The lanes share the slots of a Gaussian that has many: each sums every SUBGROUP_SIZE-th, then a tree sums the lanes.
// The fixed order gives the same bits every time.
void sum_gradient_records(uvec2 intersection_ids, out vec4 sum[RECORD_VECTORS]) {
    uint lane = gl_SubgroupInvocationID;
    bool is_shared = intersection_ids.y - intersection_ids.x > SHARED_INTERSECTIONS;
    uvec4 sharing = subgroupBallot(is_shared);

    // First every lane's own slots, then all lanes together the shared ones: in one loop, since a device that does not
    // skip branches would pay for a second loop even if nothing is shared.
    uvec2 walked = is_shared ? uvec2(0) : intersection_ids;
    uint owner = lane, stride = 1;
    while (true) {
        vec4 part[RECORD_VECTORS];
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) part[k] = vec4(0.0);
        for (uint slot = walked.x; slot < walked.y; slot += stride) {
            [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) part[k] += gradient_records[RECORD_VECTORS * slot + k];
        }
        bool is_alone = stride == 1;
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) {
            vec4 of_all = subgroup_sum(part[k]);
            if (owner == lane) sum[k] = is_alone ? part[k] : of_all;
        }
        if (all(equal(sharing, uvec4(0)))) break;
        owner = subgroupBallotFindLSB(sharing);
        sharing[owner / 32] &= sharing[owner / 32] - 1;
        stride = SUBGROUP_SIZE;
        walked = subgroupShuffle(intersection_ids, owner) + uvec2(lane, 0);
    }
}
