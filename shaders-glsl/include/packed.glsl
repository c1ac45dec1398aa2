// The memory layout of factors of 16-bit matrices. A feature map is (rows, columns, channels): its channels are
// contiguous, in groups of eight halves, and its pixels are surrounded by zeros, so that a tap is an offset. A layer's
// weights are (tap, to, from). Channels are rounded up and padded with zeros.
//
// A word beside each map and layer has the bits of its bound, a float that no magnitude exceeds.

// Both sides of every matrix divide these.
const uint PACKED_CHANNELS = 16, PACKED_COLUMNS = 16;
const uint PACKED_ROWS = 4;

uint packed_channels(uint channels) { return (channels + PACKED_CHANNELS - 1) / PACKED_CHANNELS * PACKED_CHANNELS; }

uvec2 packed_size(uvec2 size) {
    const uvec2 unit = uvec2(PACKED_COLUMNS, PACKED_ROWS);
    return (size + unit - 1) / unit * unit + 2;
}

// The first eight channels of the pixel at `at`, as an index of eights.
uint packed_index(uvec2 size, uint channels, uvec2 at) {
    return ((at.y + 1) * packed_size(size).x + at.x + 1) * (packed_channels(channels) / 8);
}

// A power of two scales the bound to [2^14, 2^15). The scale follows from its exponent, within the range in which the
// scale and its inverse are normal numbers.
uint packed_exponent(uint bound) { return clamp(bound >> 23, 23u, 254u); }
float packed_scale(uint exponent) { return uintBitsToFloat((127 + 14 + 127 - exponent) << 23); }
float packed_inverse(uint exponent) { return uintBitsToFloat((exponent - 14) << 23); }

// The sum of products of two scaled factors, unscaled: the smaller inverse is applied first, so that no intermediate
// overflows.
float unpacked(float sum, uint bound, uint other) {
    uint exponent = packed_exponent(bound), beside = packed_exponent(other);
    return sum * packed_inverse(min(exponent, beside)) * packed_inverse(max(exponent, beside));
}

// Eight channels of a pixel, and the halves that they are kept as.
float[8] unpacked_eight(uvec4 words, float inverse) {
    float numbers[8];
    [[unroll]] for (uint w = 0; w < 4; ++w) {
        vec2 pair = inverse * unpackHalf2x16(words[w]);
        numbers[2 * w] = pair.x;
        numbers[2 * w + 1] = pair.y;
    }
    return numbers;
}

uvec4 packed_eight(float numbers[8], float scale) {
    uvec4 words;
    [[unroll]] for (uint w = 0; w < 4; ++w)
        words[w] = packHalf2x16(scale * vec2(numbers[2 * w], numbers[2 * w + 1]));
    return words;
}
