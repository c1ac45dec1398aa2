// One Gaussian's attributes, stored as planes in one float array: all means, then all quats, and so on.
// Plane k begins at (the widths before it) * gaussian_count. `scene::ATTRIBUTES` is the host side.

const uint MEANS_COLUMN         = 0;   // 3: x, y, z in the world
const uint QUATS_COLUMN         = 3;   // 4: w, x, y, z, not normalised
const uint LOG_SCALES_COLUMN    = 7;   // 3: ln of the standard deviations
const uint RAW_OPACITIES_COLUMN = 10;  // 1: before the sigmoid
const uint DC_COLUMN            = 11;  // 3: SH degree 0, RGB
const uint REST_COLUMN          = 14;  // 3 ((degree + 1)^2 - 1): SH above degree 0, coefficient-major, RGB
