// The tile of a slot that no splat covers: such slots are padding, and sort last.
const uint NO_TILE = 0xffffffffu;
