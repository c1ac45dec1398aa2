//! The photographs of a model, and what they say of it.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use nightsplat_core::camera::Camera;
use nightsplat_core::input;
use nightsplat_models::edit::placement::Placement;
use nightsplat_models::gaussians::{Gaussians, ModelFacts};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::ToneSettings;

use crate::gpu::Gpu;
use crate::results::eval::{
    After, Evaluation, Extras, Metric, ModelRenderer, ReferenceKind, ScoreReference,
};
use crate::results::finished_run::{FinishedRun, Opener};
use crate::results::run;
use crate::splats::model::Model;
use crate::splats::render::RenderSettings;
use crate::targets::Targets;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The photographs of a model.
pub(super) struct ModelPhotographs {
    pub(super) gpu: Gpu,
    pub(super) config: TrainConfig,
    pub(super) dataset: Dataset,
    /// How the photographs become what the model was trained on; of a file that does not say, by the curve `auto`.
    tone: ToneSettings,
    /// Whether targets have other exposures than renders.
    pub(super) adjusts: bool,
    /// Whether the model says how its targets are made.
    states_targets: bool,
}

/// A larger mean relative error of a distance between two cameras is warned of.
const LARGE_ERROR: f64 = 0.05;

impl ModelPhotographs {
    pub(super) fn open(model: &Path, dataset: Option<&Path>, opener: &Opener) -> Result<Self> {
        let FinishedRun { gpu, config, dataset, states_targets, .. } =
            FinishedRun::open(model, dataset, opener)?;
        let tone = if states_targets { config.tone.clone() } else { ToneSettings::default() };
        let adjusts = !states_targets || config.exposure.learn;
        Ok(Self { gpu, config, dataset, tone, adjusts, states_targets })
    }

    /// The views for training, including those held out from it.
    pub(super) fn views(&self) -> impl Iterator<Item = &View> {
        self.dataset.views.iter().filter(|view| view.is_for_training())
    }

    /// The targets of [`ModelPhotographs::views`]; `None` without a photograph.
    pub(super) fn targets(&self) -> Result<Vec<Option<Image>>> {
        let targets = Targets::new(&self.gpu, &self.tone, &self.dataset)?;
        self.views().map(|view| targets.target(view)).collect()
    }

    /// The near plane of a model in the edited world, in its units.
    pub(super) fn near(&self, facts: &ModelFacts, placement: &Placement) -> f64 {
        let frame = placement.frame(&self.config.frame.unwrap_or_default());
        let near = facts.near.or(self.config.facts(&frame).near);
        near.unwrap_or(RenderSettings::default().near).into()
    }

    /// What the test views are scored against; `None` if that is not known.
    pub(super) fn score_reference(&self) -> Result<Option<ScoreReference>> {
        let reference = ScoreReference::new(&self.gpu, &self.config.tone, &self.dataset)?;
        let is_known = self.states_targets || reference.against == ReferenceKind::References;
        Ok(Some(reference).filter(|_| is_known))
    }

    /// The mean PSNR of a model on the test views, dB, with the networks of its run, if it is one; `None` without test
    /// views.
    pub(super) fn psnr(
        &self,
        run: Option<&Path>,
        gaussians: &Gaussians,
        facts: &ModelFacts,
        placement: &Placement,
        score_reference: &mut ScoreReference,
    ) -> Result<Option<f64>> {
        let Self { gpu, config, dataset, .. } = self;
        let frame = placement.frame(&config.frame.unwrap_or_default());
        let near = facts.near.or(config.facts(&frame).near);
        let model = Model::of_shown(gaussians.clone(), &ModelFacts { near, ..facts.clone() });
        let config = TrainConfig { frame: Some(frame), ..config.clone() };
        let features = gaussians.shape.features;
        let networks = match run {
            Some(run) => run::load_networks(gpu, run, &config.model, features)?,
            None => None,
        };
        let mut model_renderer = ModelRenderer::new(gpu, &model, &config, networks)?;
        if let Some(run) = run.filter(|_| !score_reference.is_evenly_lit(dataset)) {
            model_renderer.light_as(run, placement.scale)?;
        }
        let render = |view: &View| model_renderer.render_camera(&placement.camera(&view.camera));
        let evaluation =
            Evaluation::new(score_reference, dataset, &Extras::default(), render, |_| Ok(()))?;
        Ok(evaluation.mean(Metric::Psnr, After::Model))
    }

    /// The cameras of the training views.
    pub(super) fn cameras(&self) -> Vec<Camera> {
        self.views().map(|view| view.camera).collect()
    }

    /// Metres per unit of the dataset's world from a table of camera positions in metres: the least-squares ratio of
    /// the distances between all pairs of cameras. With a note on the fit.
    pub(super) fn metres_per_unit(&self, table: &Path) -> Result<(f64, String)> {
        let positions = camera_table(table)?;
        let pair = |view: &View| Some((view.camera.center(), *positions.get(&view.name)?));
        let pairs: Vec<(DVec3, DVec3)> = self.dataset.views.iter().filter_map(pair).collect();
        let (mut own_squares, mut products, mut squares) = (0.0, 0.0, 0.0);
        for (index, (position, metres)) in pairs.iter().enumerate() {
            for (other_position, other_metres) in &pairs[index + 1..] {
                let [a, b] = [position.distance(*other_position), metres.distance(*other_metres)];
                (own_squares, products, squares) =
                    (own_squares + a * a, products + a * b, squares + b * b);
            }
        }
        let factor = products / own_squares;
        if !(factor.is_finite() && factor > 0.0) {
            let problem = format!(
                "names {} cameras of the dataset; two at different places are the least",
                pairs.len()
            );
            return Err(Error::input(table, problem));
        }
        let error = ((squares - factor * products).max(0.0) / squares).sqrt();
        if error > LARGE_ERROR {
            tracing::warn!(
                "{}: distances between cameras differ by {:.0} %; are names and units right?",
                table.display(),
                100.0 * error
            );
        }
        let note =
            format!(": {} cameras in metres, distances within {:.2} %", pairs.len(), 100.0 * error);
        Ok((factor, note))
    }
}

/// Lines of a name and X, Y, Z, separated by commas or blanks; a first line without numbers and lines after # are
/// skipped. A name may have a file's extension.
fn camera_table(path: &Path) -> Result<BTreeMap<String, DVec3>> {
    let text = input::text(path)?;
    let mut table = BTreeMap::new();
    let lines = (1..).zip(text.lines().map(str::trim));
    for (number, line) in lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#')) {
        let words: Vec<&str> =
            line.split([',', ' ', '\t', ';']).filter(|word| !word.is_empty()).collect();
        let numbers: Option<Vec<f64>> =
            words.iter().skip(1).take(3).map(|word| word.parse().ok()).collect();
        let position = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
        match position.map(DVec3::from_array).filter(|position| position.is_finite()) {
            Some(position) => {
                let name = Path::new(words[0]).with_extension("");
                table.insert(name.to_string_lossy().into_owned(), position);
            }
            None if table.is_empty() && number == 1 => {}
            None => {
                let problem = format!("line {number} is not a name with three finite numbers");
                return Err(Error::input(path, problem));
            }
        }
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_table_has_a_name_and_three_numbers_on_each_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cameras.csv");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            camera_table(&path)
        };
        let table = read("name,x,y,z\n# metres\n001.png, 1, 2.5, -3\n002\t4 5 6 0.01\n").unwrap();
        assert_eq!(table["001"], DVec3::new(1.0, 2.5, -3.0));
        assert_eq!(table["002"], DVec3::new(4.0, 5.0, 6.0));
        for text in ["001 1 2 3\n002 1 2\n", "001 1 2 3\n002 1 nan 2\n"] {
            let refused = read(text).unwrap_err().to_string();
            assert!(refused.contains("line 2 is not a name"), "{refused}");
        }
    }
}
