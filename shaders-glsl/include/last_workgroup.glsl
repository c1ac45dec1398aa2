// Detects the last workgroup of a dispatch, when the others are done. No workgroup waits for another, so no forward
// progress is required, and with integers the result does not depend on which is last. The others' writes are
// `coherent`.
//
// The includer declares `coherent buffer` with `uint arrivals[]`: [0] is zero before the dispatch and after it.

// True in the last workgroup to call it; workgroups have one subgroup each, or each subgroup counts as one. All of them
// must call it: Mesa 26.2 on a CPU counts none where some of a workgroup are gone before the barrier.
bool is_last_workgroup(uint workgroup_count) {
    subgroupBarrier();
    memoryBarrierBuffer();
    uint before = 0;
    if (subgroupElect()) before = atomicAdd(arrivals[0], 1);
    bool is_last = subgroupBroadcastFirst(before) + 1 == workgroup_count;
    if (is_last && subgroupElect()) arrivals[0] = 0;
    memoryBarrierBuffer();
    // The barrier above is the elected lane's, which saw all arrivals; this one extends what it saw to the other lanes.
    subgroupBarrier();
    return is_last;
}
