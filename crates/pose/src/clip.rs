//! Extracts the sharpest frame of each time window of a clip.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_core::output::create_folder;
use nightsplat_photographs::image::files::photographs_in;
use nightsplat_photographs::image::{Image, ImageFile};
use rayon::prelude::*;

use super::tool::Tool;
use nightsplat_core::{Error, Result};

/// Frames per window.
const CANDIDATES: usize = 4;

/// Extracts `fps` frames per second of a clip as PNG files in `folder`.
pub(super) fn frames(
    ffmpeg: &Tool<'_>,
    clip: &Path,
    fps: f64,
    folder: &Path,
) -> Result<Vec<PathBuf>> {
    create_folder(folder)?;
    let transfer = ffmpeg.probe(clip, "color_transfer");
    let filters = filters(ffmpeg, clip, transfer.as_deref().unwrap_or_default())?;
    let filter = format!("fps={}{filters}", fps * CANDIDATES as f64);
    let pattern = pattern(folder);
    let options = ["-hide_banner", "-nostdin", "-i"].map(OsStr::new);
    let files = [clip.as_os_str(), "-vf".as_ref(), filter.as_ref(), pattern.as_os_str()];
    let decoded = ffmpeg.run("", &[&options[..], &files].concat(), None, |_| {});
    decoded.map_err(|error| match error {
        Error::Input { path, problem } => no_frames(clip, &format!("{}{problem}", path.display())),
        error => error,
    })?;
    let frames = photographs_in(folder)?;
    if frames.is_empty() {
        return Err(no_frames(clip, "it has no pictures"));
    }
    if transfer.is_none() {
        tracing::warn!(
            "{}: ffprobe, which comes with ffmpeg, does not report its colour space; assuming SDR",
            clip.display()
        );
    }
    let sharpness = frames.par_iter().map(|frame| Ok(sharpness(&Image::load(frame)?)));
    let sharpness = sharpness.collect::<Result<Vec<f64>>>()?;
    let mut kept = vec![];
    for (window, sharpness) in frames.chunks(CANDIDATES).zip(sharpness.chunks(CANDIDATES)) {
        let sharpest =
            (0..window.len()).rev().max_by(|&a, &b| sharpness[a].total_cmp(&sharpness[b]));
        for (at, frame) in window.iter().enumerate() {
            if sharpest == Some(at) {
                kept.push(frame.clone());
            } else {
                fs::remove_file(frame)
                    .map_err(|error| Error::output(frame, format!("cannot be removed: {error}")))?;
            }
        }
    }
    Ok(kept)
}

fn no_frames(clip: &Path, why: &str) -> Error {
    let why = match fs::metadata(clip) {
        Ok(file) if file.len() == 0 => "the file is empty",
        _ => why,
    };
    let remedy = "pass a clip that plays, a folder of photographs or a dataset";
    Error::input(clip, format!("is no clip that ffmpeg can decode ({why}); {remedy}"))
}

/// The files of the frames, for ffmpeg: a per cent sign of the folder is doubled.
fn pattern(folder: &Path) -> PathBuf {
    let escaped = folder.to_str().map(|folder| PathBuf::from(folder.replace('%', "%%")));
    escaped.unwrap_or_else(|| folder.to_owned()).join("frame_%06d.png")
}

/// ffmpeg's filters that convert HLG and PQ to sRGB, with white at 203 cd/m2 (BT.2408). Brighter values are clipped: a
/// curve that compresses them would change dark values, too.
const STANDARD_RANGE: &str = "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=clip:desat=0,\
                              zscale=t=iec61966-2-1:m=gbr:r=full,format=gbrp16le";

/// The filters after `fps` for a clip with this transfer function: [`STANDARD_RANGE`] for HLG and PQ, else none. Frames
/// with wide primaries have them in their metadata, and are converted when they are read.
fn filters(ffmpeg: &Tool<'_>, clip: &Path, transfer: &str) -> Result<String> {
    let range = match transfer {
        "arib-std-b67" => "HLG",
        "smpte2084" => "PQ",
        _ => return Ok(String::new()),
    };
    let has = |filter: &str| ffmpeg.help_contains(&["-hide_banner", "-filters"], filter);
    if !has(" zscale ") || !has(" tonemap ") {
        let path = clip.display();
        let problem = format!(
            "is HDR ({range}), and this ffmpeg lacks zscale and tonemap; with one that has them: ffmpeg -i {path} -vf \
             {STANDARD_RANGE},format=yuv444p -color_primaries bt709 -color_trc iec61966-2-1 -crf 10 sdr.mp4"
        );
        return Err(Error::input(clip, problem));
    }
    tracing::warn!(
        "{}: HDR ({range}) converted to sRGB; values brighter than its white are clipped",
        clip.display()
    );
    Ok(format!(",{STANDARD_RANGE}"))
}

/// Detail relative to brightness: mean absolute second difference over the mean. Neighbouring frames have the same
/// noise level, but not the same motion blur.
fn sharpness(frame: &Image) -> f64 {
    let (width, pixels) = (frame.width as usize, frame.pixel_count());
    let plane = &frame.data[pixels..2 * pixels];
    let (mut detail, mut light) = (0.0, f64::EPSILON);
    for row in plane.chunks_exact(width) {
        for near in row.windows(5) {
            // Two pixels apart, since adjacent pixels differ mostly by noise and compression.
            detail += f64::from((2.0 * near[2] - near[0] - near[4]).abs());
            light += f64::from(near[2]);
        }
    }
    detail / light
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_per_cent_sign_of_a_folder_is_no_number() {
        let found = pattern(Path::new("night 100%d/frames"));
        assert_eq!(found, Path::new("night 100%%d/frames/frame_%06d.png"));
    }

    #[test]
    fn motion_blur_lowers_the_sharpness_of_a_frame() {
        let frame = |reach: i32| {
            let value = |x: i32, y: u32| 0.05 + 0.04 * f32::from((x / 5 + y as i32 / 5) % 2 == 0);
            Image::from_fn(60, 40, |x, y| {
                let sum: f32 = (-reach..=reach).map(|by| value(x as i32 + by + 20, y)).sum();
                [sum / (2 * reach + 1) as f32; 3]
            })
        };
        assert!(sharpness(&frame(0)) > 1.2 * sharpness(&frame(1)));
        assert!(sharpness(&frame(1)) > 1.2 * sharpness(&frame(4)));
    }
}
