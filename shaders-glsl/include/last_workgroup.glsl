// What the last workgroup of a dispatch does when the others are done. No workgroup waits for another, so this asks for
// no forward progress, and integers make it the same whichever is the last. What the others wrote is `coherent`.
//
// The includer declares `coherent buffer` with `uint arrivals[]`: [0] is zero before the dispatch and after it.

// True in the last workgroup, of one subgroup each, that comes here.
bool is_last_workgroup(uint workgroup_count) {
    subgroupBarrier();
    memoryBarrierBuffer();
    uint before = 0;
    if (subgroupElect()) before = atomicAdd(arrivals[0], 1);
    bool is_last = subgroupBroadcastFirst(before) + 1 == workgroup_count;
    if (is_last && subgroupElect()) arrivals[0] = 0;
    memoryBarrierBuffer();
    return is_last;
}
