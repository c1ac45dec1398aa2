//! Pictures one behind the other: a video through the user's ffmpeg, or a moving PNG.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::base::output::write_whole;
use crate::cli::ImageFormat;
use crate::photographs::image::Image;
use crate::{Error, Result};

/// Refuses, before anything is rendered, a video that could not be made.
///
/// # Errors
/// [`Error::Usage`]: the pictures are to be of a kind that ffmpeg does not read alike.
pub(super) fn check(video: &Path, format: ImageFormat) -> Result<()> {
    if format == ImageFormat::Exr {
        let problem = format!("--video {} is made of PNG; leave out --format exr", video.display());
        return Err(Error::Usage(problem));
    }
    Ok(())
}

/// Makes a video of `files`, which lie in `folder` and are numbered from 0.
///
/// # Errors
/// There is no ffmpeg, in which case its command is said; it failed, or the file cannot be written.
pub(super) fn make(video: &Path, folder: &Path, files: &[PathBuf], fps: u16) -> Result<()> {
    let extension = video.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    if ["png", "apng"].contains(&extension.as_str()) {
        return write_whole(video, &moving_png(files, fps)?);
    }
    let arguments = [
        "-y".to_owned(),
        "-loglevel".to_owned(),
        "error".to_owned(),
        "-framerate".to_owned(),
        fps.to_string(),
        "-i".to_owned(),
        folder.join("%05d.png").display().to_string(),
        // H.264 has its colours at half the size.
        "-vf".to_owned(),
        "pad=ceil(iw/2)*2:ceil(ih/2)*2".to_owned(),
        "-pix_fmt".to_owned(),
        "yuv420p".to_owned(),
        "-frames:v".to_owned(),
        files.len().to_string(),
        video.display().to_string(),
    ];
    let ffmpeg = Command::new("ffmpeg").args(&arguments).stdin(Stdio::null()).output();
    let words = arguments.iter().map(|word| {
        if word.contains(['(', ' ', '*']) { format!("'{word}'") } else { word.clone() }
    });
    let command = format!("ffmpeg {}", words.collect::<Vec<_>>().join(" "));
    match ffmpeg {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let printed = String::from_utf8_lossy(&output.stderr);
            let last = printed.lines().next_back().unwrap_or("it said nothing").to_owned();
            Err(Error::output(video, format!("ffmpeg failed: {last}; it was `{command}`")))
        }
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let problem = format!(
                "is not made, as there is no ffmpeg; the pictures are in {}. Install it (apt, dnf, brew or winget install \
                 ffmpeg) and run `{command}`, or name a file .png, a moving PNG, which needs nothing",
                folder.display()
            );
            Err(Error::output(video, problem))
        }
        Err(error) => Err(Error::output(video, format!("ffmpeg cannot be run: {error}"))),
    }
}

/// A PNG that moves, forever; what cannot show that shows the first picture.
fn moving_png(files: &[PathBuf], fps: u16) -> Result<Vec<u8>> {
    let failed = |error: png::EncodingError| {
        Error::output("the moving PNG", format!("cannot be encoded: {error}"))
    };
    let mut encoded = vec![];
    let (width, height) = files.first().map_or(Ok((0, 0)), Image::size_of)?;
    let mut encoder = png::Encoder::new(&mut encoded, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_animated(files.len() as u32, 0).map_err(failed)?;
    encoder.set_frame_delay(1, fps).map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    for file in files {
        writer.write_image_data(&Image::load(file)?.to_rgb8()).map_err(failed)?;
    }
    writer.finish().map_err(failed)?;
    Ok(encoded)
}
