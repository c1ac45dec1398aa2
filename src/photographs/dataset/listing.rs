//! What a dataset lists: photographs with their cameras, before any pixel is read.

use std::collections::HashMap;
use std::path::Path;

use super::listed::{ListedView, Listing};
use super::{colmap, names, transforms, unused};
use crate::photographs::image::files::{self, Files};
use crate::{Error, Result};

/// The views by name, all different.
pub(super) fn list(root: &Path, files: &Files) -> Result<Listing> {
    if !root.is_dir() {
        let problem = if root.is_file() {
            "is a file, not a folder; of a clip `nightsplat pose` makes a dataset"
        } else {
            "is not a folder; name the dataset's folder"
        };
        return Err(Error::input(root, problem));
    }
    let mut listing = Listing::default();
    let listings = transforms::find(root);
    for (path, split) in &listings {
        transforms::read(root, path, *split, files, &mut listing)?;
    }
    if listings.is_empty() {
        list_colmap(root, files, &mut listing)?;
    }
    if listing.frames.is_empty() {
        let first = listing.skipped.first().map_or("its listing is empty", String::as_str);
        return Err(Error::input(
            root,
            format!("has no usable view ({first}); export the cameras anew"),
        ));
    }
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

fn list_colmap(root: &Path, files: &Files, listing: &mut Listing) -> Result<()> {
    let models = colmap::find(root, &["cameras", "images"]);
    let file_of =
        |name: &str| files.find(root, name).or_else(|| files.find(&root.join("images"), name));
    let chosen = colmap::largest(&models, |name| file_of(&name.replace('\\', "/")).is_some())?;
    let Some((folder, counts)) = chosen else {
        return Err(Error::input(root, no_dataset(root)));
    };
    if counts.len() > 1 {
        let (taken, all) =
            (folder.strip_prefix(root).unwrap_or(folder).display(), counts.iter().sum::<usize>());
        let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
        listing.remarks.push(format!(
            "{}: COLMAP left {} models, of {} photographs; {taken}, the largest, is taken, and what the others place of these {all} is not",
            root.display(),
            models.len(),
            counts.join(", "),
        ));
    }
    let lenses = colmap::read_cameras(folder)?;
    for image in colmap::read_images(folder)? {
        let name = image.name.replace('\\', "/");
        let lens = lenses.get(&image.camera).copied().ok_or_else(|| {
            Error::input(
                folder,
                format!("{name} has camera {}, which is not listed; export it anew", image.camera),
            )
        })?;
        let Some(view_from_world) = image.view_from_world else {
            listing.skipped.push(format!("{name}: its pose is not finite"));
            continue;
        };
        let beside_root = files.find(root, &name);
        let listed = if beside_root.is_some() { name.clone() } else { format!("images/{name}") };
        let file = beside_root.or_else(|| files.find(&root.join("images"), &name));
        let (name, below) = (files::stem(&name).to_owned(), name);
        let split = None;
        listing.frames.push(ListedView { name, listed, below, split, file, lens, view_from_world });
    }
    Ok(())
}

/// What there is in place of a dataset, and the remedy.
fn no_dataset(root: &Path) -> String {
    let expected = "transforms_train.json, transforms.json or a COLMAP model in sparse/0";
    match files::photographs_in(root).map_or(0, |photographs| photographs.len()) {
        0 => format!("holds no dataset; expected {expected}"),
        count => format!(
            "holds no dataset but {count} photographs, whose poses are not known; find them with `nightsplat pose {} --out DATASET` (expected {expected})",
            root.display()
        ),
    }
}

fn refuse_two_of_one_name(root: &Path, frames: &[ListedView]) -> Result<()> {
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
