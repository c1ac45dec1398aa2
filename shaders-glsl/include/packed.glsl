// The memory layout of factors of 16-bit matrices. A feature map is (rows, columns, channels): its channels are
// contiguous, in groups of eight halves, and its pixels are surrounded by zeros, so that a tap is an offset. A layer's
// weights are (tap, to, from). Channels are rounded up and padded with zeros.

// Both sides of every matrix divide these.
const uint PACKED_CHANNELS = 16, PACKED_COLUMNS = 16;
const uint PACKED_ROWS = 4;

uint packed_channels(uint channels) { return (channels + PACKED_CHANNELS - 1) / PACKED_CHANNELS * PACKED_CHANNELS; }

uvec2 packed_size(uvec2 size) {
    const uvec2 unit = uvec2(PACKED_COLUMNS, PACKED_ROWS);
    return (size + unit - 1) / unit * unit + 2;
}

// A power of two scales the largest magnitude of a map or layer to [2^14, 2^15). The scale follows from its exponent,
// within the range in which the scale and its inverse are normal numbers.
uint packed_exponent(uint largest) { return clamp(largest >> 23, 23u, 254u); }
float packed_scale(uint exponent) { return uintBitsToFloat((127 + 14 + 127 - exponent) << 23); }
float packed_inverse(uint exponent) { return uintBitsToFloat((exponent - 14) << 23); }

// The sum of products of two scaled factors, unscaled: the smaller inverse is applied first, so that no intermediate
// overflows.
float unpacked(float sum, uint largest, uint other) {
    uint exponent = packed_exponent(largest), beside = packed_exponent(other);
    return sum * packed_inverse(min(exponent, beside)) * packed_inverse(max(exponent, beside));
}
