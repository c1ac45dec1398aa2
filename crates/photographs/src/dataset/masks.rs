//! Masks of views: the listed one, `masks/NAME.png`, or `masks/NAME.jpg.png` as in COLMAP, `dynamic_mask_NAME.png` next
//! to the photograph, and the photograph's alpha.

use std::path::Path;

use super::listed::ViewEntry;
use crate::image::MaskFile;
use crate::image::files::PhotographFiles;

/// The folder of masks below the root.
const FOLDER: &str = "masks";
/// Prefix of masks next to their photographs, of moving objects (instant-ngp).
const MOVING: &str = "dynamic_mask_";

/// The mask of a photograph.
pub(super) fn find(root: &Path, frame: &ViewEntry, files: &PhotographFiles) -> Option<MaskFile> {
    if frame.mask.is_some() {
        return frame.mask.clone();
    }
    let folder = root.join(FOLDER);
    let file = frame.file.as_ref().and_then(|file| file.file_name()?.to_str());
    let names = [frame.below.clone(), frame.below.clone() + ".png"];
    let of_file = file.map(|file| format!("{file}.png"));
    let file = names.into_iter().chain(of_file).find_map(|name| files.find(&folder, &name));
    file.map(MaskFile::shown).or_else(|| moving(frame.file.as_ref()?, files))
}

/// The mask of moving objects.
fn moving(photograph: &Path, files: &PhotographFiles) -> Option<MaskFile> {
    let name = photograph.file_name()?.to_str()?;
    let path = files.find(photograph.parent()?, &format!("{MOVING}{name}"))?;
    Some(MaskFile { is_inverted: true, ..MaskFile::shown(path) })
}

/// The mask beside a photograph that no listing names.
pub fn beside(photograph: &Path, files: &PhotographFiles) -> Option<MaskFile> {
    let name = photograph.file_name()?.to_str()?;
    let folder = photograph.with_file_name(FOLDER);
    let named = [name.to_owned(), format!("{name}.png")].map(|name| files.find(&folder, &name));
    let named = named.into_iter().flatten().next().map(MaskFile::shown);
    named.or_else(|| moving(photograph, files))
}

/// Whether a file is a mask in a folder of photographs.
pub fn is_beside(file: &Path) -> bool {
    file.file_name().is_some_and(|name| name.to_string_lossy().starts_with(MOVING))
}
