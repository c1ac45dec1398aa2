//! Pictures of a dataset's views that another program rendered, in a folder by the names of the views.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::{Error, Result};

use super::{Dataset, View};
use crate::image::files::{PhotographFiles, normalized, photographs_in, stem};
use crate::image::{Image, ImageFile as _};

/// A picture of every test view that can be scored.
#[derive(Clone, Debug)]
pub struct ViewPictures {
    by_view: BTreeMap<String, PathBuf>,
}

impl ViewPictures {
    /// The pictures in `folder` of the dataset's test views that can be scored. Warns of files that no view is named
    /// like.
    ///
    /// # Errors
    /// [`Error::Input`] if a test view has no picture.
    pub fn of_tests(folder: &Path, dataset: &Dataset) -> Result<Self> {
        let found = photographs_in(folder)?;
        let files = PhotographFiles::default();
        let (mut by_view, mut missing) = (BTreeMap::new(), vec![]);
        let scored = |view: &&View| view.has_reference() || view.has_photograph();
        for View { name, .. } in dataset.test_views().filter(scored) {
            match files.find(folder, name) {
                Some(file) => drop(by_view.insert(name.clone(), file)),
                None => missing.push(name.as_str()),
            }
        }
        let is_of_view = |name: &str| dataset.views.iter().any(|view| view.name == name);
        let names = found.iter().filter_map(|file| file.file_name()?.to_str());
        let extra: Vec<&str> = names.filter(|name| !is_of_view(&normalized(stem(name)))).collect();
        let listed = |names: &[&str]| match names {
            [first, second, _, _, ..] => format!("{first}, {second} and {} more", names.len() - 2),
            _ => names.join(", "),
        };
        if !missing.is_empty() {
            let others = if extra.is_empty() { "no others" } else { &listed(&extra) };
            let problem = format!(
                "has no picture of the test views {}, and of other names {others}; name each picture like its view",
                listed(&missing)
            );
            return Err(Error::input(folder, problem));
        }
        if !extra.is_empty() {
            tracing::warn!("{}: no view is named like {}", folder.display(), listed(&extra));
        }
        Ok(Self { by_view })
    }

    /// The picture of a test view, of its camera's size; in the file it is upright or as the photograph is stored.
    ///
    /// # Errors
    /// [`Error::Input`] if it cannot be read, or has another size.
    pub fn load(&self, view: &View) -> Result<Image> {
        let missing = || Error::input(&view.name, "has no picture");
        let path = self.by_view.get(&view.name).ok_or_else(missing)?;
        let image = Image::load(path)?;
        let (size, taken) = ((image.width, image.height), (view.camera.width, view.camera.height));
        if size == view.orientation.size(taken) {
            return Ok(view.orientation.inverse().upright(image));
        }
        if size == taken {
            return Ok(image);
        }
        let ((width, height), (w, h)) = (size, taken);
        let problem = format!(
            "is {width}x{height}, its view {w}x{h}; render at that size, or score at another with --downscale"
        );
        Err(Error::input(path, problem))
    }
}
