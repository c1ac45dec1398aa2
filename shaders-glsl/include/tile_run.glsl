// The run of a tile in the intersections sorted by tile.
//
// The includer declares `counts[]`, [0]: intersections, `sorted_tiles[]` and `status[]`.

// The number of intersections in tiles before `tile`: every lane probes, and the search continues between two probes.
uint intersections_before(uint tile) {
    uint begin = 0;
    uint end = counts[0];
    while (begin < end) {
        uint stride = (end - begin - 1) / SUBGROUP_SIZE + 1;
        uint probe = begin + gl_SubgroupInvocationID * stride;
        bool is_before = probe < end && sorted_tiles[min(probe, end - 1)] < tile;
        uint probes_before = subgroupBallotBitCount(subgroupBallot(is_before));
        end = min(end, begin + probes_before * stride);
        if (probes_before > 0) begin += (probes_before - 1) * stride + 1;
    }
    return begin;
}

// The first intersection of a tile and one past its last. More than `longest_run` set a sticky flag, and the tile is
// left empty.
uvec2 tile_run(uint tile, uint longest_run) {
    uvec2 run = uvec2(intersections_before(tile), intersections_before(tile + 1));
    uint count = run.y - run.x;
    if (count > longest_run) {
        if (subgroupElect()) {
            atomicOr(status[0], STATUS_TILE_LIMIT);
            atomicMax(status[2], count);
        }
        run.y = run.x;
    }
    return run;
}
