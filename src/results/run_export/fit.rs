//! The best of a model that fits a limited size: fewer coefficients first, then fewer Gaussians.

use std::path::Path;

use super::ExportOptions;
use crate::splats::levels;
use crate::splats::scene::Gaussians;
use crate::{Error, Result};

/// A model with fewer Gaussians than this is no model.
const LEAST_GAUSSIANS: usize = 100;

/// What a limited size left of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Fitted {
    /// The level of detail.
    pub(crate) level: usize,
    /// The SH degree, and that of the model.
    pub(crate) degrees: [u32; 2],
}

impl ExportOptions<'_> {
    /// Writes the file again and again, until it has at most this many bytes; returns the model that it then has. Each
    /// level of detail is tried with as many coefficients as fit: half of the Gaussians are a larger loss.
    pub(super) fn fit(
        &self,
        gaussians: &Gaussians,
        path: &Path,
        most: u64,
        write: impl Fn(&Gaussians) -> Result<()>,
    ) -> Result<(Gaussians, Fitted)> {
        let fits = |model: &Gaussians| {
            write(model)?;
            Ok::<_, Error>(std::fs::metadata(path).is_ok_and(|file| file.len() <= most))
        };
        let all = gaussians.sh_degree_in_use();
        let (mut level, mut model) = (0, gaussians.clone());
        while !fits(&model.with_sh_degree(0))? {
            if model.count < LEAST_GAUSSIANS {
                return Err(Error::Usage(format!(
                    "--max-size is too small: {} has more with {} Gaussians; allow more, or pass fewer --views",
                    path.display(),
                    model.count
                )));
            }
            level += 1;
            model = levels::level(gaussians, &[gaussians.count], self.division.cell(), level);
        }
        for degree in (1..=all).rev() {
            let fuller = model.with_sh_degree(degree);
            if fits(&fuller)? {
                return Ok((fuller, Fitted { level, degrees: [degree, all] }));
            }
        }
        let bare = model.with_sh_degree(0);
        write(&bare)?;
        Ok((bare, Fitted { level, degrees: [0, all] }))
    }
}
