// The status words: what a step met that the host must know. [0] holds flags that stay raised until the host lowers
// them, and kernels that change parameters do nothing while one is up; [1] the most intersections of a render; [2] the
// most of one tile, where these were too many.

const uint STATUS_WORDS      = 3;
const uint STATUS_OVERFLOWED = 1;  // more intersections than memory was reserved for
const uint STATUS_NOT_FINITE = 2;  // a loss term is NaN or infinite
const uint STATUS_GRADIENT   = 8;  // a gradient is NaN or infinite, and no flag was up before
const uint STATUS_TILE_LIMIT    = 4;  // more splats on one tile than the blending kernels follow
