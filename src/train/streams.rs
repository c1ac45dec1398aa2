//! The streams of random numbers that training draws from, one per purpose.

pub(super) const POINTS: u64 = 1;
pub(super) const BACKGROUND: u64 = 2;
pub(super) const VIEWS: u64 = 3;
pub(super) const DENSITY: u64 = 4;
pub(super) const FEATURES: u64 = 5;
pub(super) const NETWORKS: u64 = 6;
pub(super) const CROPS: u64 = 7;
pub(super) const BOXES: u64 = 8;
pub(super) const FILL: u64 = 9;
