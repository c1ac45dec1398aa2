// Distribution of the slots of Gaussians in a subgroup with one Gaussian per lane: each lane processes its own
// Gaussian's, except for Gaussians with more than this number, which the whole subgroup processes together.

const uint SHARED_INTERSECTIONS = 32;
