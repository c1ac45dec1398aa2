//! `nightsplat tone fit --profile`: fits a camera profile in place of a curve.

use nightsplat_core::output::write_whole;
use nightsplat_core::table::aligned;
use nightsplat_fit::{
    ColourPair, ColourScene, ProfileFold, ProfileScores, cross_validate_profile, fit_profile,
    profile_scores,
};
use nightsplat_photographs::tone::Profile;
use serde::Serialize;

use super::FitArgs;
use crate::Result;

/// A fitted profile.
#[derive(Clone, Debug, Serialize)]
pub struct FittedProfile {
    /// Profile fitted to all pairs.
    pub profile: Profile,
    /// Scores on these pairs.
    pub scores: ProfileScores,
    /// Scores on held-out pairs.
    pub held_out: Option<Vec<ProfileFold>>,
}

/// Fits a profile to the pairs of `args`, and writes it.
pub fn apply(args: &FitArgs) -> Result<FittedProfile> {
    super::check(args)?;
    let scenes = args.pairs.iter().map(|folder| ColourScene::load(folder, args.normal.as_deref()));
    let scenes = scenes.collect::<Result<Vec<ColourScene>>>()?;
    let parts: Vec<(&str, Vec<&ColourPair>)> =
        scenes.iter().map(|scene| (scene.name.as_str(), scene.pairs.iter().collect())).collect();
    let profile = fit_profile(&parts, args.huber)?;
    let pairs: Vec<&ColourPair> = parts.into_iter().flat_map(|(_, pairs)| pairs).collect();
    let scores = profile_scores(&profile, &pairs);
    let held_out =
        args.cross_validate.then(|| cross_validate_profile(&scenes, args.folds, args.huber));
    let fitted = FittedProfile { profile, scores, held_out: held_out.transpose()? };
    if let Some(path) = &args.out {
        write_whole(path, toml(&fitted).as_bytes())?;
    }
    Ok(fitted)
}

/// The profile as TOML, with its scores in comments, to the precision of 8-bit references.
fn toml(fitted: &FittedProfile) -> String {
    let FittedProfile { profile, scores, .. } = fitted;
    let row = |row: &[f64]| {
        let numbers: Vec<String> = row.iter().map(|number| format!("{number:.4}")).collect();
        format!("[{}]", numbers.join(", "))
    };
    let rows = |rows: &[&[f64]]| {
        let rows: Vec<String> =
            rows.iter().map(|values| format!("    {},\n", row(values))).collect();
        format!("[\n{}]", rows.concat())
    };
    let Profile { reference, pairs, matrix, gain, bias, segments } = profile;
    let name = ::toml::Value::String(reference.clone());
    let matrix = rows(&matrix.each_ref().map(<[f64; 3]>::as_slice));
    let segments = rows(&segments.each_ref().map(Vec::as_slice));
    format!(
        "# Camera profile: {:.2} dB on the pairs it was fitted to; the curve auto has {:.2} dB.\n\
         # Scores of its results depend on these references.\n\
         reference = {name}\npairs = {pairs}\n\n\
         # v = 1 - exp(-k x), u = gain (matrix v) + bias; rows and values are red, green and blue.\n\
         matrix = {matrix}\ngain = {}\nbias = {}\n\n\
         # The values at u = 0, 1/16, .. 1.\nsegments = {segments}\n",
        scores.profile,
        scores.auto,
        row(gain),
        row(bias),
    )
}

/// The results as text.
pub(super) fn text(fitted: &FittedProfile) -> String {
    let FittedProfile { profile, scores, held_out } = fitted;
    let row = |name: &str, pairs: usize, ProfileScores { profile, auto }: &ProfileScores| {
        [name.to_owned(), pairs.to_string(), format!("{profile:.2}"), format!("{auto:.2}")].to_vec()
    };
    let header = ["", "pairs", "profile dB", "auto dB"].map(str::to_owned).to_vec();
    let mut rows = vec![header, row("fitted to", profile.pairs, scores)];
    for ProfileFold { name, pairs, scores } in held_out.iter().flatten() {
        rows.push(row(&format!("held out: {name}"), *pairs, scores));
    }
    format!("{}\nwith reference: {}\n", aligned(&rows), profile.label())
}
