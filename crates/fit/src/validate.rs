//! Scores on held-out pairs.

use nightsplat_core::{Error, Result};
use nightsplat_photographs::tone::Tone;
use serde::Serialize;

use super::pairs::PairScene;
use super::{CurveScores, FitOptions, FitScene, Pair, fit, mean_psnr, mean_squared_error};

/// A held-out scene, or a held-out part of one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fold {
    /// The scene's name, or that of the fold.
    pub name: String,
    /// Its number of pairs.
    pub pairs: usize,
    /// The mean PSNR of its pairs, dB, for a fit to all others.
    pub psnr: CurveScores,
    /// The mean squared error of its pairs, for values in [0, 1].
    pub squared_error: CurveScores,
}

/// Scores on held-out pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HeldOut {
    /// One per fit.
    pub folds: Vec<Fold>,
    /// The means over the folds, dB.
    pub psnr: CurveScores,
    /// The means over the folds, of values in [0, 1].
    pub squared_error: CurveScores,
}

/// Fits to all scenes except one, for each in turn; in a single scene, to all except every `folds`-th pair.
pub fn cross_validate(
    curve: &Tone,
    scenes: &[FitScene],
    folds: usize,
    options: &FitOptions,
) -> Result<HeldOut> {
    let parts = split(scenes, folds)?;
    let held_out = |(index, HeldOutPairs { name, pairs, .. }): (usize, &HeldOutPairs<'_, Pair>)| {
        let others = all_except(&parts, index).flat_map(|part| &part.pairs);
        let others: Vec<&Pair> = others.copied().collect();
        let fitted = fit(curve, &others, options)?;
        Ok(Fold {
            name: name.clone(),
            pairs: pairs.len(),
            psnr: CurveScores::new(&fitted.settings, |settings| mean_psnr(settings, pairs)),
            squared_error: CurveScores::new(&fitted.settings, |settings| {
                mean_squared_error(settings, pairs)
            }),
        })
    };
    let folds = parts.iter().enumerate().map(held_out).collect::<Result<Vec<Fold>>>()?;
    let psnr = CurveScores::mean(folds.iter().map(|fold| &fold.psnr));
    let squared_error = CurveScores::mean(folds.iter().map(|fold| &fold.squared_error));
    Ok(HeldOut { folds, psnr, squared_error })
}

/// A scene, or a part of one, that is held out.
pub(super) struct HeldOutPairs<'a, P> {
    pub(super) name: String,
    /// The name of the scene.
    pub(super) scene: &'a str,
    pub(super) pairs: Vec<&'a P>,
}

/// The scenes; of a single one, `folds` parts.
pub(super) fn split<'a, P>(
    scenes: &'a [PairScene<P>],
    folds: usize,
) -> Result<Vec<HeldOutPairs<'a, P>>> {
    let [PairScene { name, pairs }] = scenes else {
        let whole = |scene: &'a PairScene<P>| HeldOutPairs {
            name: scene.name.clone(),
            scene: &scene.name,
            pairs: scene.pairs.iter().collect(),
        };
        return Ok(scenes.iter().map(whole).collect());
    };
    let count = pairs.len().min(folds);
    if count < 2 {
        return Err(Error::Usage(format!(
            "{} pairs in {folds} folds leave none to fit or none to validate; use at least two pairs in two folds",
            pairs.len()
        )));
    }
    let part = |index: usize| HeldOutPairs {
        name: format!("{name} {}/{count}", index + 1),
        scene: name,
        pairs: pairs.iter().skip(index).step_by(count).collect(),
    };
    Ok((0..count).map(part).collect())
}

/// All parts except one.
pub(super) fn all_except<'a, 'p, P>(
    parts: &'a [HeldOutPairs<'p, P>],
    index: usize,
) -> impl Iterator<Item = &'a HeldOutPairs<'p, P>> {
    parts.iter().enumerate().filter(move |(other, _)| *other != index).map(|(_, part)| part)
}
