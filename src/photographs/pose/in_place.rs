//! What stays in place in photographs that move, such as a date burnt into them: COLMAP would take its features for those
//! of a scene at rest.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::pictures::PosePhotographs;
use super::unfinished::link_or_copy_to;
use crate::Result;
use crate::base::output::create_folder;
use crate::photographs::dataset::{Borders, LoadOptions};
use crate::photographs::image::Image;

/// Writes the mask of every photograph of which a part stays in place, for COLMAP. Says how much of them that is.
pub(super) fn mask(pictures: &PosePhotographs) -> Result<()> {
    for photographs in [&pictures.dark, &pictures.bright] {
        let found = find(pictures, photographs);
        let mut written: BTreeMap<(u32, u32), PathBuf> = BTreeMap::new();
        for photograph in photographs {
            let size = Image::size_of(photograph)?;
            let to = pictures.mask(photograph);
            if let Some(same) = written.get(&size) {
                link_or_copy_to(same, &to)?;
            } else if let Some(mask) = found.hide_borders(None, size) {
                tracing::warn!(
                    "{:.1} % of the photographs of {}x{} hardly changes between views that move, like a date burnt into \
                     them: no features are taken there, and masks/ of the dataset masks it",
                    100.0 * mask.hidden().len() as f64 / mask.weights.len() as f64,
                    size.0,
                    size.1
                );
                create_folder(to.parent().unwrap_or(&pictures.masks))?;
                mask.to_image().save_png8(&to)?;
                written.insert(size, to);
            }
        }
    }
    Ok(())
}

/// What `train` masks unasked, and what shows only in the tone-mapped copies.
fn find(pictures: &PosePhotographs, photographs: &[PathBuf]) -> Borders {
    let options = LoadOptions::default();
    let stored = Borders::of_files(photographs.iter().map(PathBuf::as_path), &options);
    let copies: Vec<PathBuf> = photographs.iter().map(|path| pictures.copy(path)).collect();
    let options = LoadOptions { mask_borders: false, ..options };
    stored.joined(Borders::of_files(copies.iter().map(PathBuf::as_path), &options))
}
