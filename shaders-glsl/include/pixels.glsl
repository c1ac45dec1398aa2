// Images of a host: how a pixel is stored, and what its colours mean. `src/splats/render/target.rs` is the host's.

// Four 16-bit floats in two words, linear or display-referred; or four bytes in a word.
const uint PIXELS_LINEAR_HALF  = 0;
const uint PIXELS_DISPLAY_HALF = 1;
const uint PIXELS_SRGB         = 2;  // bytes that the format decodes to linear values
const uint PIXELS_UNORM        = 3;  // bytes, display-referred

const uint DEPTH_FLOAT = 0;
const uint DEPTH_24    = 1;  // the lower 24 bits of a word
const uint DEPTH_16    = 2;  // two in a word
