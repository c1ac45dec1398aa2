//! `nightsplat tone list`: the tone curves, their values and plots.

use std::path::PathBuf;

use nightsplat_core::output::write_whole;
use nightsplat_core::table::aligned;
use nightsplat_photographs::dataset::{Dataset, LoadOptions, Split};
use nightsplat_photographs::image::{ColourCounts, Image, ImageFile};
use nightsplat_photographs::tone::{
    CurveChoice, FAMILIES, Family, Statistics, Tone, ToneCurve, ToneSettings,
};
use nightsplat_report::{Chart, Series, VerticalLine};

use crate::cli::{finish, print, words};
use crate::{Error, Result};

/// List the tone curves, print their values or plot them.
#[derive(Clone, Debug, clap::Args)]
pub struct ListArgs {
    /// Names, formulas, or .toml, .csv and .cube files [default: all]
    #[arg(value_name = "NAME|FORMULA|FILE", value_parser = words::curves::<CurveChoice>())]
    pub curves: Vec<CurveChoice>,
    /// Plot the curves as SVG
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
    /// Print a table of values
    #[arg(long)]
    pub table: bool,
    /// The t = x / p90 at which --table prints values
    #[arg(
        long,
        value_name = "T,..",
        value_delimiter = ',',
        default_values_t = [0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0]
    )]
    pub at: Vec<f64>,
    /// Dataset whose mean statistics set black level and gain of the curves, and are marked on the plot
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
}

/// The description of the automatic curve.
const AUTO: &str = "0.075 + 0.925 ((1 - lambda) s(x) + lambda x s(Y) / Y), s(x) = 1 - exp(-k x)
    monotone, bounded; k from the luminance of all photographs, see the guide; drawn over t = k x";

/// A curve with its name.
struct NamedCurve {
    name: String,
    settings: ToneSettings,
}

/// Lists, prints or plots.
pub fn run(args: &ListArgs) -> anyhow::Result<()> {
    print(text(args)?)?;
    finish("", "nightsplat tone apply photos --curve NAME --out toned");
    Ok(())
}

/// Writes the plot and returns what the command prints.
pub fn text(args: &ListArgs) -> Result<String> {
    if let Some(t) = args.at.iter().find(|&&t| t.is_nan() || t < 0.0) {
        return Err(Error::Usage(format!("--at {t}: t must be 0 or more")));
    }
    let curves = chosen(&args.curves)?;
    let scene = args.dataset.as_deref().map(scene_statistics).transpose()?;
    let mut text = String::new();
    if args.table {
        text += &values(&curves, &args.at, scene.as_ref());
    }
    if let Some(path) = &args.plot {
        let svg = chart(&curves, scene.as_ref()).svg_file();
        write_whole(path, svg.as_bytes())?;
        text += &format!("wrote {}: {} curves\n", path.display(), curves.len());
    }
    if !args.table && args.plot.is_none() {
        text = listing(&curves);
    }
    Ok(text)
}

fn chosen(choices: &[CurveChoice]) -> Result<Vec<NamedCurve>> {
    let formulas = ToneCurve::ALL.into_iter().map(CurveChoice::from);
    let all: Vec<CurveChoice> = std::iter::once(Tone::Auto.into()).chain(formulas).collect();
    let choices = if choices.is_empty() { &all } else { choices };
    let curve = |choice: &CurveChoice| {
        Ok(NamedCurve { name: choice.to_string(), settings: choice.settings()? })
    };
    choices.iter().map(curve).collect()
}

/// The mean statistics of a dataset's training photographs, as stored.
fn scene_statistics(root: &std::path::Path) -> Result<Statistics> {
    let photographs = Dataset::photographs(root, &LoadOptions::default())?;
    let training = photographs.iter().filter(|photograph| photograph.split == Split::Train);
    let colours = ColourCounts::default();
    let statistics = training.map(|photograph| {
        Ok(Statistics::new(&Image::load_counted(&photograph.input, &colours)?.data))
    });
    let statistics = statistics.collect::<Result<Vec<_>>>()?;
    colours.log();
    Statistics::mean_of(&statistics).ok_or_else(|| Error::input(root, "has no training photograph"))
}

fn listing(curves: &[NamedCurve]) -> String {
    let mut text = String::new();
    for NamedCurve { name, settings } in curves {
        let what = match &settings.curve {
            Tone::Formula(_) => "",
            Tone::Expression(_) => "a formula of your own, evaluated into a table of values",
            Tone::Auto => AUTO,
            Tone::Table(_) => "a table of values, monotone cubics between them",
            Tone::Profile(_) => "a camera profile: matrix, gain, bias and segments of each channel",
            Tone::External(_) => "no curve: the targets are made by another program",
        };
        let Some(family) = settings.curve.family() else {
            text += &format!("{name}\n    {what}\n");
            continue;
        };
        let Family { formula, source, monotone, bounded, constants, aliases, .. } = family;
        let also =
            if aliases.is_empty() { String::new() } else { format!(" ({})", aliases.join(", ")) };
        let rises = if *monotone { "monotone" } else { "not monotone" };
        let clips = if *bounded { "bounded" } else { "clips" };
        text += &format!("{name}{also}\n    {formula}\n");
        let values = constants.iter().zip(&settings.constants);
        let values: Vec<String> =
            values.map(|(constant, value)| format!("{} = {value}", constant.name)).collect();
        if !values.is_empty() {
            text += &format!("    {}\n", values.join(", "));
        }
        text += &format!("    {rises}, {clips}; {source}\n");
    }
    if curves.len() > FAMILIES.len() {
        text += "\nt = x / p90, Y the mean luminance, delta0 = alpha (1 - p10 / p90)^beta.\n\
                 Every curve is clamped to [0, 1].\n";
    }
    text
}

fn value(settings: &ToneSettings, t: f64, scene: Option<&Statistics>) -> f64 {
    settings.value(t, &scene.copied().unwrap_or_else(|| settings.plain_statistics()))
}

fn values(curves: &[NamedCurve], at: &[f64], scene: Option<&Statistics>) -> String {
    let mut rows = vec![vec!["t".to_owned()]];
    rows[0].extend(at.iter().map(f64::to_string));
    for NamedCurve { name, settings } in curves {
        let mut row = vec![name.clone()];
        row.extend(at.iter().map(|&t| format!("{:.3}", value(settings, t, scene))));
        rows.push(row);
    }
    aligned(&rows)
}

fn chart(curves: &[NamedCurve], scene: Option<&Statistics>) -> Chart {
    const LAST: f64 = 3.0;
    const POINTS: u32 = 300;
    /// The most curves that can be told apart in a panel.
    const PANEL: usize = 6;
    let series = |(index, curve): (usize, &NamedCurve)| Series {
        color: Some(index),
        name: curve.name.clone(),
        points: (0..=POINTS)
            .map(|i| LAST * f64::from(i) / f64::from(POINTS))
            .map(|t| (t, value(&curve.settings, t, scene)))
            .collect(),
        ..Series::default()
    };
    let mark = |x: f64, name: &str| VerticalLine { x, name: name.to_owned() };
    let marks = scene.map(|scene| {
        let mean = f64::from(scene.mean_luminance) / f64::from(scene.p90);
        vec![mark(scene.ratio(), "p10"), mark(mean, "mean Y"), mark(1.0, "p90")]
    });
    let series = curves.iter().enumerate().map(series).collect();
    let chart = Chart::new("t = x / p90", "target", series);
    Chart { lines: marks.unwrap_or_default(), panel: Some(PANEL), ..chart }
}
