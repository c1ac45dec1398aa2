// Radix sort: the counts of the keys of a workgroup by digit, and their prefix sums.
//
// A workgroup has SUBGROUPS partitions of consecutive keys, its counters of one subgroup each after those of another in
// `keys_with_digit`. The last workgroup of a dispatch turns a table (workgroups, digits) of counts into exclusive
// prefix sums over the workgroups, and finds where the keys of each digit begin.
//
// The includer declares `coherent buffer` with `uint table[]` and with `uint arrivals[]`, `buffer` with
// `uint digit_begins[]`, the kernel's `keys`, and the size of subgroups.

#include "last_workgroup.glsl"

shared uint keys_with_digit[SUBGROUPS * MAX_DIGITS];
shared uint is_last;

// Loads in flight: of keys, and of the counts of workgroups.
const uint KEYS_AHEAD = 8;
const uint WORKGROUPS_AHEAD = 16;

// A function, since the reflection of kernels cannot compare constants; drivers fold it.
bool is_shared() {
    uint subgroups = SUBGROUPS;
    return subgroups > 1;
}

uint thread() { return gl_LocalInvocationID.y * SUBGROUP_SIZE + gl_LocalInvocationID.x; }
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;

void sync() {
    if (is_shared()) barrier();
    else subgroupBarrier();
}

// Adds the keys from `first` on, of this lane, to the counters of the subgroup.
void count_keys(uint first, uint end, uint shift, uint digit_bits) {
    uint row_begin = gl_LocalInvocationID.y * MAX_DIGITS;
    if (!is_shared()) {
        for (uint i = first; i < end; i += SUBGROUP_SIZE) {
            atomicAdd(keys_with_digit[digit_of(keys[i], shift, digit_bits)], 1);
        }
        return;
    }
    for (; first < end; first += KEYS_AHEAD * SUBGROUP_SIZE) {
        uint key[KEYS_AHEAD];
        [[unroll]] for (uint k = 0; k < KEYS_AHEAD; k++) key[k] = keys[min(first + k * SUBGROUP_SIZE, end - 1)];
        [[unroll]] for (uint k = 0; k < KEYS_AHEAD; k++) {
            if (first + k * SUBGROUP_SIZE < end) {
                atomicAdd(keys_with_digit[row_begin + digit_of(key[k], shift, digit_bits)], 1);
            }
        }
    }
}

// Whether this workgroup is the last of a dispatch; see `is_last_workgroup`, which is for workgroups of one subgroup.
bool is_last_of(uint workgroup_count) {
    if (!is_shared()) return is_last_workgroup(workgroup_count);
    memoryBarrierBuffer();
    barrier();
    if (thread() == 0) {
        is_last = uint(atomicAdd(arrivals[0], 1) + 1 == workgroup_count);
        if (is_last != 0) arrivals[0] = 0;
    }
    barrier();
    memoryBarrierBuffer();
    return is_last != 0;
}

// Exclusive prefix sums of a digit over the workgroups; returns the sum of all.
uint sum_workgroups(uint begin, uint digit, uint digit_bits, uint workgroup_count) {
    uint running = 0;
    for (uint first = 0; first < workgroup_count; first += WORKGROUPS_AHEAD) {
        uint key_counts[WORKGROUPS_AHEAD];
        [[unroll]] for (uint k = 0; k < WORKGROUPS_AHEAD; k++) {
            uint workgroup = min(first + k, workgroup_count - 1);
            key_counts[k] = table[begin + (workgroup << digit_bits) + digit];
        }
        [[unroll]] for (uint k = 0; k < WORKGROUPS_AHEAD; k++) {
            if (first + k < workgroup_count) {
                table[begin + ((first + k) << digit_bits) + digit] = running;
                running += key_counts[k];
            }
        }
    }
    return running;
}

// The prefix sums of the table that begins at `begin`, by the last workgroup.
void sum_table(uint begin, uint digit_bits, uint workgroup_count) {
    uint digit_count = 1u << digit_bits;
    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        keys_with_digit[digit] = sum_workgroups(begin, digit, digit_bits, workgroup_count);
    }
    sync();
    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        uint before = 0;
        for (uint first = 0; first < digit; first += 8) {
            [[unroll]] for (uint k = first; k < first + 8; k++) before += k < digit ? keys_with_digit[k] : 0;
        }
        digit_begins[digit] = before;
    }
}

// Zeroes this workgroup's part of the table that begins at `begin`, as wide as the widest digit needs.
void clear_row(uint begin) {
    [[unroll]] for (uint i = 0; i < MAX_DIGITS; i += THREADS) {
        if (i + thread() < MAX_DIGITS) table[begin + WORKGROUP_INDEX * MAX_DIGITS + i + thread()] = 0;
    }
}
