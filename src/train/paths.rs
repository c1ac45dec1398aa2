//! The paths of a configuration, absolute or relative to its run.

use std::path::{Path, PathBuf};

use nightsplat_photographs::tone::Tone;

use super::config::TrainConfig;

impl TrainConfig {
    /// The configuration with absolute paths, as a run records it.
    pub(crate) fn with_absolute_paths(mut self) -> Self {
        for path in self.paths() {
            // Without a current folder the path stays relative.
            if let Ok(absolute) = std::path::absolute(&*path) {
                *path = absolute;
            }
        }
        self
    }

    /// The configuration of a run in `folder`, to which relative paths, in edited files, are relative.
    pub(crate) fn with_paths_from(mut self, folder: &Path) -> Self {
        for path in self.paths().into_iter().filter(|path| path.is_relative()) {
            *path = folder.join(&*path);
        }
        self
    }

    /// The paths that are set.
    fn paths(&mut self) -> Vec<&mut PathBuf> {
        let Self { dataset, reference, init, tone, model, exposure, .. } = self;
        let maps = [&mut model.depth_folder, &mut model.normal_folder];
        let optional =
            maps.into_iter().chain([reference, init, &mut tone.law, &mut exposure.start]);
        let targets = match &mut tone.curve {
            Tone::External(folder) => Some(folder),
            _ => None,
        };
        let paths = optional.flatten().chain(targets).chain([dataset]);
        paths.filter(|path| !path.as_os_str().is_empty()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_relative_path_starts_at_the_run_and_a_recorded_one_is_absolute() {
        let config = TrainConfig { dataset: "photos".into(), ..TrainConfig::default() };
        let resolved = config.clone().with_paths_from(Path::new("run"));
        assert_eq!(resolved.dataset, Path::new("run/photos"));
        assert_eq!(resolved.reference, None);
        assert!(config.with_absolute_paths().dataset.is_absolute());
        let none = TrainConfig::default();
        assert_eq!(none.clone().with_absolute_paths(), none);
    }
}
