// Planes of gradients and moments, for a kernel that declares gaussian_count.

// Columns of the parameters, from the first, that are not trained: these planes do not have them. They begin with the
// four floats that contain the first trained one, so that four parameters and their gradients are aligned alike.
layout(constant_id = 15) const uint FROZEN_COLUMNS = 0;

bool is_trained(uint column) { return column >= FROZEN_COLUMNS; }

// The place of parameter `at` in them.
uint trained_place(uint at) { return at - (FROZEN_COLUMNS * gaussian_count & ~3u); }
