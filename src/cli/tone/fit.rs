//! `nightsplat tone fit`: fits a tone curve to pairs of photographs.

use std::path::PathBuf;

use nightsplat_core::output::write_whole;
use nightsplat_core::table::aligned;
use nightsplat_fit::{
    Channels, CurveFit, CurveScores, Estimate, FitOptions, FitScene, HeldOut, Pair, Weighting,
    cross_validate, fit,
};
use nightsplat_photographs::tone::{CurveChoice, FAMILIES, Tone, ToneCurve};
use nightsplat_photographs::tree::check_writable;
use rayon::prelude::*;
use serde::Serialize;

use crate::cli::{finish, print, word};
use crate::{Error, Result};

mod plot;
pub mod profile;

/// Fit a tone curve, or a camera profile, to pairs of dark and normally lit photographs
#[derive(Clone, Debug, clap::Args)]
pub struct FitArgs {
    /// Folders of pairs, each with low/ and high/ (or normal/ or images/), files of the same names
    #[arg(required = true)]
    pub pairs: Vec<PathBuf>,
    /// Folder of the photographs in normal light; PAIRS is then that of the dark ones
    #[arg(long, value_name = "DIR")]
    pub normal: Option<PathBuf>,
    /// Name of a curve from `nightsplat tone list`, all, or a formula of t = x / p90 or of x with named constants, such
    /// as 'a*t/(t+b); a = 1 in 0.5..2': each has a start and bounds, or starts at 1. A .toml file has them as constants
    /// and bounds
    #[arg(long, value_name = "NAME|FORMULA|FILE|all", default_value_t)]
    pub family: FamilyChoice,
    /// Write the best curve, for --curve, or the profile
    #[arg(long, value_name = "FILE.toml")]
    pub out: Option<PathBuf>,
    /// Fit the values of every channel, or luminance
    #[arg(long, value_enum, default_value_t)]
    pub channels: ChannelChoice,
    /// Weight of a photograph: its pixel count, or less with its distance from the curve
    #[arg(long, value_enum, default_value_t)]
    pub weigh: WeightingChoice,
    /// Weight of the curve's default constants as a prior, in photographs
    #[arg(long, value_name = "N", default_value_t = FitOptions::default().prior)]
    pub prior: f64,
    /// Huber threshold in units of the residuals' scale; inf for least squares
    #[arg(long, value_name = "D", default_value_t = FitOptions::default().huber)]
    pub huber: f64,
    /// Bins of the histogram that is fitted
    #[arg(long, value_name = "N", default_value_t = FitOptions::default().bins)]
    pub bins: usize,
    /// Keep the curve at or below 1, so that nothing clips
    #[arg(long)]
    pub bounded: bool,
    /// Also fit black level (alpha) and gain (c), for curves without their own
    #[arg(long)]
    pub adapt: bool,
    /// Score on held-out pairs: each scene in turn, or folds of a single one
    #[arg(long)]
    pub cross_validate: bool,
    /// Folds of a single scene
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub folds: usize,
    /// Plot pairs and curves as SVG
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
    /// Fit a camera profile (3x3 matrix, gain, bias and 16 segments per channel), for --profile of train and tone apply
    #[arg(long, conflicts_with_all = ["family", "channels", "weigh", "prior", "bins", "bounded", "adapt", "plot"])]
    pub profile: bool,
    /// Print JSON instead of text
    #[arg(long)]
    pub json: bool,
}

impl Default for FamilyChoice {
    fn default() -> Self {
        Self::One(ToneCurve::FittedCubic.into())
    }
}

/// The curves to fit.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a command has one")]
pub enum FamilyChoice {
    /// Every family with constants.
    All,
    /// One.
    One(CurveChoice),
}

impl std::str::FromStr for FamilyChoice {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        if name == "all" {
            return Ok(Self::All);
        }
        match name {
            "table" => Err(Error::Usage("a table of values has no constants to fit".to_owned())),
            "profile" => Err(Error::Usage("a camera profile is fitted with --profile".to_owned())),
            name => name.parse().map(Self::One),
        }
    }
}

impl std::fmt::Display for FamilyChoice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::One(curve) => curve.fmt(f),
        }
    }
}

/// `Channels` on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ChannelChoice {
    /// Red, green and blue
    #[default]
    Rgb,
    /// BT.601 luminance
    Luminance,
}

/// `Weighting` on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum WeightingChoice {
    /// Every pixel the same
    #[default]
    Pixels,
    /// Each by its own residuals
    Photographs,
}

/// A fitted curve.
#[derive(Clone, Debug, Serialize)]
pub struct Fitted {
    /// The name of the family, or a formula of one's own.
    pub family: String,
    /// Its formula.
    pub formula: String,
    /// The fit to all pairs.
    pub fit: CurveFit,
    /// Scores on pairs that were not fitted to.
    pub held_out: Option<HeldOut>,
}

impl Fitted {
    /// What families are ranked by: the score on held-out pairs where there is one.
    fn score(&self) -> f64 {
        self.held_out.as_ref().map_or(self.fit.psnr.fitted, |held_out| held_out.psnr.fitted)
    }
}

/// Fits and prints what was found, as tables or as JSON.
pub fn run(args: &FitArgs) -> anyhow::Result<()> {
    args.out.iter().chain(&args.plot).try_for_each(|path| check_writable(path))?;
    let text = if args.profile {
        let fitted = profile::apply(args)?;
        if args.json { serde_json::to_string_pretty(&fitted)? } else { profile::text(&fitted) }
    } else {
        let fitted = apply(args)?;
        if args.json { serde_json::to_string_pretty(&fitted)? } else { text(&fitted) }
    };
    print(text.trim_end())?;
    let option = if args.profile { "profile" } else { "curve" };
    let next = match &args.out {
        Some(out) => format!("nightsplat train photos --out run --{option} {}", word(out)),
        None => format!("the same with --out {option}.toml, for --{option} of train"),
    };
    let wrote = args.out.iter().chain(&args.plot).map(|path| path.display().to_string());
    if !args.json {
        finish(&wrote.collect::<Vec<_>>().join(", "), &next);
    }
    Ok(())
}

/// Refuses --normal with several folders of dark photographs.
fn check(args: &FitArgs) -> Result<()> {
    if args.normal.is_some() && args.pairs.len() > 1 {
        return Err(Error::Usage("--normal takes a single folder of dark photographs".to_owned()));
    }
    Ok(())
}

/// Fits the families of `args`, best first, and writes the files.
pub fn apply(args: &FitArgs) -> Result<Vec<Fitted>> {
    check(args)?;
    let options = FitOptions {
        channels: match args.channels {
            ChannelChoice::Rgb => Channels::Rgb,
            ChannelChoice::Luminance => Channels::Luminance,
        },
        weighting: match args.weigh {
            WeightingChoice::Photographs => Weighting::Photographs,
            WeightingChoice::Pixels => Weighting::Pixels,
        },
        prior: args.prior,
        huber: args.huber,
        bins: args.bins,
        bounded: args.bounded,
        adapt: args.adapt,
    };
    let scenes = args.pairs.iter().map(|folder| FitScene::load(folder, args.normal.as_deref()));
    let scenes = scenes.collect::<Result<Vec<FitScene>>>()?;
    let pairs: Vec<&Pair> = scenes.iter().flat_map(|scene| &scene.pairs).collect();
    let curves: Vec<Tone> = match &args.family {
        FamilyChoice::One(CurveChoice::Named(curve)) => vec![curve.clone()],
        FamilyChoice::One(file) => vec![file.settings()?.curve],
        FamilyChoice::All => {
            let families = FAMILIES.iter().filter(|family| family.curve != ToneCurve::None);
            families.map(|family| Tone::Formula(family.curve)).collect()
        }
    };
    let fit_one = |curve: &Tone| {
        Ok(Fitted {
            family: curve.name().to_owned(),
            formula: curve.formula().to_owned(),
            fit: fit(curve, &pairs, &options)?,
            held_out: args
                .cross_validate
                .then(|| cross_validate(curve, &scenes, args.folds, &options))
                .transpose()?,
        })
    };
    let mut fitted = curves.par_iter().map(fit_one).collect::<Result<Vec<Fitted>>>()?;
    fitted.sort_by(|a, b| b.score().total_cmp(&a.score()));
    if let Some(path) = &args.out {
        write_whole(path, toml(&fitted[0])?.as_bytes())?;
    }
    if let Some(path) = &args.plot {
        write_whole(path, plot::svg(&fitted[0], &pairs, &options).as_bytes())?;
    }
    Ok(fitted)
}

/// The curve as TOML, with its scores in comments.
fn toml(fitted: &Fitted) -> Result<String> {
    let Fitted { family, formula, fit, .. } = fitted;
    let settings = toml::to_string(&fit.settings.clone().rounded()).map_err(|error| {
        Error::output("the curve", format!("cannot be written as TOML: {error}"))
    })?;
    let title = title(family, formula);
    let mut text = format!(
        "# {title}\n# Fitted to {} values; RMSE {:.4}, {:.2} dB.\n",
        fit.values, fit.rmse, fit.psnr.fitted
    );
    if let Some(held_out) = &fitted.held_out {
        text += &format!(
            "# On held-out pairs {:.2} dB, AP3 {:.2} dB.\n",
            held_out.psnr.fitted, held_out.psnr.ap3
        );
    }
    for constant in &fit.constants {
        text += &format!("# {} = {}\n", constant.name, with_error(constant));
    }
    Ok(text + &settings)
}

/// The name of a curve and its formula, once if they are the same.
fn title(family: &str, formula: &str) -> String {
    if family == formula { formula.to_owned() } else { format!("{family}: {formula}") }
}

fn with_error(constant: &Estimate) -> String {
    match (constant.standard_error, constant.at_bound) {
        (Some(error), _) => format!("{:.5} +- {error:.2e}", constant.value),
        (None, true) => format!("{:.5} (at its bound)", constant.value),
        (None, false) => format!("{:.5} (not determined by the data)", constant.value),
    }
}

/// A table of the families, then details of the best.
fn text(fitted: &[Fitted]) -> String {
    let is_scored = fitted.iter().any(|fitted| fitted.held_out.is_some());
    let mut header = vec!["family", "RMSE", "R2", "fitted dB", "default dB"];
    if is_scored {
        header.extend(["held out dB", "default dB"]);
    }
    header.extend(["rises", "clips"]);
    let mut rows = vec![header.into_iter().map(str::to_owned).collect::<Vec<_>>()];
    let yes = |holds: bool| if holds { "yes" } else { "no" }.to_owned();
    for Fitted { family, fit, held_out, .. } in fitted {
        let mut row = vec![
            family.clone(),
            format!("{:.4}", fit.rmse),
            fit.r_squared.map_or_else(|| "-".to_owned(), |r_squared| format!("{r_squared:.4}")),
            format!("{:.2}", fit.psnr.fitted),
            format!("{:.2}", fit.psnr.frozen),
        ];
        if let Some(HeldOut { psnr, .. }) = held_out {
            row.extend([format!("{:.2}", psnr.fitted), format!("{:.2}", psnr.frozen)]);
        }
        row.extend([yes(fit.rises), yes(!fit.bounded)]);
        rows.push(row);
    }
    let Some(Fitted { family, formula, fit, held_out }) = fitted.first() else {
        return String::new();
    };
    let mut text = aligned(&rows);
    text += &format!(
        "\nAP3 with default constants: {:.2} dB on all pairs{}\n",
        fit.psnr.ap3,
        held_out.as_ref().map_or_else(String::new, |held_out| format!(
            ", {:.2} dB on held-out pairs",
            held_out.psnr.ap3
        ))
    );
    text += &format!("\n{}\n", title(family, formula));
    for constant in &fit.constants {
        text += &format!("  {:9} {}\n", constant.name, with_error(constant));
    }
    let [median, high] = fit.residual_quantiles;
    text += &format!(
        "residuals: RMSE {:.4}, median {median:.4}, 95th percentile {high:.4}, robust loss {:.3e}{}\n",
        fit.rmse,
        fit.robust_loss,
        fit.huber_delta.map_or_else(String::new, |delta| format!(", Huber threshold {delta:.4}"))
    );
    text += &format!(
        "{} values, effectively {:.0} independent ones; errors assume independent photographs\n",
        fit.values, fit.effective_values
    );
    if let Some(held_out) = held_out {
        let row = |name: &str, pairs: usize, psnr: &CurveScores, squared_error: &CurveScores| {
            let of = |scores: &CurveScores| [scores.fitted, scores.frozen, scores.ap3];
            let psnr = of(psnr).map(|score| format!("{score:.2}"));
            let rmse = of(squared_error).map(|error| format!("{:.4}", error.sqrt()));
            [vec![name.to_owned(), pairs.to_string()], psnr.to_vec(), rmse.to_vec()].concat()
        };
        let header =
            ["held out", "pairs", "fitted dB", "default dB", "AP3 dB", "RMSE", "own", "AP3"];
        let header = header.map(str::to_owned).to_vec();
        let folds = held_out.folds.iter();
        let pairs = folds.clone().map(|fold| fold.pairs).sum();
        let folds = folds.map(|fold| row(&fold.name, fold.pairs, &fold.psnr, &fold.squared_error));
        let all = row("all", pairs, &held_out.psnr, &held_out.squared_error);
        let rows: Vec<Vec<String>> = std::iter::once(header).chain(folds).chain([all]).collect();
        text += "\n";
        text += &aligned(&rows);
    }
    text
}
