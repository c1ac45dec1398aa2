//! What stays in place in photographs that move, such as a date burnt into them: COLMAP would take its features for
//! those of a scene at rest.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::output::create_folder;
use nightsplat_photographs::dataset::{Borders, LoadOptions, mask_beside};
use nightsplat_photographs::image::files::PhotographFiles;
use nightsplat_photographs::image::{Image, ImageFile, Mask};

use super::pictures::PosePhotographs;
use super::unfinished::link_or_copy_to;
use nightsplat_core::Result;

/// Writes for COLMAP what is masked of each photograph: what stays in place, and what a mask beside the photograph
/// hides. Says how much stays in place.
///
/// # Errors
/// A mask that cannot be read or has another aspect ratio than its photograph.
pub(super) fn mask(pictures: &PosePhotographs) -> Result<()> {
    let files = PhotographFiles::default();
    for photographs in [&pictures.dark, &pictures.bright] {
        let found = find(pictures, photographs);
        let mut written: BTreeMap<(u32, u32), PathBuf> = BTreeMap::new();
        for photograph in photographs {
            let (size, to) = (Image::size_of(photograph)?, pictures.mask(photograph));
            if let Some(beside) = mask_beside(photograph, &files) {
                let mask = Mask::load(photograph, Some(&beside.path), beside.is_inverted)?;
                write(found.hide_borders(mask, size), &to)?;
            } else if let Some(same) = written.get(&size) {
                link_or_copy_to(same, &to)?;
            } else if let Some(mask) = found.hide_borders(None, size) {
                say(&mask);
                write(Some(mask), &to)?;
                written.insert(size, to);
            }
        }
    }
    Ok(())
}

fn say(mask: &Mask) {
    tracing::warn!(
        "{:.1} % of the photographs of {}x{} hardly changes between views that move, like a date burnt into them: no \
         features are taken there, and masks/ of the dataset masks it",
        100.0 * mask.hidden().len() as f64 / mask.weights.len() as f64,
        mask.width,
        mask.height
    );
}

/// Writes a mask, if there is one.
fn write(mask: Option<Mask>, path: &Path) -> Result<()> {
    let Some(mask) = mask else { return Ok(()) };
    create_folder(path.parent().unwrap_or(path))?;
    mask.to_image().save_png8(path)
}

/// What `train` masks unasked, and what shows only in the tone-mapped copies, however dim.
fn find(pictures: &PosePhotographs, photographs: &[PathBuf]) -> Borders {
    let options = LoadOptions::default();
    let stored = Borders::of_files(photographs.iter().map(PathBuf::as_path), &options);
    let copies: Vec<PathBuf> = photographs.iter().map(|path| pictures.copy(path)).collect();
    let options = LoadOptions { mask_borders: false, ..options };
    let copies = || copies.iter().map(PathBuf::as_path);
    stored.joined(Borders::of_files(copies(), &options)).joined(Borders::still_in(copies()))
}
