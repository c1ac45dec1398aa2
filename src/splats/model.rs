//! A model with what a renderer must know of it.

use std::borrow::Cow;

use glam::{DAffine3, DQuat};
use nightsplat_core::camera::deviation_from_rigid;
use nightsplat_core::curves::SceneLaw;
use nightsplat_models::gaussians::{Features, Gaussians, ModelFacts};
#[cfg(any(test, not(feature = "train")))]
use {
    nightsplat_core::input, nightsplat_models::file_kind::FileKind,
    nightsplat_models::gaussians::ply,
};

use crate::splats::render::RenderSettings;
use crate::{Error, Result};

/// A model with what a renderer must know of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// In the world of their dataset, relative to their origin. Their colours are those that `raw_colors` is about.
    pub gaussians: Gaussians,
    /// The near plane, in world units.
    pub near: f32,
    /// The largest alpha of a splat on a pixel; below 1.
    pub max_alpha: f32,
    /// Colours are the raw SH sum, which can be negative, instead of max(SH + 0.5, 0).
    pub raw_colors: bool,
    /// Opacities are those of a renderer that compensates them for the dilation.
    pub antialiased: bool,
    /// The curve from its photographs to its colours, which [`Target::is_photograph`](crate::Target::is_photograph)
    /// inverts; `None`: not stated.
    pub law: Option<SceneLaw>,
    /// The settings of its run that make its targets from photographs, as a file states them.
    #[doc(hidden)]
    pub targets: Option<String>,
}

/// Near plane, alpha limit and colours are those of a file that does not state them.
impl From<Gaussians> for Model {
    fn from(gaussians: Gaussians) -> Self {
        let RenderSettings { near, max_alpha, raw_colors, antialiased, .. } =
            RenderSettings::default();
        Self { gaussians, near, max_alpha, raw_colors, antialiased, law: None, targets: None }
    }
}

impl Model {
    /// Gaussians in their own colours, and what is stated of them.
    pub(crate) fn new(gaussians: Gaussians, facts: &ModelFacts) -> Self {
        let defaults = Self::from(gaussians);
        Self {
            near: facts.near.unwrap_or(defaults.near),
            max_alpha: facts.max_alpha.unwrap_or(defaults.max_alpha),
            raw_colors: facts.raw_colors.unwrap_or(defaults.raw_colors),
            antialiased: facts.antialiased,
            law: facts.law,
            targets: facts.targets.clone(),
            ..defaults
        }
    }

    /// As [`Model::new`], of Gaussians in the colours that viewers show, as files hold them.
    pub(crate) fn of_shown(gaussians: Gaussians, facts: &ModelFacts) -> Self {
        let mut model = Self::new(gaussians, facts);
        if model.raw_colors {
            model.gaussians.shift_colors(0.5);
        }
        model
    }

    /// The settings of a renderer that shows the model as it was trained.
    ///
    /// ```no_run
    /// use nightsplat::{DeviceChoice, Gpu, Model, Renderer};
    ///
    /// let gpu = Gpu::new(&DeviceChoice::Best)?;
    /// let model = Model::load("model.ply")?;
    /// let renderer = Renderer::new(&gpu, model.render_settings())?;
    /// # Ok::<(), nightsplat::Error>(())
    /// ```
    pub fn render_settings(&self) -> RenderSettings {
        let Self { gaussians, near, max_alpha, raw_colors, antialiased, law, .. } = self;
        RenderSettings {
            near: *near,
            max_alpha: *max_alpha,
            raw_colors: *raw_colors,
            antialiased: *antialiased,
            law: *law,
            shape: gaussians.shape,
            ..RenderSettings::default()
        }
    }

    /// One model of several, each turned and moved by a rigid pose, so that all are sorted together. Near plane, alpha
    /// limit and colours are the first one's, and its law where all have it; positions are relative to its origin, and
    /// to none where they are moved.
    #[doc(hidden)]
    pub fn join(parts: &[(&Self, DAffine3)]) -> Result<Self> {
        let [(first, _), ..] = parts else {
            return Err(Error::Usage("no models to join; pass at least one".to_owned()));
        };
        let sh_degree = parts.iter().map(|(part, _)| part.gaussians.shape.sh_degree).max();
        let count = parts.iter().map(|(part, _)| part.gaussians.count).sum();
        let mut joined = Gaussians::try_zeros(count, sh_degree.unwrap_or_default())?;
        let mut at = 0;
        for (index, (part, pose)) in parts.iter().enumerate() {
            let refuse = |problem: &str| Err(Error::Usage(format!("model {index} {problem}")));
            if deviation_from_rigid(pose).is_some() {
                return refuse("has a pose that is not rigid; take scale and reflection out");
            }
            let appearance = |part: &Self| (part.raw_colors, part.max_alpha, part.antialiased);
            if appearance(part) != appearance(first) {
                return refuse("has other colours, alpha limit or antialiasing than the first");
            }
            let shown = part.gaussians.with_features(Features::NONE);
            let mut moved = shown
                .with_sh_degree(joined.shape.sh_degree)
                .rotated(DQuat::from_mat3(&pose.matrix3));
            let offset = moved.origin + pose.translation;
            for mean in moved.means_mut() {
                *mean = (mean.as_dvec3() + offset).as_vec3();
            }
            joined.replace(at, &moved);
            at += moved.count;
        }
        let is_one = parts.iter().all(|(part, _)| part.law == first.law);
        let law = first.law.filter(|_| is_one);
        let Self { near, max_alpha, raw_colors, antialiased, .. } = **first;
        let targets = None;
        Ok(Self { gaussians: joined, near, max_alpha, raw_colors, antialiased, law, targets })
    }

    /// The Gaussians in the colours that viewers show, as files hold them.
    pub(crate) fn shown(&self) -> Cow<'_, Gaussians> {
        let mut shown = Cow::Borrowed(&self.gaussians);
        if self.raw_colors {
            shown.to_mut().shift_colors(-0.5);
        }
        shown
    }

    /// What a file states of the model.
    pub(crate) fn facts(&self) -> ModelFacts {
        ModelFacts {
            near: Some(self.near),
            max_alpha: Some(self.max_alpha),
            raw_colors: Some(self.raw_colors),
            antialiased: self.antialiased,
            linear: None,
            law: self.law,
            targets: self.targets.clone(),
            origin: self.gaussians.origin,
        }
    }

    /// Reads a model: a PLY in the INRIA layout, recognised by its content. A build with the feature `train` reads SPZ,
    /// SOG and run directories as well.
    ///
    /// The near plane, the alpha limit and the colours are those that the file states (`comment nightsplat near 0.1`),
    /// and else those of [`RenderSettings::default`].
    ///
    /// # Errors
    /// [`Error::Input`] where the file is missing, no model, cut short or not finite, or needs the feature `train`.
    #[cfg(not(feature = "train"))]
    pub fn load(path: impl AsRef<std::path::Path>) -> Result<Self> {
        load_ply(path.as_ref())
    }
}

/// What a build without the feature `train` reads.
#[cfg(any(test, not(feature = "train")))]
fn load_ply(path: &std::path::Path) -> Result<Model> {
    const REMEDY: &str = "is read by a build with the feature `train`; export it to PLY";
    if path.is_dir() {
        return Err(Error::input(path, format!("is a folder; a run directory {REMEDY}")));
    }
    let bytes = input::bytes(path)?;
    match FileKind::from_bytes(&bytes) {
        Some(kind @ (FileKind::Spz | FileKind::Sog)) => {
            let name = format!("{kind:?}").to_uppercase();
            Err(Error::input(path, format!("{name} {REMEDY}")))
        }
        _ => {
            let (gaussians, facts) =
                ply::parse(&bytes).map_err(|problem| Error::input(path, problem))?;
            Ok(Model::of_shown(gaussians, &facts))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_files_a_ply_is_read_and_the_rest_names_the_feature() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        let model = Model { near: 0.05, max_alpha: 0.5, ..Gaussians::zeros(3, 1).into() };
        let comments = model.facts().lines();
        ply::save_with_comments(&model.gaussians, &path, &comments).unwrap();
        assert_eq!(load_ply(&path).unwrap(), model);
        let refused = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            load_ply(&path).unwrap_err().to_string()
        };
        let remedy = "is read by a build with the feature `train`; export it to PLY";
        assert!(refused(b"NGSP").ends_with(&format!("model: SPZ {remedy}")));
        assert!(refused(b"PK\x03\x04").ends_with(&format!("model: SOG {remedy}")));
        assert!(refused(b"solid").contains("is not a PLY file"));
        let folder = load_ply(folder.path()).unwrap_err().to_string();
        assert!(folder.ends_with(&format!("is a folder; a run directory {remedy}")), "{folder}");
    }
}
