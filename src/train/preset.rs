//! Presets: how much time a run takes for its score, and every constant that the paper and its code state for a benchmark.

use std::str::FromStr;

use super::{DensityConfig, TrainConfig};
use crate::attributes::Attribute;
use crate::optimizer::Schedule;
use crate::tone::ToneCurve;
use crate::{Error, Result};

/// A trade of time for quality, or a benchmark that the paper reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// The defaults.
    Balanced,
    /// A good score in few steps.
    Fast,
    /// LOM: `bike`, `buu`, `chair`, `shrub`, `sofa`.
    Lom,
    /// The low-light scenes of `RealX3D`.
    RealX3d,
    /// MipNeRF360 with exposures that vary.
    Mip360Varying,
}

impl Preset {
    /// Every preset.
    pub const ALL: [Self; 5] =
        [Self::Balanced, Self::Fast, Self::Lom, Self::RealX3d, Self::Mip360Varying];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Balanced => "balanced",
            Self::Fast => "fast",
            Self::Lom => "lom",
            Self::RealX3d => "realx3d",
            Self::Mip360Varying => "mip360-varying",
        }
    }

    /// Sets density control and schedule; of a benchmark also what the paper states for it and, where its code has a file for the scene that the dataset's
    /// folder is named after, what that file states. c is that of the configuration's curve, which is AP3 in place of the
    /// automatic one.
    pub fn apply(self, config: &mut TrainConfig) {
        match self {
            Self::Balanced => {
                (config.schedule, config.density) = (Schedule::default(), DensityConfig::default());
            }
            Self::Fast => {
                config.steps = FAST_STEPS;
                (config.schedule, config.density) = (Schedule::fast(), DensityConfig::default());
            }
            Self::Lom | Self::RealX3d | Self::Mip360Varying => self.apply_benchmark(config),
        }
    }

    fn apply_benchmark(self, config: &mut TrainConfig) {
        (config.schedule, config.density) = (Schedule::paper(), DensityConfig::paper());
        if config.tone.curve == ToneCurve::Auto {
            config.tone = config.tone.with_curve(ToneCurve::Ap3);
        }
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

/// The steps of [`Preset::Fast`].
const FAST_STEPS: u64 = 700;

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
    use crate::densify::DensityControl;
    use crate::tone::ToneSettings;

    fn applied(preset: Preset, scene: &str, curve: ToneCurve) -> TrainConfig {
        let tone = ToneSettings::new(curve);
        let mut config =
            TrainConfig { dataset: Path::new("data").join(scene), tone, ..Default::default() };
        preset.apply(&mut config);
        config
    }

    const BENCHMARKS: [Preset; 3] = [Preset::Lom, Preset::RealX3d, Preset::Mip360Varying];

    #[test]
    fn benchmarks_have_the_density_control_of_the_paper_and_nothing_else_has() {
        for preset in Preset::ALL {
            let config = applied(preset, "x", ToneCurve::Ap3);
            let is_paper = config.density.control == DensityControl::Paper;
            assert_eq!(is_paper, BENCHMARKS.contains(&preset), "{preset:?}");
            assert_eq!(is_paper, config.schedule.densify_after == 500, "{preset:?}");
            config.check().unwrap();
        }
        assert_eq!(applied(Preset::Balanced, "x", ToneCurve::None).schedule, Schedule::default());
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
