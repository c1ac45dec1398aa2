// What density control does with a Gaussian.

const uint FATE_PRUNE = 0;  // it goes
const uint FATE_KEEP  = 1;  // it stays as it is
const uint FATE_CLONE = 2;  // it stays, and a copy appears at a position drawn from it
const uint FATE_SPLIT = 3;  // two smaller ones at positions drawn from it take its place

// How many Gaussians come of one.
uint offspring(uint fate) { return min(fate, 2u); }
