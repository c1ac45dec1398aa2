//! The listing of a dataset: photographs with their cameras, before any pixel is read.

use std::collections::HashMap;
use std::path::Path;

use nightsplat_core::{Error, Result};

use super::exclude::exclude;
use super::layout::{CAMERAS, DatasetLayout};
use super::listed::{Listing, ViewEntry};
use super::locate::{self, Wanted};
use super::split::split;
use super::{LoadOptions, colmap, names, transforms, unused};
use crate::image::files::{self, PhotographFiles};

/// The views that the options select, split, by name.
pub(super) fn select(
    layout: &DatasetLayout,
    options: &LoadOptions,
    files: &PhotographFiles,
) -> Result<Listing> {
    let mut listing = list(layout, options.images.as_deref(), files)?;
    split(&layout.root, &mut listing.frames, options.test_every, files)?;
    exclude(&layout.root, &mut listing.frames, &options.exclude)?;
    if let Some(block) = &layout.block {
        block.restrict(&mut listing.frames)?;
    }
    Ok(listing)
}

/// The views by name, which is unique; their photographs are searched in `images` if given.
fn list(layout: &DatasetLayout, images: Option<&Path>, files: &PhotographFiles) -> Result<Listing> {
    let root = layout.root.as_path();
    let mut listing = Listing::default();
    let listings = layout.listings();
    if listings.is_empty() {
        list_colmap(layout, images, files, &mut listing)?;
    } else {
        transforms::read(root, images, &listings, files, &mut listing)?;
    }
    if listing.frames.is_empty() {
        let first = listing.skipped.first().map_or("its listing is empty", String::as_str);
        let problem = format!("has no usable view ({first}); export the cameras anew");
        return Err(Error::input(root, problem));
    }
    listing.has_split = listing.frames.iter().any(|frame| frame.split.is_some());
    names::disambiguate(&mut listing.frames);
    refuse_two_of_one_name(root, &listing.frames)?;
    listing.frames.sort_by(|a, b| a.name.cmp(&b.name));
    listing.remarks.extend(unused::remarks(root, &listing.frames));
    Ok(listing)
}

pub(super) fn warn(remarks: &[String]) {
    for remark in remarks {
        tracing::warn!("{remark}");
    }
}

fn list_colmap(
    layout: &DatasetLayout,
    images: Option<&Path>,
    files: &PhotographFiles,
    listing: &mut Listing,
) -> Result<()> {
    let root = layout.root.as_path();
    let models = layout.models(&CAMERAS);
    let folders = [root.to_owned(), root.join("images")];
    let exists = |name: &str| {
        folders.iter().any(|folder| files.find(folder, &name.replace('\\', "/")).is_some())
    };
    let Some((folder, counts)) = colmap::largest(&models, exists)? else {
        return Err(Error::input(root, layout.no_dataset()));
    };
    if counts.len() > 1 {
        let (taken, all) =
            (folder.strip_prefix(root).unwrap_or(folder).display(), counts.iter().sum::<usize>());
        let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
        listing.remarks.push(format!(
            "{}: COLMAP left {} models, of {} photographs; {taken}, the largest, is taken, and what the others place \
             of these {all} is not",
            root.display(),
            models.len(),
            counts.join(", "),
        ));
    }
    let lenses = colmap::read_cameras(folder)?;
    let placed = colmap::read_images(folder)?;
    let wanted = placed.iter().map(|image| Wanted {
        path: image.name.replace('\\', "/"),
        folders: folders.to_vec(),
        is_test: false,
    });
    let found = locate::photographs(root, images, wanted.collect(), files, listing);
    for (image, found) in placed.into_iter().zip(found) {
        let name = image.name.replace('\\', "/");
        let lens = lenses.get(&image.camera).copied().ok_or_else(|| {
            let camera = image.camera;
            let problem =
                format!("{name} has camera {camera}, which is not listed; export it anew");
            Error::input(folder, problem)
        })?;
        let Some(view_from_world) = image.view_from_world else {
            listing.skipped.push(format!("{name}: its pose is not finite"));
            continue;
        };
        listing.frames.push(ViewEntry {
            name: names::normalized(files::stem(&name)),
            listed: found.listed,
            below: found.below,
            split: None,
            file: found.file,
            lens,
            view_from_world,
            mask: None,
            depth: None,
        });
    }
    Ok(())
}

fn refuse_two_of_one_name(root: &Path, frames: &[ViewEntry]) -> Result<()> {
    let mut listed = HashMap::new();
    for frame in frames {
        if let Some(other) = listed.insert(&frame.name, &frame.listed) {
            let problem = format!(
                "two views are named {} ({other} and {}); rename or remove one, file names must differ",
                frame.name, frame.listed
            );
            return Err(Error::input(root, problem));
        }
    }
    Ok(())
}
