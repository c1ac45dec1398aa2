//! Presets: trade-offs of time and quality, and the constants of the paper and its code for a benchmark.
//!
//! They are files in `presets/`: the settings of config.toml that differ from the defaults.

use std::path::Path;
use std::str::FromStr;

use nightsplat_photographs::tone::{Tone, ToneCurve};
use toml::Value;

use super::config::TrainConfig;
use super::layers::{Origin, SettingsLayer};
use crate::{Error, Result};

/// A trade-off of time and quality, or a benchmark of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// A first look.
    Draft,
    /// A good score in few steps.
    Fast,
    /// The defaults: the best score per second.
    Balanced,
    /// The best score.
    Best,
    /// The paper's curve, number of steps and density control, without a diagnosis.
    Paper,
    /// LOM: `bike`, `buu`, `chair`, `shrub`, `sofa`.
    Lom,
    /// The low-light scenes of `RealX3D`.
    RealX3d,
    /// MipNeRF360 with varying exposures.
    Mip360Varying,
}

impl Preset {
    /// Every preset.
    pub const ALL: [Self; 8] = [
        Self::Draft,
        Self::Fast,
        Self::Balanced,
        Self::Best,
        Self::Paper,
        Self::Lom,
        Self::RealX3d,
        Self::Mip360Varying,
    ];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Draft => "draft",
            Self::Fast => "fast",
            Self::Balanced => "balanced",
            Self::Best => "best",
            Self::Paper => "paper",
            Self::Lom => "lom",
            Self::RealX3d => "realx3d",
            Self::Mip360Varying => "mip360-varying",
        }
    }

    /// The preset's differences from the defaults, as TOML; a benchmark has those of the paper and additional ones that
    /// depend on curve and scene.
    pub(crate) fn toml(self) -> &'static str {
        match self {
            Self::Draft => include_str!("presets/draft.toml"),
            Self::Fast => include_str!("presets/fast.toml"),
            Self::Balanced => include_str!("presets/balanced.toml"),
            Self::Best => include_str!("presets/best.toml"),
            Self::Paper | Self::Lom | Self::RealX3d | Self::Mip360Varying => {
                include_str!("presets/paper.toml")
            }
        }
    }

    /// Whether a run with this preset is planned by a diagnosis of its photographs.
    #[doc(hidden)]
    pub fn is_planned(self) -> bool {
        matches!(self, Self::Draft | Self::Fast | Self::Balanced | Self::Best)
    }

    /// Whether it has the constants of one of the paper's benchmarks.
    pub(crate) fn is_benchmark(self) -> bool {
        matches!(self, Self::Lom | Self::RealX3d | Self::Mip360Varying)
    }

    /// Applies the preset for the configuration's curve; the paper's presets replace the automatic curve by AP3.
    ///
    /// # Errors
    /// Never.
    pub fn apply(self, config: &mut TrainConfig) -> Result<()> {
        let curve = Some(&config.tone.curve).filter(|&curve| *curve != Tone::Auto).map(Tone::name);
        *config = config.overlaid(&self.layer(curve, &config.dataset)?)?;
        Ok(())
    }

    /// The preset's settings for the curve of this name. A benchmark has the paper's constants and, if its code has a
    /// file for the scene that the dataset's folder is named after, that file's.
    pub(super) fn layer(self, curve: Option<&str>, dataset: &Path) -> Result<SettingsLayer> {
        let origin = Origin::Preset(self.name());
        let mut layer = SettingsLayer::of_toml(self.toml(), &origin)?;
        let mut set = |key: &str, value: Value| layer.push(key, value, origin.clone());
        if let (false, Some(curve)) = (self.is_planned(), curve) {
            set("tone.curve", curve.into())?;
        }
        if !self.is_benchmark() {
            return Ok(layer);
        }
        let is_realx3d = self == Self::RealX3d;
        let curve = curve.unwrap_or(ToneCurve::Ap3.name());
        let [of_ase, of_ap3] = match self {
            Self::Lom => [3.0, 1.0],
            Self::RealX3d => [4.0, 2.0],
            _ => [0.0, 0.0],
        };
        match curve.parse() {
            Ok(ToneCurve::Ase) => set("tone.gain_c", of_ase.into())?,
            Ok(ToneCurve::Ap3) => set("tone.gain_c", of_ap3.into())?,
            _ => {}
        }
        if curve != Tone::Auto.name() {
            set("tone.alpha", 0.12.into())?;
        }
        set("tone.theta", if is_realx3d { 0.37 } else { 0.49 }.into())?;
        set("max_resolution", 0.into())?;
        set("steps", if self == Self::Lom { 5_000 } else { 15_000 }.into())?;
        set("ssim_weight", if is_realx3d { 0.2 } else { 0.0 }.into())?;
        let folder = dataset.canonicalize().unwrap_or_else(|_| dataset.to_owned());
        let scene = folder.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let of_scene: &[(&str, f64)] = match (self, scene.as_str()) {
            (Self::Lom, "chair") => &[("model.weights.low_ssim", 0.5)],
            (Self::Lom, "sofa") => {
                set("schedule.means_rate_steps", 10_000.into())?;
                &[("ssim_weight", 0.25)]
            }
            (Self::Lom, "shrub") => {
                set("schedule.means_rate_steps", 20_000.into())?;
                set("model.network.stages", 6.into())?;
                &[
                    ("ssim_weight", 0.4),
                    ("schedule.initial_rates.means", 2.5e-4),
                    ("schedule.final_means_rate", 2.5e-6),
                ]
            }
            (Self::RealX3d, "bluehawaii") => &[("ssim_weight", 0.0)],
            _ => return Ok(layer),
        };
        tracing::info!("preset {}: the constants of scene {scene}", self.name());
        of_scene.iter().try_for_each(|&(key, value)| set(key, value.into()))?;
        Ok(layer)
    }
}

impl std::fmt::Display for Preset {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str(self.name())
    }
}

impl FromStr for Preset {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|preset| preset.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown preset `{name}`; the presets are {names}"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::Weights;
    use crate::networks::NetworkVariant;
    use crate::splats::densify::DensityControl;
    use crate::splats::optimizer::Schedule;
    use crate::train::{DensityConfig, ModelConfig};
    use nightsplat_models::attributes::Attribute;
    use nightsplat_models::gaussians::init::Initialization;
    use nightsplat_photographs::tone::ToneSettings;

    fn applied(preset: Preset, scene: &str, curve: impl Into<Tone>) -> TrainConfig {
        let tone = ToneSettings::new(curve);
        let mut config =
            TrainConfig { dataset: Path::new("data").join(scene), tone, ..Default::default() };
        preset.apply(&mut config).unwrap();
        config
    }

    const BENCHMARKS: [Preset; 3] = [Preset::Lom, Preset::RealX3d, Preset::Mip360Varying];

    const PAPER: [Preset; 4] = [Preset::Paper, Preset::Lom, Preset::RealX3d, Preset::Mip360Varying];

    #[test]
    fn only_the_paper_and_its_benchmarks_have_its_density_control() {
        for preset in Preset::ALL {
            let config = applied(preset, "x", ToneCurve::Ap3);
            let is_paper = config.density.control == DensityControl::Paper;
            assert_eq!(is_paper, PAPER.contains(&preset), "{preset:?}");
            assert_eq!(is_paper, config.schedule.densify_after == 500, "{preset:?}");
            assert_eq!(is_paper, config.start == Initialization::PAPER, "{preset:?}");
            assert_eq!(
                is_paper,
                config.model.network.variant == NetworkVariant::Paper,
                "{preset:?}"
            );
            assert_eq!(is_paper, config.model.weights == Weights::paper(), "{preset:?}");
            config.check().unwrap();
        }
    }

    #[test]
    fn balanced_is_the_default_and_paper_is_the_paper_added_to_the_bare_method() {
        assert_eq!(
            applied(Preset::Balanced, "x", Tone::Auto),
            TrainConfig { dataset: "data/x".into(), ..TrainConfig::default() }
        );
        let mut model = ModelConfig::default();
        model.follow_paper();
        let expected = TrainConfig {
            dataset: "data/x".into(),
            tone: ToneSettings::default().with_curve(ToneCurve::Ap3),
            start: Initialization::PAPER,
            schedule: Schedule::paper(),
            density: DensityConfig::paper(),
            model,
            ..TrainConfig::bare()
        };
        assert_eq!(applied(Preset::Paper, "x", Tone::Auto), expected);
        assert!(!Preset::Paper.is_planned() && Preset::Balanced.is_planned());
    }

    #[test]
    fn a_preset_changes_only_its_own_settings() {
        let mut config = TrainConfig { seed: 4, ..Default::default() };
        config.schedule.means_rate_steps = 7;
        Preset::Draft.apply(&mut config).unwrap();
        assert_eq!((config.seed, config.schedule.means_rate_steps), (4, 7));
        assert_eq!((config.sh_degree, config.schedule.densify_interval), (0, 50));
    }

    #[test]
    fn c_follows_benchmark_and_curve() {
        for (preset, [ase, ap3]) in BENCHMARKS.into_iter().zip([[3.0, 1.0], [4.0, 2.0], [0.0, 0.0]])
        {
            assert_eq!(applied(preset, "x", ToneCurve::Ase).tone.gain_c, ase);
            assert_eq!(applied(preset, "x", ToneCurve::Ap3).tone.gain_c, ap3);
        }
    }

    #[test]
    fn a_scene_of_the_papers_code_has_its_own_constants() {
        let shrub = applied(Preset::Lom, "shrub", ToneCurve::Ap3);
        assert_eq!((shrub.steps, shrub.ssim_weight, shrub.model.network.stages), (5_000, 0.4, 6));
        assert_eq!(shrub.schedule.initial_rates[Attribute::Means], 2.5e-4);
        assert_eq!(applied(Preset::Lom, "chair", ToneCurve::Ap3).model.weights.low_ssim, 0.5);
        assert_eq!(applied(Preset::RealX3d, "BlueHawaii", ToneCurve::Ap3).ssim_weight, 0.0);
        let cupcake = applied(Preset::RealX3d, "Cupcake", ToneCurve::Linear);
        assert_eq!((cupcake.steps, cupcake.ssim_weight, cupcake.tone.theta), (15_000, 0.2, 0.37));
    }
}
