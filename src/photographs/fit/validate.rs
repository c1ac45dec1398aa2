//! Scores on held-out pairs.

use serde::Serialize;

use super::{FitOptions, FitScene, Pair, Scores, fit, mean_psnr, mean_squared_error};
use crate::photographs::tone::Family;
use crate::{Error, Result};

/// A held-out scene, or a held-out part of one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fold {
    /// The scene's name, or that of the fold.
    pub name: String,
    /// Its number of pairs.
    pub pairs: usize,
    /// The mean PSNR of its pairs, dB, for a fit to all others.
    pub psnr: Scores,
    /// The mean squared error of its pairs, for values in [0, 1].
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

/// Fits to all scenes except one, for each in turn; in a single scene, to all except every `folds`-th pair.
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
                "{} pairs in {folds} folds leave none to fit to or none to validate on; use at least two \
                 pairs in two folds",
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
