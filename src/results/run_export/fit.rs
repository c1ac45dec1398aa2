//! The best of a model that fits a limited size: fewer coefficients first, then fewer Gaussians.

use std::path::Path;

use super::ExportOptions;
use crate::splats::levels;
use crate::splats::scene::Gaussians;
use crate::{Error, Result};

/// A model with fewer Gaussians than this is no model.
const LEAST_GAUSSIANS: usize = 100;

impl ExportOptions<'_> {
    /// Writes the file again and again, until it has at most this many bytes; returns the model that it then has, and
    /// what that is. A level of detail is tried with all coefficients first: half of the Gaussians are a larger loss.
    pub(super) fn fit(
        &self,
        gaussians: &Gaussians,
        path: &Path,
        most: u64,
        write: impl Fn(&Gaussians) -> Result<()>,
    ) -> Result<(Gaussians, String)> {
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
        let mut degree = all;
        loop {
            let fuller = model.with_sh_degree(degree);
            if fits(&fuller)? || degree == 0 {
                return Ok((fuller, format!("; SH degree {degree} of {all}, level {level}")));
            }
            degree -= 1;
        }
    }
}
