/// `random_bits` of include/random.glsl.
pub(super) fn random_bits(key: u32) -> u32 {
    let state = key.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}
