//! The photographs of a reconstruction, and their names in it.

use std::path::{Path, PathBuf};

use super::tone_mapped;

/// The folder of the bright photographs, in the reconstruction and in the dataset.
pub(super) const BRIGHT: &str = "bright";

/// Dark photographs, and bright ones of the same scene through which they are posed.
pub(super) struct PosePhotographs {
    pub(super) dark: Vec<PathBuf>,
    pub(super) bright: Vec<PathBuf>,
    /// The folder of their tone-mapped copies.
    pub(super) copies: PathBuf,
    /// The folder of the masks of what stays in place, which have the names of the copies; it may be absent.
    pub(super) masks: PathBuf,
}

impl PosePhotographs {
    /// Leaves out those without a copy, which do not decode.
    pub(super) fn retain_copied(&mut self) {
        let copied = |paths: &[PathBuf]| -> Vec<PathBuf> {
            paths.iter().filter(|path| self.copy(path).is_file()).cloned().collect()
        };
        (self.dark, self.bright) = (copied(&self.dark), copied(&self.bright));
    }

    /// All photographs, the dark ones first.
    pub(super) fn all(&self) -> Vec<PathBuf> {
        [self.dark.as_slice(), self.bright.as_slice()].concat()
    }

    /// The name of a photograph's copy, relative to the folder of all.
    pub(super) fn name(&self, photograph: &Path) -> String {
        let name = tone_mapped::name(photograph);
        let is_bright = self.bright.iter().any(|bright| bright == photograph);
        if is_bright { format!("{BRIGHT}/{name}") } else { name }
    }

    /// The tone-mapped copy of a photograph.
    pub(super) fn copy(&self, photograph: &Path) -> PathBuf {
        self.copies.join(self.name(photograph))
    }

    /// The mask that COLMAP has of a photograph.
    pub(super) fn mask(&self, photograph: &Path) -> PathBuf {
        self.masks.join(self.name(photograph) + ".png")
    }
}

/// The name of a bright photograph without its folder; `None` of a dark one.
pub(super) fn bright_name(name: &str) -> Option<String> {
    name.strip_prefix(BRIGHT)?.strip_prefix('/').map(str::to_owned)
}

/// Whether a name is that of a dark photograph.
pub(super) fn is_dark(name: &str) -> bool {
    bright_name(name).is_none()
}
