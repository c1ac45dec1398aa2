//! The photographs as COLMAP can see them: all lifted by one curve, under their own names.

use std::path::{Path, PathBuf};

use super::create;
use crate::Result;
use crate::base::input;
use crate::cli::progress_bar;
use crate::gpu::Gpu;
use crate::photographs::image::files::{photographs_in, stem};
use crate::photographs::image::{Image, exif_segment};
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{MeasuredPhotograph, ToneSettings, all_black};

/// Lifts the photographs into `folder`, as stored, and returns the gain of the scene. A JPEG stays one and keeps its Exif,
/// so that COLMAP finds the focal length; everything else becomes PNG.
///
/// # Errors
/// A photograph cannot be read, all are black, or the device is out of memory.
pub(super) fn write(gpu: &Gpu, photographs: &[PathBuf], folder: &Path) -> Result<f64> {
    create(folder)?;
    // One curve for all: what two photographs show of one place stays alike.
    let settings = ToneSettings { scene_statistics: true, ..ToneSettings::default() };
    let pseudo_gt = PseudoGt::new(gpu, &settings)?;
    let progress = progress_bar(2 * photographs.len());
    let mut measured = vec![];
    for path in photographs {
        measured.push(MeasuredPhotograph::of(&Image::load(path)?.data));
        progress.inc(1);
    }
    let root = photographs.first().and_then(|path| path.parent()).unwrap_or(folder);
    let scene = settings.scene(&measured).ok_or_else(|| all_black(root))?;
    for (path, measured) in photographs.iter().zip(&measured) {
        let image =
            pseudo_gt.tone_mapped(&Image::load(path)?, &settings.tone_mapping(&scene, measured))?;
        let name = path.file_name().unwrap_or_default();
        if is_jpeg(path) {
            image.save_jpeg(folder.join(name), exif_of(path)?.as_deref())?;
        } else {
            let name = stem(&name.to_string_lossy()).to_owned() + ".png";
            image.save_png8(folder.join(name))?;
        }
        progress.inc(1);
    }
    progress.finish_and_clear();
    Ok(scene.exposure.map_or(1.0, |exposure| exposure.gain))
}

fn is_jpeg(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    ending == "jpg" || ending == "jpeg"
}

fn exif_of(path: &Path) -> Result<Option<Vec<u8>>> {
    let bytes = input::bytes(path)?;
    Ok(exif_segment(&bytes))
}

/// Whether all photographs of a folder are of one size, and so of one camera.
pub(super) fn are_of_one_size(folder: &Path) -> bool {
    let sizes = photographs_in(folder).unwrap_or_default();
    let mut sizes = sizes.iter().map(|path| Image::size_of(path).ok());
    let first = sizes.next();
    sizes.all(|size| Some(size) == first)
}
