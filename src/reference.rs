//! CPU references.
pub mod tone;
/// The curve of one photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToneParameters {
    /// t = x / white.
    pub white: f32,
    /// delta0.
    pub offset: f32,
    /// g or b.
    pub gain: f32,
}
