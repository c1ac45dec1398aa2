//! Presets: how much time a run takes for its score, and every constant that the paper and its code state for a benchmark.
//!
//! Those of the first kind are files in `presets/`: settings as config.toml has them, over whatever is set already.

use std::str::FromStr;

use super::{DensityConfig, TrainConfig};
use crate::photographs::tone::ToneCurve;
use crate::splats::attributes::Attribute;
use crate::splats::optimizer::Schedule;
use crate::splats::scene::init::Start;
use crate::{Error, Result};

/// A trade of time for quality, or a benchmark that the paper reports.
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
    /// The paper's curve, length and density control; nothing is diagnosed.
    Paper,
    /// LOM: `bike`, `buu`, `chair`, `shrub`, `sofa`.
    Lom,
    /// The low-light scenes of `RealX3D`.
    RealX3d,
    /// MipNeRF360 with exposures that vary.
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

    /// The settings of a preset that trades time for quality, as TOML; a benchmark's depend on curve and scene.
    pub fn toml(self) -> Option<&'static str> {
        match self {
            Self::Draft => Some(include_str!("presets/draft.toml")),
            Self::Fast => Some(include_str!("presets/fast.toml")),
            Self::Balanced => Some(include_str!("presets/balanced.toml")),
            Self::Best => Some(include_str!("presets/best.toml")),
            Self::Paper => Some(include_str!("presets/paper.toml")),
            Self::Lom | Self::RealX3d | Self::Mip360Varying => None,
        }
    }

    /// Whether a run with this preset is planned by a diagnosis of its photographs.
    pub fn is_planned(self) -> bool {
        matches!(self, Self::Draft | Self::Fast | Self::Balanced | Self::Best)
    }

    /// Sets what its TOML says; of a benchmark the first Gaussians, density control, schedule and what the paper states for
    /// it and, where its code has a file for the scene that the dataset's folder is named after, what that file states. c is
    /// that of the configuration's curve; the automatic one gives way to AP3 there and with [`Preset::Paper`].
    ///
    /// # Errors
    /// None for the presets that there are.
    pub fn apply(self, config: &mut TrainConfig) -> Result<()> {
        if !self.is_planned() && config.tone.curve == ToneCurve::Auto {
            config.tone = config.tone.with_curve(ToneCurve::Ap3);
        }
        match self.toml() {
            Some(text) => *config = config.overlaid(text)?,
            None => self.apply_benchmark(config),
        }
        Ok(())
    }

    fn apply_benchmark(self, config: &mut TrainConfig) {
        (config.schedule, config.density) = (Schedule::paper(), DensityConfig::paper());
        config.start = Start::PAPER;
        config.max_resolution = 0;
        config.model.follow_paper();
        let curve = config.tone.curve;
        let of_curve = |ase: f64, ap3: f64| match curve {
            ToneCurve::Ase => ase,
            ToneCurve::Ap3 => ap3,
            _ => config.tone.gain_c,
        };
        let gain_c = match self {
            Self::Lom => of_curve(3.0, 1.0),
            Self::RealX3d => of_curve(4.0, 2.0),
            _ => of_curve(0.0, 0.0),
        };
        let tone = &mut config.tone;
        (tone.gain_c, tone.alpha, tone.beta, tone.base_gain) = (gain_c, 0.12, 2.5, 1.0);
        tone.theta = if self == Self::RealX3d { 0.37 } else { 0.49 };
        config.steps = if self == Self::Lom { 5_000 } else { 15_000 };
        config.seed = 10;
        config.ssim_weight = if self == Self::RealX3d { 0.2 } else { 0.0 };
        self.apply_scene(config);
    }

    fn apply_scene(self, config: &mut TrainConfig) {
        let folder = config.dataset.canonicalize().unwrap_or_else(|_| config.dataset.clone());
        let scene = folder.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let schedule = &mut config.schedule;
        match (self, scene.as_str()) {
            (Self::Lom, "chair") => config.model.weights.low_ssim = 0.5,
            (Self::Lom, "sofa") => {
                config.ssim_weight = 0.25;
                schedule.means_rate_steps = 10_000;
            }
            (Self::Lom, "shrub") => {
                config.ssim_weight = 0.4;
                config.model.network.stages = 6;
                schedule.means_rate_steps = 20_000;
                schedule.initial_rates[Attribute::Means] = 2.5e-4;
                schedule.final_means_rate = 2.5e-6;
            }
            (Self::RealX3d, "bluehawaii") => config.ssim_weight = 0.0,
            _ => return,
        }
        tracing::info!("preset {}: the constants of scene {scene}", self.name());
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
    use std::path::Path;

    use super::*;
    use crate::loss::Weights;
    use crate::networks::Form;
    use crate::photographs::tone::ToneSettings;
    use crate::splats::densify::DensityControl;
    use crate::splats::halves::Bits;
    use crate::train::{Background, ModelConfig};

    fn applied(preset: Preset, scene: &str, curve: ToneCurve) -> TrainConfig {
        let tone = ToneSettings::new(curve);
        let mut config =
            TrainConfig { dataset: Path::new("data").join(scene), tone, ..Default::default() };
        preset.apply(&mut config).unwrap();
        config
    }

    const BENCHMARKS: [Preset; 3] = [Preset::Lom, Preset::RealX3d, Preset::Mip360Varying];

    const PAPER: [Preset; 4] = [Preset::Paper, Preset::Lom, Preset::RealX3d, Preset::Mip360Varying];

    #[test]
    fn the_paper_and_its_benchmarks_have_its_density_control_and_nothing_else_has() {
        for preset in Preset::ALL {
            let config = applied(preset, "x", ToneCurve::Ap3);
            let is_paper = config.density.control == DensityControl::Paper;
            assert_eq!(is_paper, PAPER.contains(&preset), "{preset:?}");
            assert_eq!(is_paper, config.schedule.densify_after == 500, "{preset:?}");
            assert_eq!(is_paper, config.start == Start::PAPER, "{preset:?}");
            assert_eq!(is_paper, config.model.network.form == Form::Paper, "{preset:?}");
            assert_eq!(is_paper, config.model.weights == Weights::paper(), "{preset:?}");
            config.check().unwrap();
        }
    }

    #[test]
    fn paper_is_the_paper_and_balanced_is_the_library_default_but_for_its_end_its_background_its_bits_and_what_fills()
     {
        let paper = applied(Preset::Paper, "x", ToneCurve::Auto);
        let mut model = ModelConfig::default();
        model.follow_paper();
        let expected = TrainConfig {
            dataset: "data/x".into(),
            tone: ToneSettings::default().with_curve(ToneCurve::Ap3),
            start: Start::PAPER,
            schedule: Schedule::paper(),
            density: DensityConfig::paper(),
            model,
            ..Default::default()
        };
        assert_eq!(paper, expected);
        let (balanced, defaults) =
            (applied(Preset::Balanced, "x", ToneCurve::Ase), TrainConfig::default());
        assert_eq!((balanced.tone.curve, balanced.stop.views), (ToneCurve::Ase, 8));
        assert_eq!(
            (balanced.background, defaults.background),
            (Background::Random, Background::Black)
        );
        assert_eq!((balanced.schedule.settle_steps, defaults.schedule.settle_steps), (250, 0));
        assert_eq!((balanced.precision.rest, balanced.precision.moments), (Bits::Half, Bits::Half));
        let (tone, stop) = (defaults.tone.clone(), defaults.stop.clone());
        assert_eq!((balanced.density.fill, defaults.density.fill), (5_000, 0));
        let (density, precision) = (defaults.density.clone(), defaults.precision.clone());
        assert_eq!(DensityConfig { fill: 0, ..balanced.density.clone() }, density);
        let (schedule, background) = (defaults.schedule.clone(), defaults.background);
        let plain =
            TrainConfig { tone, stop, density, precision, schedule, background, ..balanced };
        assert_eq!(plain, TrainConfig { dataset: "data/x".into(), ..defaults });
        assert!(!Preset::Paper.is_planned() && Preset::Balanced.is_planned());
    }

    #[test]
    fn the_guide_shows_every_preset_as_it_is() {
        let guide = include_str!("../../docs/guide.md");
        for preset in Preset::ALL {
            let Some(text) = preset.toml() else { continue };
            let shown = format!("```toml\n# --preset {}\n{text}```", preset.name());
            assert!(guide.contains(&shown), "docs/guide.md lacks\n{shown}");
        }
    }

    #[test]
    fn a_preset_sets_what_it_says_and_leaves_the_rest() {
        let mut config = TrainConfig { seed: 4, ..Default::default() };
        config.schedule.means_rate_steps = 7;
        Preset::Draft.apply(&mut config).unwrap();
        assert_eq!((config.seed, config.schedule.means_rate_steps), (4, 7));
        assert_eq!((config.sh_degree, config.schedule.densify_interval), (0, 50));
        assert!(config.overlaid("stepz = 3").unwrap_err().to_string().contains("stepz"));
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
    fn a_scene_of_the_code_brings_its_own_constants() {
        let shrub = applied(Preset::Lom, "shrub", ToneCurve::Ap3);
        assert_eq!((shrub.steps, shrub.ssim_weight, shrub.model.network.stages), (5_000, 0.4, 6));
        assert_eq!(shrub.schedule.initial_rates[Attribute::Means], 2.5e-4);
        assert_eq!(applied(Preset::Lom, "chair", ToneCurve::Ap3).model.weights.low_ssim, 0.5);
        assert_eq!(applied(Preset::RealX3d, "BlueHawaii", ToneCurve::Ap3).ssim_weight, 0.0);
        let cupcake = applied(Preset::RealX3d, "Cupcake", ToneCurve::Linear);
        assert_eq!((cupcake.steps, cupcake.ssim_weight, cupcake.tone.theta), (15_000, 0.2, 0.37));
    }
}
