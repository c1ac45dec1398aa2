// Radix select: the values of given ranks among non-negative floats, whose bits sort as integers.
// The sign is 0, so three digits from the top find the rest: 11, 10 and 10 bits.

struct RankSearch {
    uint prefix;     // the digits found so far
    uint rank;       // of the value among those that begin with them, from 0
    uint histogram;  // the first search with the same prefix: its histogram serves both
};

const uint SEARCHES   = 4;                  // at a time: the lower and the upper neighbour of two percentiles
const uint DIGIT_BITS = 10;                 // of the second and the third digit
const uint BINS       = 1u << DIGIT_BITS;   // of one search's histogram
const uint FIRST_BINS = 2 * BINS;           // of the first digit, which all searches share
const uint FIRST_SHIFT = 2 * DIGIT_BITS;    // how far right it lies

const uint WORKGROUP = 256;  // threads in a workgroup of the kernels that read pixels

// The pixels of a workgroup: neighbours, so that they share cache lines and pages.
struct Run {
    uint first;
    uint end;
};

Run run_of_workgroup(uint workgroup, uint workgroup_count, uint pixel_count) {
    uint rows = (pixel_count + WORKGROUP - 1) / WORKGROUP;
    uint length = (rows + workgroup_count - 1) / workgroup_count * WORKGROUP;
    uint first = min(workgroup * length, pixel_count);
    return Run(first, min(first + length, pixel_count));
}
