//! Brightened copies of the photographs for COLMAP, all by the same curve.

use std::path::{Path, PathBuf};

use nightsplat_core::output::create_folder;
use nightsplat_photographs::image::files::stem;
use nightsplat_photographs::image::{
    ColourCounts, Image, ImageFile, Levels, PictureFile, StoredLight, exif_segment, reduced_size,
};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{MeasuredPhotograph, ToneSettings, all_black};
use nightsplat_photographs::tree;

use super::PoseProgress;
use nightsplat_core::Result;

/// Tone-maps a photograph by its curve in a scene.
pub type ToneMapper = Box<dyn Fn(&SceneTone, &Image, &MeasuredPhotograph) -> Result<Image>>;

/// Tone-maps the photographs into `folder`, in their stored orientation, and returns the gain of the scene. A JPEG
/// stays a JPEG and keeps its Exif, where COLMAP finds the focal length; everything else becomes PNG. Photographs that
/// do not decode are removed from `photographs`, with a warning.
///
/// # Errors
/// None decodes, all are black, or the device is out of memory; or `report` fails.
pub(super) fn write(
    tone_map: &ToneMapper,
    photographs: &mut Vec<PathBuf>,
    light: Option<StoredLight>,
    folder: &Path,
    report: &dyn Fn(PoseProgress<'_>) -> Result<()>,
) -> Result<f64> {
    create_folder(folder)?;
    // The same curve for all, so that features keep matching.
    let settings = ToneSettings { scene_statistics: true, ..ToneSettings::default() };
    let (mut done, all) = (0, photographs.len());
    let root = photographs.first().and_then(|path| path.parent()).unwrap_or(folder).to_owned();
    let paths: Vec<&Path> = photographs.iter().map(PathBuf::as_path).collect();
    let levels = Levels::of_all(light, &paths);
    levels.say();
    let colours = ColourCounts::of_levels(levels);
    let (mut measured, mut undecoded, mut stopped) = (vec![], None, Ok(()));
    photographs.retain(|path| {
        done += 1;
        if stopped.is_ok() {
            stopped = report(PoseProgress::Photographs { done, all });
        }
        if stopped.is_err() {
            return true;
        }
        // A large one is reduced for its statistics.
        let picture =
            PictureFile::open(path).map(|file| file.reduced(|size| reduced_size(size, (1, 1))));
        match picture.and_then(|file| file.decode_counted(&colours)) {
            Ok((image, _)) => measured.push(MeasuredPhotograph::measure(&image.data)),
            Err(error) => {
                tracing::warn!("left out: {error}");
                undecoded = Some(error);
                return false;
            }
        }
        true
    });
    stopped?;
    if let (true, Some(error)) = (photographs.is_empty(), undecoded) {
        return Err(error);
    }
    colours.log();
    let scene = SceneTone::from_photographs(&settings, &measured);
    let scene = scene.ok_or_else(|| all_black(&root))?;
    for (at, (path, measured)) in photographs.iter().zip(&measured).enumerate() {
        let (photograph, _) = PictureFile::open(path)?.decode_counted(&colours)?;
        let image = tone_map(&scene, &photograph, measured)?;
        let file = folder.join(name(path));
        if is_jpeg(path) {
            image.save_jpeg(file, exif_of(path)?.as_deref())?;
        } else {
            image.save_png8(file)?;
        }
        report(PoseProgress::Photographs { done: at + 1, all: photographs.len() })?;
    }
    Ok(scene.exposure.map_or(1.0, |exposure| exposure.gain))
}

/// The name that a tone-mapped photograph is saved under.
pub(super) fn name(photograph: &Path) -> String {
    let name = photograph.file_name().unwrap_or_default().to_string_lossy();
    if is_jpeg(photograph) { name.into_owned() } else { stem(&name).to_owned() + ".png" }
}

fn is_jpeg(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    ending == "jpg" || ending == "jpeg"
}

fn exif_of(path: &Path) -> Result<Option<Vec<u8>>> {
    let bytes = tree::bytes(path)?;
    Ok(exif_segment(&bytes))
}
