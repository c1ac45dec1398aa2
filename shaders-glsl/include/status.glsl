// The status words, for the host. [0] has flags that stay set until the host clears them; kernels that change
// parameters do nothing while one is set. [1] is the most intersections of a render; [2] the most splats of one tile,
// if they exceed the limit; [3] is [0] as the last loss term or render left it, for kernels that raise a flag
// themselves and must not depend on whether another lane was faster.

const uint STATUS_WORDS      = 4;
const uint STATUS_OVERFLOWED = 1;  // more intersections than memory was reserved for
const uint STATUS_NOT_FINITE = 2;  // a loss term is NaN or infinite
const uint STATUS_GRADIENT   = 8;  // a gradient is NaN or infinite, and no flag was set before
const uint STATUS_TILE_LIMIT    = 4;  // more splats on one tile than the blending kernels process
