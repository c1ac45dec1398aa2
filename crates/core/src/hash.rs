//! 64-bit checksums of numbers and bytes. They detect accidental changes, not attacks.
//!
//! Each word is folded into the state by the two halves of a product, as in wyhash; the same bytes give the same number
//! on every machine.

/// An incremental checksum.
#[derive(Clone, Copy, Debug)]
pub struct Hasher(u64);

/// Odd numbers with half of the bits set, from the golden ratio and the square root of three.
const WORD: u64 = 0x9E37_79B9_7F4A_7C15;
const LENGTH: u64 = 0xBB67_AE85_84CA_A73B;

impl Default for Hasher {
    fn default() -> Self {
        Self(LENGTH)
    }
}

impl Hasher {
    /// Hashes bytes; boundaries between slices matter.
    pub fn write(&mut self, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<8>();
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        for word in words.iter().chain([&last]) {
            self.0 = folded(self.0 ^ u64::from_le_bytes(*word), WORD);
        }
        self.0 = folded(self.0 ^ bytes.len() as u64, LENGTH);
    }

    /// Hashes the bits of numbers.
    pub fn write_numbers(&mut self, numbers: &[f64]) {
        numbers.iter().for_each(|number| self.write(&number.to_bits().to_le_bytes()));
    }

    /// The checksum of everything so far.
    pub fn finish(self) -> u64 {
        folded(self.0, WORD)
    }
}

/// The checksum of some bytes.
pub fn checksum(bytes: &[u8]) -> u64 {
    let mut hasher = Hasher::default();
    hasher.write(bytes);
    hasher.finish()
}

/// The hash as text for files: sixteen hexadecimal digits.
pub fn text(hash: u64) -> String {
    format!("{hash:016x}")
}

/// Bytes as two hexadecimal digits each.
pub fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn folded(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    // A factor of zero would lose the preceding state.
    (product as u64) ^ (product >> 64) as u64 ^ a.rotate_left(32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bit_length_and_boundary_matters() {
        let bytes: Vec<u8> = (0..67_u32).map(|i| (i * i % 251) as u8).collect();
        let mut seen = std::collections::BTreeSet::from([checksum(&bytes)]);
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(seen.insert(checksum(&flipped)), "bit {bit}");
        }
        for length in 0..bytes.len() {
            assert!(seen.insert(checksum(&bytes[..length])), "length {length}");
            let mut parted = Hasher::default();
            parted.write(&bytes[..length]);
            parted.write(&bytes[length..]);
            assert!(seen.insert(parted.finish()), "parted at {length}");
        }
        for zeros in 2..40 {
            assert!(seen.insert(checksum(&vec![0; zeros])), "{zeros} zeros");
        }
    }

    #[test]
    fn a_checksum_is_the_same_on_every_machine() {
        assert_eq!(text(checksum(b"nightsplat")), "02603cd5976257bc");
        assert_eq!(text(checksum(b"")), "f2b4f503f53f54e1");
    }
}
