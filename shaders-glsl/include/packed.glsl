// Factors of 16-bit matrices as they lie in memory. A map of features is (rows, columns, channels): its channels side
// by side, in eights of sixteen bytes, and around its pixels zeros, so that a tap is an offset. A layer's weights are
// (tap, to, from). Channels are rounded up, and what is beyond is zero.

// Of both sides of every matrix there is a divisor of these.
const uint PACKED_CHANNELS = 16, PACKED_COLUMNS = 16;
const uint PACKED_ROWS = 4;

uint packed_channels(uint channels) { return (channels + PACKED_CHANNELS - 1) / PACKED_CHANNELS * PACKED_CHANNELS; }

uvec2 packed_size(uvec2 size) {
    const uvec2 unit = uvec2(PACKED_COLUMNS, PACKED_ROWS);
    return (size + unit - 1) / unit * unit + 2;
}

// A power of two brings the largest magnitude of a map or layer to 2^14 and more, below 2^15: the scale follows from
// the exponent of that, within what leaves both the scale and its inverse normal numbers.
uint packed_exponent(uint largest) { return clamp(largest >> 23, 23u, 254u); }
float packed_scale(uint exponent) { return uintBitsToFloat((127 + 14 + 127 - exponent) << 23); }
float packed_inverse(uint exponent) { return uintBitsToFloat((exponent - 14) << 23); }

// A sum of products of two scaled factors, as it would be without: the smaller inverse first, so that nothing is
// infinite on the way to a number that is not.
float unpacked(float sum, uint largest, uint other) {
    uint exponent = packed_exponent(largest), beside = packed_exponent(other);
    return sum * packed_inverse(min(exponent, beside)) * packed_inverse(max(exponent, beside));
}
