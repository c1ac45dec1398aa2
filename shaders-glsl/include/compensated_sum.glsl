// Kahan's sum: the bits that an addition loses are carried to the next one. Begin with zeros.
// `precise`, because a reordering would cancel the carry.

struct CompensatedSum {
    vec2 sum;
    vec2 carry;
};

CompensatedSum add(CompensatedSum total, vec2 x) {
    precise vec2 corrected = x - total.carry;
    precise vec2 sum = total.sum + corrected;
    precise vec2 carry = (sum - total.sum) - corrected;
    return CompensatedSum(sum, carry);
}
