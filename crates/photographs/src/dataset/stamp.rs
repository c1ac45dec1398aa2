//! Detects without decoding whether a dataset has changed.

use std::path::Path;

use nightsplat_core::Result;
use nightsplat_core::hash::{self, Hasher};

use super::layout::DatasetLayout;
use super::listed::Listing;
use super::listing::select;
use super::source::ViewFiles;
use super::{Dataset, LoadOptions, sources};
use crate::image::files::PhotographFiles;
use crate::tree;

impl Dataset {
    /// A checksum of the listing below `root`: views with their cameras and splits, and path, length and time of change
    /// of every file of the views or the points. Equal stamps mean the same dataset; one that was copied, or whose
    /// photographs were rewritten, has another stamp even with the same pixels; one that was moved has the same.
    #[doc(hidden)]
    pub fn stamp(root: &Path, options: &LoadOptions) -> Result<String> {
        options.check()?;
        let files = PhotographFiles::default();
        let layout = DatasetLayout::detect(root)?;
        let root = layout.root.as_path();
        let Listing { frames, mut skipped, .. } = select(&layout, options, &files)?;
        let mut hasher = Hasher::default();
        hasher.write(READING);
        for point in layout.block.iter().flat_map(|block| &block.points) {
            hasher.write(&point.to_le_bytes());
        }
        for source in sources(root, &frames, options, &files, &mut skipped) {
            // The Debug output distinguishes all cameras.
            let view = format!("{} {:?} {:?}", source.name, source.split, source.lens);
            hasher.write(view.as_bytes());
            hasher.write_numbers(&source.view_from_world.to_cols_array());
            let mask = source.mask.as_ref().map(|mask| mask.path.clone());
            let ViewFiles { input, reference, target, depth, normals, .. } = &source;
            for file in [input, reference, target, &mask, depth, normals] {
                file.iter().for_each(|path| write_file(&mut hasher, root, path));
            }
        }
        let folders = layout.models(&["images", "points3D"]);
        for folder in folders.iter().map(|folder| folder.as_path()).chain([root]) {
            let mut paths = tree::entries(folder).unwrap_or_default();
            paths.sort();
            paths
                .iter()
                .filter(|path| tree::is_file(path))
                .for_each(|path| write_file(&mut hasher, root, path));
        }
        Ok(hash::text(hasher.finish()))
    }
}

/// Of how files are read: another where the same file gives other pixels than before.
const READING: &[u8] = b"in sRGB, signed, at the levels of the set, turned by what points show";

/// Files in the dataset by their path from its root, which may be spelled otherwise, and moved.
fn write_file(hasher: &mut Hasher, root: &Path, path: &Path) {
    hasher.write(path.strip_prefix(root).unwrap_or(path).as_os_str().as_encoded_bytes());
    let Ok((length, changed)) = tree::metadata(path) else { return };
    // The Debug output distinguishes all times.
    let changed = format!("{changed:?}");
    hasher.write(&length.to_le_bytes());
    hasher.write(changed.as_bytes());
}
