//! Reads a model from a file of any format.

use std::path::Path;

use nightsplat_core::ply::CONVERTER;
use nightsplat_core::{Error, Result, input};

use crate::export::{sog, spz};
use crate::file_kind::FileKind;
use crate::gaussians::ply::parts::PartFile;
use crate::gaussians::{Gaussians, ModelFacts, ply};

/// The Gaussians in the colours that viewers show, and the facts that the file states. Warns if the near plane is
/// missing, and of Gaussians that are left out, as they are not finite.
pub fn read(path: &Path) -> Result<(Gaussians, ModelFacts)> {
    let (facts, mut gaussians) = match PartFile::open(path, 1)? {
        Some(file) => (file.facts().clone(), file.whole()?),
        None => read_whole(path)?,
    };
    let count = gaussians.count;
    gaussians.retain_finite();
    warn_of_left_out(path, count, gaussians.count)?;
    warn_of(path, &facts);
    Ok((gaussians, facts))
}

/// A model in a format that is read whole.
fn read_whole(path: &Path) -> Result<(ModelFacts, Gaussians)> {
    let bytes = input::bytes_if(path, |start| FileKind::from_bytes(start).is_some())?;
    let parsed = match FileKind::from_bytes(&bytes) {
        Some(FileKind::Ply) => ply::parse_any(&bytes),
        Some(FileKind::Spz) => spz::decode(&bytes),
        Some(FileKind::Sog) => sog::decode(&bytes),
        None if path.extension().is_some_and(|ending| ending == "splat" || ending == "ksplat") => {
            Err(format!("is neither PLY, SPZ nor SOG; {CONVERTER}"))
        }
        None if path.extension().is_some_and(|ending| ending == "html") => {
            let problem = "is a page, not a model; pass the run or the model that it was made of";
            Err(problem.to_owned())
        }
        None => {
            Err("is not a model: neither PLY, SPZ nor SOG; name one, or a run directory".to_owned())
        }
    };
    let (gaussians, facts) = parsed.map_err(|problem| ply::unusable(path, &problem))?;
    Ok((facts, gaussians))
}

/// Opens a PLY for reading part by part; `None` for other formats.
pub fn open_parts(path: &Path, part: usize) -> Result<Option<(PartFile, ModelFacts)>> {
    let file = PartFile::open(path, part)?;
    Ok(file.map(|file| {
        let facts = file.facts().clone();
        warn_of(path, &facts);
        (file, facts)
    }))
}

/// Warns if Gaussians of a file are left out; refuses it if all are.
pub fn warn_of_left_out(path: &Path, count: usize, left: usize) -> Result<()> {
    if left == count {
        return Ok(());
    }
    let problem = format!("{} of {count} Gaussians have an infinity or NaN", count - left);
    if left == 0 {
        return Err(Error::input(path, format!("{problem}; export the model again")));
    }
    tracing::warn!("{}: {problem}, and are left out", path.display());
    Ok(())
}

fn warn_of(path: &Path, facts: &ModelFacts) {
    if facts.near.is_none() {
        tracing::warn!("{}: does not state its near plane; the default is used", path.display());
    }
    if let Some(stops) = facts.linear {
        let path = path.display();
        tracing::warn!(
            "{path}: its colours are linear light, raised by {stops} stops, and are shown as they are"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::drawn;

    #[test]
    fn files_of_other_programs_are_named_with_a_converter() {
        let folder = tempfile::tempdir().unwrap();
        let problem = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            read(&path).unwrap_err().to_string()
        };
        let packed = b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nend_header\n";
        assert!(problem("a.compressed.ply", packed).contains("splat-transform"));
        assert!(problem("a.splat", &[0; 64]).contains("splat-transform"));
        assert!(!problem("a.txt", &[0; 64]).contains("splat-transform"));
        let mut model = drawn(3, 0);
        model.dc_mut()[1].y = f32::NAN;
        model.save(folder.path().join("a.ply")).unwrap();
        assert_eq!(read(&folder.path().join("a.ply")).unwrap().0.count, 2);
        model.means_mut().fill(glam::Vec3::INFINITY);
        model.save(folder.path().join("a.ply")).unwrap();
        let refused = read(&folder.path().join("a.ply")).unwrap_err().to_string();
        assert!(refused.contains("3 of 3 Gaussians have an infinity or NaN"), "{refused}");
    }
}
