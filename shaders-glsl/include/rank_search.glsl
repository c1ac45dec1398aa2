// Radix select: the values of given ranks among non-negative floats, whose bits sort as integers.
// Four digits of eight bits, from the top; `luminance` begins the searches.

struct RankSearch {
    uint prefix;     // the digits found so far
    uint rank;       // of the value among those that begin with them, from 0
    uint histogram;  // the first search with the same prefix: its histogram serves both
};

const uint SEARCHES = 4;   // the lower and the upper neighbour of p10, then of p90
const uint BINS     = 256; // of one digit
