//! What tells the dataset of a diagnosis or a plan from others.

use nightsplat_photographs::dataset::{Dataset, View};
use serde::{Deserialize, Serialize};

/// Identifies a dataset by the names and loaded sizes of its training views.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiagnosedViews {
    /// The number of training views.
    pub views: usize,
    /// Width and height of the first.
    pub size: [u32; 2],
    /// A hash of all names and sizes.
    pub fingerprint: String,
}

impl DiagnosedViews {
    /// Those of a dataset.
    pub fn new(dataset: &Dataset) -> Self {
        let views: Vec<_> = dataset.views.iter().filter(|view| view.is_for_training()).collect();
        let line =
            |view: &&View| format!("{} {}x{}\n", view.name, view.camera.width, view.camera.height);
        let lines: String = views.iter().map(line).collect();
        let hash = fnv1a(lines.bytes().map(u64::from));
        let size = views.first().map_or([0; 2], |view| [view.camera.width, view.camera.height]);
        Self { views: views.len(), size, fingerprint: format!("{hash:016x}") }
    }

    /// Their number and size.
    pub fn described(&self) -> String {
        let [width, height] = self.size;
        format!("{} training views of {width}x{height}", self.views)
    }
}

/// The FNV-1a hash of plans, the same on every machine.
fn fnv1a(bytes: impl Iterator<Item = u64>) -> u64 {
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ byte).wrapping_mul(0x0100_0000_01b3))
}
