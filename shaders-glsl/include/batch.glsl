// The splats of a batch: each lane loads one and prepares what all pixels of its part need of it, and all lanes read
// them in turn.
//
// On a GPU, those that meet the part wait in shared memory, of which a lane reads sixteen bytes at once; the others are
// left out. A software device passes every splat by shuffles, which are cheaper there.
//
// The includer declares `splats[]` and `colors[]`.

// The splats that a subgroup loads at once, one a lane; fewer where parts add their records: all of it has to fit into
// the 16 KiB of shared memory that every device has.
const uint MAX_SHARED_BATCH = 32 / (1 + CHANNELS / 9);
const uint BATCH = SUBGROUP_SIZE / (1 + (1 - 1 / SUBGROUPS_PER_TILE) * ((SUBGROUP_SIZE - 1) / MAX_SHARED_BATCH));
const uint STAGED_VECTORS = 2 + COLOR_VECTORS;
// As integers: a device may flush floats that have the bits of groups or of a slot.
shared uvec4 staged[SUBGROUPS_PER_TILE * BATCH * STAGED_VECTORS];

struct PreparedSplat {
    vec2 mean2d;
    vec3 form;    // of the exponent
    float peak;   // the exponent at the mean
    uint groups;  // those that it meets
    uint slot;    // of its gradient record; where parts share a tile, among those of the batch
    vec4 color[(MAX_CHANNELS + 3) / 4];  // COLOR_VECTORS of them
};

// Orders the subgroup's accesses to shared memory, where there are any.
void order_shared_memory() {
    if (SKIPS_GROUPS)
        controlBarrier(gl_ScopeSubgroup, gl_ScopeSubgroup, gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
}

// A lane beyond the batch prepares a splat that no pixel sees.
PreparedSplat prepared_splat(uint id, uint slot, bool is_in_batch, uvec2 origin) {
    ProjectedSplat splat = splats[id];
    PreparedSplat mine;
    mine.mean2d = splat.mean2d;
    mine.form = exponent_form(splat.conic);
    mine.peak = is_in_batch ? log2(splat.opacity) : -3.4e38;
    mine.groups = is_in_batch ? splat_groups(splat, origin) : 0;
    mine.slot = slot;
    [[unroll]] for (uint k = 0; k < COLOR_VECTORS; k++) mine.color[k] = colors[COLOR_VECTORS * id + k];
    return mine;
}

uint staged_at(uint j) { return (gl_SubgroupID * BATCH + j) * STAGED_VECTORS; }

uint staged_slot(uint j) { return staged[staged_at(j) + 1].w; }

// The number of splats of the batch that wait to be read.
uint stage(PreparedSplat mine, uint batch) {
    uvec4 meeting = subgroupBallot(mine.groups != 0);
    if (SKIPS_GROUPS && mine.groups != 0) {
        uint at = staged_at(subgroupBallotExclusiveBitCount(meeting));
        staged[at] = uvec4(floatBitsToUint(mine.mean2d), floatBitsToUint(mine.form.xy));
        staged[at + 1] = uvec4(floatBitsToUint(mine.form.z), floatBitsToUint(mine.peak), mine.groups, mine.slot);
        [[unroll]] for (uint k = 0; k < COLOR_VECTORS; k++) staged[at + 2 + k] = floatBitsToUint(mine.color[k]);
    }
    order_shared_memory();
    return SKIPS_GROUPS ? subgroupBallotBitCount(meeting) : batch;
}

// Number `j` of those that wait.
PreparedSplat splat_of_batch(PreparedSplat mine, uint j) {
    PreparedSplat splat;
    if (SKIPS_GROUPS) {
        uint at = staged_at(j);
        uvec4 first = staged[at], second = staged[at + 1];
        splat.mean2d = uintBitsToFloat(first.xy);
        splat.form = vec3(uintBitsToFloat(first.zw), uintBitsToFloat(second.x));
        splat.peak = uintBitsToFloat(second.y);
        splat.groups = second.z;
        splat.slot = second.w;
        [[unroll]] for (uint k = 0; k < COLOR_VECTORS; k++) splat.color[k] = uintBitsToFloat(staged[at + 2 + k]);
    } else {
        splat.mean2d = subgroupShuffle(mine.mean2d, j);
        splat.form = subgroupShuffle(mine.form, j);
        splat.peak = subgroupShuffle(mine.peak, j);
        splat.groups = ~0u;
        splat.slot = subgroupShuffle(mine.slot, j);
        [[unroll]] for (uint c = 0; c < CHANNELS; c++)
            splat.color[c / 4][c % 4] = subgroupShuffle(mine.color[c / 4][c % 4], j);
    }
    return splat;
}
