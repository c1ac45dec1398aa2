// A tile owned by one subgroup: lane l of group g owns pixel g * SUBGROUP_SIZE + l, counted row by row.

const uint TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT;
const uint GROUPS = TILE_PIXELS / SUBGROUP_SIZE;

// The groups of pixels, one bit each, that the splat's ellipse meets in the tile at `origin`.
uint splat_groups(ProjectedSplat splat, uvec2 origin) {
    uint groups = 0;
    for (uint row = 0; row < TILE_HEIGHT; row++) {
        float y = float(origin.y + row);
        ivec2 columns = splat_columns(splat, y, y) - int(origin.x);
        columns = ivec2(max(columns.x, 0), min(columns.y, int(TILE_WIDTH) - 1));
        if (columns.x <= columns.y) {
            uint first = (row * TILE_WIDTH + uint(columns.x)) / SUBGROUP_SIZE;
            uint last = (row * TILE_WIDTH + uint(columns.y)) / SUBGROUP_SIZE;
            // Bits first..last; the shift past bit 31 wraps to zero, as it should.
            groups |= (2u << last) - (1u << first);
        }
    }
    return groups;
}
