// Partitions: runs of consecutive items, each owned by one subgroup. (`partition` is a reserved word.)

layout(constant_id = 0) const uint PARTITION_SIZE = 1024;  // items

uint partitions_of(uint count) { return count / PARTITION_SIZE + uint(count % PARTITION_SIZE != 0); }

uint partition_begin(uint part) { return part * PARTITION_SIZE; }

// One past the last item of a partition that is not empty.
uint partition_end(uint part, uint count) {
    return partition_begin(part) + min(count - partition_begin(part), PARTITION_SIZE);
}
