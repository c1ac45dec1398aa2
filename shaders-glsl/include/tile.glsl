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

// Whether a group has whole rows of pixels, and any of a row's columns is in it. A function, as `tile_is_shared`.
bool has_whole_rows() {
    uint width = TILE_WIDTH;
    return SUBGROUP_SIZE % width == 0;
}

// The groups of pixels, one bit each, that the splat's ellipse intersects in the part at `origin`. In all others its
// alpha is below 1/255: skipping them changes only the time.
uint splat_groups(ProjectedSplat splat, uvec2 origin) {
    uint groups = 0;
    vec3 outline = splat_outline(splat);
    for (uint row = 0; row < PART_HEIGHT; row++) {
        vec2 columns = splat_columns_of_row(splat, outline, float(origin.y + row)) - float(origin.x);
        columns = vec2(max(columns.x, 0.0), min(columns.y, float(TILE_WIDTH - 1)));
        uint first = row * TILE_WIDTH, last = first;
        if (!has_whole_rows()) {
            first += uint(min(columns.x, float(TILE_WIDTH - 1)));
            last += uint(max(columns.y, 0.0));
        }
        // Bits first..last; the shift past bit 31 wraps to zero as intended.
        uint covered = (2u << last / SUBGROUP_SIZE) - (1u << first / SUBGROUP_SIZE);
        groups |= columns.x <= columns.y ? covered : 0;
    }
    return SKIPS_GROUPS ? groups : ~0u;
}
