//! Detects reference images that are dark photographs of another split.

use super::loaded::LoadedView;
use super::{LoadOptions, Split};

/// A photograph whose encoded mean is at most this is dark.
const DARK: f32 = 0.25;
/// A normal-light image is brighter than its dark photograph by more than this factor.
const BRIGHTER: f32 = 1.3;

/// Turns reference images that are as dark as the photographs into photographs, with a warning.
pub(super) fn drop_from(loaded: &mut [LoadedView], options: &LoadOptions) {
    let is_trained_on =
        |loaded: &&LoadedView| loaded.view.as_ref().is_some_and(|view| view.split == Split::Train);
    let photographs = loaded.iter().filter(is_trained_on).filter_map(|loaded| loaded.brightness[0]);
    let references = loaded.iter().filter_map(|loaded| loaded.brightness[1]);
    let (photographs, references) = (median(photographs.collect()), median(references.collect()));
    let Some((photograph, reference)) = photographs.zip(references) else { return };
    if photograph > DARK || reference > BRIGHTER * photograph {
        return;
    }
    let mut dropped = vec![];
    for LoadedView { name, view, reference: file, .. } in loaded {
        let Some(view) = view.as_mut().filter(|view| view.has_reference()) else { continue };
        let (image, kept_file) = (view.reference.take(), view.reference_file.take());
        if !view.has_photograph() && options.load_low_test {
            view.image = image;
            view.original = kept_file.or_else(|| file.take());
        }
        dropped.push(name.as_str());
    }
    tracing::warn!(
        "{} reference images are as dark as the photographs (mean {reference:.3} and {photograph:.3}; {} the first), \
             so they are none: test views are scored against their own targets",
        dropped.len(),
        dropped.first().copied().unwrap_or_default()
    );
}

fn median(mut values: Vec<f32>) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}
