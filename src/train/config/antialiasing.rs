//! Settings against aliasing.

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

settings! {
"antialiasing."
/// Filters that keep a model from shimmering, and from changing in brightness, at sizes that it was not trained at:
/// those of Mip-Splatting (Yu et al. 2024).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AntialiasingConfig {
    /// Compensate the opacity of a splat for the dilation, so that one smaller than a pixel does not gain light. Every
    /// exported file states it; a viewer that ignores it shows small splats brighter.
    compensation: bool = false => Rule::Flag, "--antialiasing on|off";
    /// Raise the standard deviations of Gaussians to that of a filter of this variance in the training view that
    /// resolves them best, also in the exported file; 0: off. Mip-Splatting has 0.2.
    smoothing: f64 = 0.0 => Rule::from_to(0.0, 100.0), in "square pixels";
}
}
