//! Photographs that lie outside of the folder of their dataset: a listing or a link of someone else can name any file.

use std::path::Path;

use super::LoadOptions;
use super::layout::DatasetLayout;
use super::source::ViewFiles;
use crate::tree;

/// A line that counts them and names the first; `None` if there are none, or their folder is named by the user.
pub(super) fn remark(
    layout: &DatasetLayout,
    sources: &[ViewFiles],
    options: &LoadOptions,
) -> Option<String> {
    // A block lists the photographs of its scene; no path leads out of an archive.
    if options.images.is_some()
        || layout.block.is_some()
        || tree::archive_of(&layout.root).is_some()
    {
        return None;
    }
    let root = layout.root.canonicalize().ok()?;
    let is_outside = |path: &&Path| path.canonicalize().is_ok_and(|path| !path.starts_with(&root));
    let photographs = sources.iter().filter_map(|source| source.input.as_deref());
    let outside: Vec<&Path> = photographs.filter(is_outside).collect();
    let first = outside.first()?.display();
    let count = outside.len();
    Some(format!(
        "photographs that lie outside of the dataset's folder: {count}, {first} the first; pages and renders show \
         them; `--images DIR` says where they are meant to lie"
    ))
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use crate::image::ImageFile as _;
    use std::path::PathBuf;

    use super::super::Dataset;
    use super::*;
    use crate::image::Image;

    /// The remarks on a dataset that lists these files.
    fn remarks(root: &Path, files: &[PathBuf], options: &LoadOptions) -> Vec<String> {
        let identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
        let frame =
            |file: &PathBuf| serde_json::json!({ "file_path": file, "transform_matrix": identity });
        let frames: Vec<_> = files.iter().map(frame).collect();
        let listing = serde_json::json!({ "camera_angle_x": 1.0, "frames": frames });
        std::fs::write(root.join("transforms_train.json"), listing.to_string()).unwrap();
        Dataset::listed(root, options).unwrap().2
    }

    #[test]
    fn photographs_outside_of_the_dataset_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let [root, other] = ["scene", "other"].map(|name| folder.path().join(name));
        for (folder, name) in [(&root, "a.png"), (&other, "b.png")] {
            std::fs::create_dir(folder).unwrap();
            Image::filled(20, 20, [0.1; 3]).save_png8(folder.join(name)).unwrap();
        }
        std::os::unix::fs::symlink(other.join("b.png"), root.join("c.png")).unwrap();
        let options = LoadOptions::default();
        let outside = |lines: Vec<String>| {
            lines.into_iter().filter(|line| line.contains("lie outside")).collect::<Vec<_>>()
        };
        assert!(outside(remarks(&root, &["a.png".into()], &options)).is_empty());
        let files = ["a.png".into(), "c.png".into(), other.join("b.png")];
        let lines = outside(remarks(&root, &files, &options));
        assert!(lines.len() == 1 && lines[0].contains("folder: 2, "), "{lines:?}");
        let meant = LoadOptions { images: Some(other), ..options };
        assert!(outside(remarks(&root, &["b.png".into()], &meant)).is_empty());
    }
}
