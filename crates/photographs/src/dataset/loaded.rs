//! A decoded view with measurements of its files.

use super::View;
use super::original::Original;

/// A decoded view.
pub(super) struct LoadedView {
    pub(super) name: String,
    /// `None` for a training view whose photograph cannot be decoded.
    pub(super) view: Option<View>,
    /// Why files were left out, one line each.
    pub(super) problems: Vec<String>,
    /// Means of the photograph and of the reference image, sRGB-encoded.
    pub(super) brightness: [Option<f32>; 2],
    /// The file of the reference image.
    pub(super) reference: Option<Original>,
}
