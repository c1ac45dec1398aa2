//! Scores on pairs that a fit has not seen.

use serde::Serialize;

use super::{FitOptions, FitScene, Pair, Scores, fit, mean_psnr, mean_squared_error};
use crate::photographs::tone::Family;
use crate::{Error, Result};

/// A scene, or a part of one, that was held out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fold {
    /// The scene's name, or that of the fold.
    pub name: String,
    /// How many pairs it holds.
    pub pairs: usize,
    /// The means over its pairs, dB; the fit is to all others.
    pub psnr: Scores,
    /// The means of its pairs' mean squared errors, of values in [0, 1].
    pub squared_error: Scores,
}

/// Scores on held-out pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HeldOut {
    /// One per fit.
    pub folds: Vec<Fold>,
    /// The means over the folds, dB.
    pub psnr: Scores,
    /// The means over the folds, of values in [0, 1].
    pub squared_error: Scores,
}

/// Fits to all scenes but one, once for each; of a single scene to all but every `folds`-th pair, as many times.
///
/// # Errors
/// [`Error::Usage`] where there is a single pair, or fewer than two folds; those of [`fit`].
pub fn cross_validate(
    family: &'static Family,
    scenes: &[FitScene],
    folds: usize,
    options: &FitOptions,
) -> Result<HeldOut> {
    let folds = split(scenes, folds)?;
    let held_out = |index: usize| {
        let (name, pairs) = &folds[index];
        let others: Vec<&Pair> = folds
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != index)
            .flat_map(|(_, (_, pairs))| pairs)
            .copied()
            .collect();
        let fitted = fit(family, &others, options)?;
        Ok(Fold {
            name: name.clone(),
            pairs: pairs.len(),
            psnr: Scores::of(&fitted.settings, |settings| mean_psnr(settings, pairs)),
            squared_error: Scores::of(&fitted.settings, |settings| {
                mean_squared_error(settings, pairs)
            }),
        })
    };
    let folds = (0..folds.len()).map(held_out).collect::<Result<Vec<Fold>>>()?;
    let psnr = Scores::mean(folds.iter().map(|fold| &fold.psnr));
    let squared_error = Scores::mean(folds.iter().map(|fold| &fold.squared_error));
    Ok(HeldOut { folds, psnr, squared_error })
}

fn split(scenes: &[FitScene], folds: usize) -> Result<Vec<(String, Vec<&Pair>)>> {
    if let [scene] = scenes {
        let count = scene.pairs.len().min(folds);
        if count < 2 {
            return Err(Error::Usage(format!(
                "{} pairs in {folds} folds leave none to fit to or none to validate on; it takes two pairs in two folds",
                scene.pairs.len()
            )));
        }
        let fold = |index: usize| {
            let pairs = scene.pairs.iter().skip(index).step_by(count).collect();
            (format!("{} {}/{count}", scene.name, index + 1), pairs)
        };
        return Ok((0..count).map(fold).collect());
    }
    Ok(scenes.iter().map(|scene| (scene.name.clone(), scene.pairs.iter().collect())).collect())
}
