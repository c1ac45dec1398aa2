//! Counter-based random numbers: each is a pure function of a seed, a stream and an index.
//!
//! There is no state, so the order of evaluation and the number of threads do not matter. The mixer is `SplitMix64`'s
//! finaliser (Steele, Lea and Flood 2014).

/// A stream of random numbers; the draw at an index is always the same.
#[derive(Clone, Copy, Debug)]
pub struct Stream(u64);

impl Stream {
    /// The stream numbered `stream` of the generator seeded with `seed`; different pairs are independent.
    pub const fn new(seed: u64, stream: u64) -> Self {
        Self(mix(mix(seed) ^ stream))
    }

    /// Draw `index`, uniform over all 64-bit values.
    pub const fn bits(self, index: u64) -> u64 {
        mix(self.0.wrapping_add(index.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// Draw `index`, uniform in [0, 1).
    pub fn uniform(self, index: u64) -> f64 {
        (self.bits(index) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Draw `index` of the standard normal distribution (Box and Muller 1958).
    pub fn normal(self, index: u64) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform(2 * index)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform(2 * index + 1)).cos()
    }
}

const fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

#[cfg(test)]
mod tests {
    use super::Stream;

    #[test]
    fn draws_have_the_mean_and_variance_of_their_distribution() {
        let (stream, count) = (Stream::new(3, 1), 20_000);
        let moments = |draw: &dyn Fn(u64) -> f64| {
            let mean = (0..count).map(draw).sum::<f64>() / count as f64;
            let variance = (0..count).map(|i| (draw(i) - mean).powi(2)).sum::<f64>() / count as f64;
            (mean, variance)
        };
        let (mean, variance) = moments(&|i| stream.uniform(i));
        assert!(
            (mean - 0.5).abs() < 0.01 && (variance - 1.0 / 12.0).abs() < 0.002,
            "{mean} {variance}"
        );
        let (mean, variance) = moments(&|i| stream.normal(i));
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.04, "{mean} {variance}");
    }

    #[test]
    fn seeds_and_streams_give_different_draws() {
        let first = Stream::new(0, 0).bits(0);
        assert_eq!(first, Stream::new(0, 0).bits(0));
        assert_ne!(first, Stream::new(1, 0).bits(0));
        assert_ne!(first, Stream::new(0, 1).bits(0));
        assert_ne!(first, Stream::new(0, 0).bits(1));
    }
}
