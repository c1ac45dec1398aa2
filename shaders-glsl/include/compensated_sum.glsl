// Kahan's sum: the bits that an addition loses are carried to the next one. Begin with zeros.
// `precise`, because a reordering would cancel the carry.

struct CompensatedSum {
    vec3 sum;
    vec3 carry;
};

CompensatedSum add(CompensatedSum total, vec3 x) {
    precise vec3 corrected = x - total.carry;
    precise vec3 sum = total.sum + corrected;
    precise vec3 carry = (sum - total.sum) - corrected;
    return CompensatedSum(sum, carry);
}
