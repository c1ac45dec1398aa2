// Planes of gradients and moments, for a kernel that declares gaussian_count.

// Columns of the parameters, from the first, that are not trained: these planes do not have them.
layout(constant_id = 15) const uint FROZEN_COLUMNS = 0;

bool is_trained(uint column) { return column >= FROZEN_COLUMNS; }

// The vectors of four floats that these planes do not have. They begin with that of the first trained float, so that
// four parameters and their gradients are aligned alike.
uint frozen_quads() { return FROZEN_COLUMNS * gaussian_count / 4; }

// The place of parameter `at` in these planes.
uint trained_place(uint at) { return at - 4 * frozen_quads(); }
