// Images of a host: how a pixel is stored, and what its numbers mean. `src/splats/render/target.rs` is the host's.

const uint STORED_HALVES       = 0;  // four 16-bit floats in two words
const uint STORED_FLOATS       = 1;  // four 32-bit floats
const uint STORED_SMALL_FLOATS = 2;  // unsigned floats of 11, 11 and 10 bits from the lowest bit on; no alpha
const uint STORED_BYTES        = 3;  // four bytes in a word
const uint STORED_TENS         = 4;  // three numbers of 10 bits from the lowest bit on, and alpha of 2

const uint LIGHT_LINEAR  = 0;
const uint LIGHT_DISPLAY = 1;  // display-referred
const uint LIGHT_SRGB    = 2;  // linear light, stored by the sRGB curve
const uint LIGHT_HDR10   = 3;  // linear light, stored in the primaries of BT.2020 by the curve of ST 2084

const uint DEPTH_FLOAT = 0;
const uint DEPTH_24    = 1;  // the lower 24 bits of a word
const uint DEPTH_16    = 2;  // two in a word
