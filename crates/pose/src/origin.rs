//! The photographs and options that cameras come from, in a line: what they differ in begins anew.

use std::path::Path;
use std::time::UNIX_EPOCH;

use nightsplat_core::hash::{self, Hasher};
use nightsplat_photographs::image::files::photographs_in;

use super::PoseOptions;

/// The line of these options, with a checksum of names, sizes and times of all files.
pub(super) fn line(options: &PoseOptions) -> String {
    let PoseOptions { photos, with, matcher, features, mapper, camera_model, fps, light, .. } =
        options;
    let mut hasher = Hasher::default();
    let mut count = 0;
    for folder in [Some(photos), with.as_ref()].into_iter().flatten() {
        for folder in [folder.clone(), folder.join("masks")] {
            let files = photographs_in(&folder).unwrap_or_else(|_| vec![folder]);
            for file in files {
                count += usize::from(add(&mut hasher, &file));
            }
        }
    }
    let chosen = format!(
        "{matcher:?} {features:?} {mapper:?} {camera_model} {fps} {light:?} {:?}",
        options.colmap_options
    );
    hasher.write(chosen.as_bytes());
    format!("cameras by nightsplat pose, of {count} files: {}\n", hash::text(hasher.finish()))
}

/// Adds a file; false if there is none.
fn add(hasher: &mut Hasher, file: &Path) -> bool {
    let Ok(facts) = file.metadata() else { return false };
    let changed = facts.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    hasher.write(file.file_name().unwrap_or_default().as_encoded_bytes());
    hasher.write(format!("{} {changed:?}", facts.len()).as_bytes());
    true
}
