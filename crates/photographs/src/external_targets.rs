//! Targets that another program made of the photographs: pictures by their names. They have no curve, no inverse and no
//! tone law.

use std::path::Path;

use nightsplat_core::{Error, Result};
use rayon::prelude::*;

use crate::dataset::{Dataset, View};
use crate::image::decoded_at_once;
use crate::image::files::photographs_in;

/// A larger share of clipped pixels is reported as a loss.
const MOST_CLIPPED: f64 = 0.01;
/// Values from here on are white in 8 bits.
const WHITE: f32 = 254.5 / 255.0;

/// What is found of the targets of a dataset's views.
#[derive(Clone, Debug, PartialEq)]
pub struct ExternalTargets {
    /// The name of their folder.
    folder: String,
    /// The view with the most clipped pixels, and the share of each view's pixels that have a channel at white.
    worst: String,
    clipped: Vec<f64>,
    /// The number of other pictures in the folder, and one of them.
    extra: (usize, String),
}

impl ExternalTargets {
    /// Decodes the target of every view with a photograph.
    ///
    /// # Errors
    /// [`Error::Input`] if a view has none, or one that cannot be read.
    pub fn check(folder: &Path, dataset: &Dataset) -> Result<Self> {
        let views: Vec<&View> = dataset.views.iter().filter(|view| view.has_photograph()).collect();
        let missing: Vec<&str> = views
            .iter()
            .filter(|view| view.target_file.is_none())
            .map(|view| view.name.as_str())
            .collect();
        if let Some(first) = missing.first() {
            let (missing, all) = (missing.len(), views.len());
            let problem = format!(
                "has no target for {missing} of {all} photographs, {first} the first; write one under the name of each"
            );
            return Err(Error::input(folder, problem));
        }
        let pixels = |view: &&View| {
            let size = view.own_size().unwrap_or_default().as_u64vec2();
            size.x * size.y
        };
        let largest = views.iter().map(pixels).max().unwrap_or_default();
        let mut clipped = vec![];
        for views in views.chunks(decoded_at_once(largest)) {
            clipped.extend(
                views.par_iter().map(|view| clipped_share(view)).collect::<Result<Vec<_>>>()?,
            );
        }
        let worst = views.iter().zip(&clipped).max_by(|a, b| a.1.total_cmp(b.1));
        let is_used = |name: &str| views.iter().any(|view| view.name == name);
        let pictures = photographs_in(folder)?;
        let stems = pictures.iter().filter_map(|path| path.file_stem()?.to_str());
        let extra: Vec<&str> = stems.filter(|stem| !is_used(stem)).collect();
        Ok(Self {
            folder: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            worst: worst.map(|(view, _)| view.name.clone()).unwrap_or_default(),
            clipped,
            extra: (extra.len(), extra.first().copied().unwrap_or_default().to_owned()),
        })
    }

    fn share(&self) -> f64 {
        self.clipped.iter().sum::<f64>() / self.clipped.len().max(1) as f64
    }

    /// What is found, in a sentence.
    pub fn sentence(&self) -> String {
        let Self { folder, worst, clipped, .. } = self;
        let (count, percent) = (clipped.len(), 100.0 * self.share());
        let most = 100.0 * clipped.iter().copied().fold(0.0, f64::max);
        format!(
            "{count} targets of another program, {folder}; {percent:.1} % of their pixels are clipped at white, \
             {most:.1} % of {worst}"
        )
    }

    /// What is probably not meant, if anything.
    pub fn problem(&self) -> Option<String> {
        let (extra, first) = &self.extra;
        let unused = (*extra > 0)
            .then(|| format!("{extra} more pictures are of no photograph, {first} the first"));
        let clipped = (self.share() > MOST_CLIPPED).then(|| {
            let (percent, worst) = (100.0 * self.share(), &self.worst);
            format!("{percent:.1} % of the targets' pixels are clipped at white, most in {worst}; detail is lost there")
        });
        let problems: Vec<String> = unused.into_iter().chain(clipped).collect();
        (!problems.is_empty()).then(|| problems.join("; "))
    }
}

/// The share of the pixels of a target that have a channel at white.
fn clipped_share(view: &View) -> Result<f64> {
    let Some(target) = view.external_target()? else { return Ok(0.0) };
    let plane = target.pixel_count();
    let is_white =
        |pixel: &usize| (0..3).any(|channel| target.data[channel * plane + pixel] >= WHITE);
    Ok((0..plane).filter(is_white).count() as f64 / plane.max(1) as f64)
}
