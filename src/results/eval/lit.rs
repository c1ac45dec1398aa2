//! Scores in the light of the lamp at the camera, against `lit/` of a dataset.

use std::path::PathBuf;

use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::{Image, ImageFile};

use super::{After, Evaluation, ReferenceKind, aligned, quantized};
use crate::Result;
use crate::train::Rendered;

/// The test views in the light of the lamp at the camera, bright and without noise, if a dataset has these.
pub(super) fn lit_folder(dataset: &Dataset) -> PathBuf {
    dataset.root.join("lit")
}

impl Evaluation {
    /// Adds the scores in the light of the lamp; `render` renders a view in this light.
    pub(crate) fn add_lit(
        &mut self,
        dataset: &Dataset,
        mut render: impl FnMut(&View) -> Result<Rendered>,
    ) -> Result<()> {
        let folder = lit_folder(dataset);
        let names: Vec<String> = self.views().into_iter().map(str::to_owned).collect();
        for name in names {
            let path = folder.join(format!("{name}.png"));
            let view = dataset.test_views().find(|view| view.name == name);
            let Some(view) = view.filter(|_| path.is_file()) else { continue };
            let (width, height) = (view.camera.width, view.camera.height);
            let target = quantized(&Image::load(&path)?.resized(width, height));
            let scores = aligned(&quantized(render(view)?.output()), &target)?;
            self.add(&name, &scores, ReferenceKind::LitByLamp, After::LampLight);
        }
        Ok(())
    }
}
