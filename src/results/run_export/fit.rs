//! The best of a model that fits a limited size: coarser coefficients first, then fewer, then fewer Gaussians.

use std::path::Path;

use nightsplat_models::export::Format;
use nightsplat_models::gaussians::Gaussians;
use nightsplat_models::levels;

use super::ExportOptions;
use crate::{Error, Result};

/// A model with fewer Gaussians than this is no model.
const LEAST_GAUSSIANS: usize = 100;

/// Multiples to which the coefficients above degree 0 of a page may be rounded, 0 for none. It compresses half floats,
/// so rounded ones take half of the bytes or less; a 256th is half of what other formats keep.
const ROUNDINGS: [f32; 3] = [0.0, 1.0 / 256.0, 1.0 / 64.0];

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
        let roundings = if self.format == Format::Html { &ROUNDINGS[..] } else { &ROUNDINGS[..1] };
        for degree in (1..=all).rev() {
            for &multiple in roundings {
                let fuller = rounded(&model, degree, multiple);
                if fits(&fuller)? {
                    let multiples = if multiple > 0.0 {
                        format!(" in multiples of 1/{}", multiple.recip())
                    } else {
                        String::new()
                    };
                    let what = format!("; SH degree {degree} of {all}{multiples}, level {level}");
                    return Ok((fuller, what));
                }
            }
        }
        let least = model.with_sh_degree(0);
        write(&least)?;
        Ok((least, format!("; SH degree 0 of {all}, level {level}")))
    }
}

/// A model of this degree, its coefficients above degree 0 rounded to multiples, unless of 0.
fn rounded(gaussians: &Gaussians, sh_degree: u32, multiple: f32) -> Gaussians {
    let mut model = gaussians.with_sh_degree(sh_degree);
    if multiple > 0.0 {
        let rounded = |value: f32| (value / multiple).round() * multiple;
        model.rest_mut().iter_mut().for_each(|rest| *rest = rest.map(rounded));
    }
    model
}
