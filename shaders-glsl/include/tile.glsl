// The part of a tile that a subgroup owns: lane l of group g owns pixel g * SUBGROUP_SIZE + l, counted row by row.
//
// Its state is in registers, one array element per group. Loops over groups are therefore unrolled: every index is a
// constant.

// The number of parts of a tile, one above the other: more subgroups with less state each, if the device has resources
// for them.
layout(constant_id = 9) const uint SUBGROUPS_PER_TILE = 1;
layout(local_size_x_id = 100, local_size_y_id = 9) in;
// A function, since the reflection of kernels cannot compare constants; drivers fold it.
bool tile_is_shared() {
    uint subgroups = SUBGROUPS_PER_TILE;
    return subgroups > 1;
}

// Whether groups that a splat does not cover are skipped. A GPU skips them if its whole subgroup agrees; a software
// device may only mask its lanes, do the work anyway, and be faster without the test.
layout(constant_id = 6) const bool SKIPS_GROUPS = true;

const uint PART_HEIGHT = TILE_HEIGHT / SUBGROUPS_PER_TILE;
const uint GROUPS = TILE_WIDTH * PART_HEIGHT / SUBGROUP_SIZE;
// The columns of pixels in which a lane has pixels: group g has column g % COLUMNS.
const uint COLUMNS = (TILE_WIDTH + SUBGROUP_SIZE - 1) / SUBGROUP_SIZE;

// The splats of a batch that one iteration of the loop blends: some devices limit the iterations of an invocation.
layout(constant_id = 7) const uint SPLATS_PER_TURN = 1;

// The first pixel of a tile.
uvec2 tile_origin(uint tile, uint tile_columns) {
    return uvec2(tile % tile_columns * TILE_WIDTH, tile / tile_columns * TILE_HEIGHT);
}

// The lane's pixel of group 0, relative to the part.
uvec2 lane_pixel() {
    return uvec2(gl_SubgroupInvocationID % TILE_WIDTH, gl_SubgroupInvocationID / TILE_WIDTH);
}

// From the lane's pixel of group 0 to that of `group`.
uvec2 group_offset(uint group) {
    return uvec2(group * SUBGROUP_SIZE % TILE_WIDTH, group * SUBGROUP_SIZE / TILE_WIDTH);
}

// The rows of the part at `origin` between the highest and the lowest pixel that the splat's ellipse may meet in the
// columns [first, last] of the part; empty if y < x. No term cancels: the half height at x is sqrt(level / conic.zz)
// sqrt(1 - (x / half_extent.x)^2) about the shear line -conic.xy / conic.zz x.
//
// A row is left out for a proof alone: all rows are met where the box is not a number, or larger than the margin of the
// roundings allows, and what is not a number ends no range. Choices are between names, both computed.
ivec2 splat_rows(ProjectedSplat splat, uvec2 origin, uint first, uint last) {
    vec2 mean = splat.mean2d - (vec2(origin) + 0.5);
    vec2 extent = splat.half_extent;
    float left = max(float(first) - mean.x, -extent.x);
    float right = min(float(last) - mean.x, extent.x);
    float lowest = -splat.conic.y / splat.conic.x * extent.y;  // x of the lowest point
    vec2 x = clamp(vec2(-lowest, lowest), left, right);
    vec2 share = x / extent.x;
    vec2 height = sqrt(splat_level(splat.opacity) / splat.conic.z * max(vec2(0.0), 1.0 - share * share)) + 0.01;
    vec2 middle = mean.y - splat.conic.y / splat.conic.z * x;
    float top = ceil(middle.x - height.x), bottom = floor(middle.y + height.y), end = float(PART_HEIGHT - 1);
    bool is_within = all(bvec4(greaterThan(extent, vec2(0.0)), lessThan(extent, vec2(1e4))));
    bool is_beside = is_within && any(bvec3(left > right, top > end, bottom < 0.0));
    top = is_within && top > 0.0 ? top : 0.0;
    bottom = is_within && bottom < end ? bottom : end;
    ivec2 rows = ivec2(top, bottom);
    return is_beside ? ivec2(0, -1) : rows;
}

// The groups of pixels, one bit each, that the splat's ellipse may meet in the part at `origin`. In all others its
// alpha is below 1/255: skipping them changes only the time.
uint splat_groups(ProjectedSplat splat, uvec2 origin) {
    const uint WIDTH = TILE_WIDTH / COLUMNS;  // columns of pixels of a group
    uint groups = 0;
    [[unroll]] for (uint k = 0; k < COLUMNS; k++) {
        ivec2 rows = splat_rows(splat, origin, k * WIDTH, (k + 1) * WIDTH - 1);
        uint in_columns = 0;
        [[unroll]] for (uint row = 0; row < GROUPS / COLUMNS; row++) in_columns |= 1u << (row * COLUMNS + k);
        // Bits of the first to those of the last row; the shift past bit 31 wraps to zero as intended.
        uint first = uint(rows.x) * TILE_WIDTH / SUBGROUP_SIZE;
        uint last = uint(max(rows.y, 0)) * TILE_WIDTH / SUBGROUP_SIZE + COLUMNS - 1;
        uint in_rows = (2u << last) - (1u << first);
        groups |= rows.x <= rows.y ? in_rows & in_columns : 0;
    }
    return SKIPS_GROUPS ? groups : ~0u;
}
