// Radix sort: the digit of a key that a pass sorts by.

// The most bits of a pass: the 256 counters of one subgroup take 1 KiB of shared memory.
const uint MAX_DIGIT_BITS = 8;
const uint MAX_DIGITS = 1u << MAX_DIGIT_BITS;

uint digit_of(uint key, uint shift, uint digit_bits) {
    return bitfieldExtract(key, int(shift), int(digit_bits));
}
