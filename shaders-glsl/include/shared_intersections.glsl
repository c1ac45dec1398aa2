// How the slots of Gaussians are shared out within a subgroup that has one Gaussian per lane: each lane walks its own
// Gaussian's, but for those of a Gaussian with more than these, which the whole subgroup walks together.

const uint SHARED_INTERSECTIONS = 32;
