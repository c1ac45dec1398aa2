// Segments of the run of a tile, which the backward pass blends side by side. The forward pass keeps the state of every
// pixel before the splats at which segments start, except for the first of a tile.
//
// Starts are at least SEGMENT intersections apart, so each block of SEGMENT sorted intersections has at most one: the
// block is its place in memory. A block has the values of a pixel, transmittance and CHANNELS, each for the pixels of
// the tile row by row; where a pixel is done, the transmittance is zero and the others are not defined.

// The splats of a segment, a multiple of any subgroup size; 0: a run has one segment.
layout(constant_id = 14) const uint SEGMENT = 0;

// The place of a value of this lane's pixel of group 0.
uint segment_state(uint block, uint value) {
    uint part = (block * (CHANNELS + 1) + value) * SUBGROUPS_PER_TILE + gl_SubgroupID;
    return part * GROUPS * SUBGROUP_SIZE + gl_SubgroupInvocationID;
}
