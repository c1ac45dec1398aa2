//! A video of rendered frames: by the user's ffmpeg, or an animated PNG.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nightsplat_core::output::write_whole;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::{Image, ImageFile};

/// Makes a video of `files`.
pub fn make(video: &Path, folder: &Path, files: &[PathBuf], fps: u16) -> Result<()> {
    let extension = video.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    if ["png", "apng"].contains(&extension.as_str()) {
        return write_whole(video, &animated_png(files, fps)?);
    }
    let rate = fps.to_string();
    // A name that begins with a dash is not an option.
    let name = Path::new(".").join(video).display().to_string();
    // Even sizes, since H.264 subsamples colour.
    let output = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", &name];
    let piped = [
        "-y",
        "-loglevel",
        "error",
        "-f",
        "image2pipe",
        "-c:v",
        "png",
        "-framerate",
        &rate,
        "-i",
        "-",
    ];
    let ffmpeg = Command::new("ffmpeg")
        .args(piped.iter().chain(&output))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn();
    let ffmpeg = ffmpeg.and_then(|mut ffmpeg| {
        if let Some(mut pipe) = ffmpeg.stdin.take() {
            // If ffmpeg ends early, its own message is the one to show.
            let _ = files.iter().try_for_each(|file| pipe.write_all(&std::fs::read(file)?));
        }
        ffmpeg.wait_with_output()
    });
    let by_hand = folder.join("*.png").display().to_string();
    let arguments = ["-framerate", &rate, "-pattern_type", "glob", "-i", &by_hand];
    let arguments = arguments.iter().chain(&output);
    let words = arguments.map(|word| {
        if word.contains(['(', ' ', '*']) { format!("'{word}'") } else { (*word).to_owned() }
    });
    let command = format!("ffmpeg {}", words.collect::<Vec<_>>().join(" "));
    match ffmpeg {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let printed = String::from_utf8_lossy(&output.stderr);
            let first = printed.lines().next().unwrap_or("no message");
            Err(Error::output(
                video,
                format!("ffmpeg failed: {first}; the command was `{command}`"),
            ))
        }
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let problem = format!(
                "needs ffmpeg, which is not installed; the frames are in {}. Install it (apt, dnf, brew or \
                 winget install ffmpeg) and run `{command}`, or name a .png file for an animated PNG, which \
                 needs no ffmpeg",
                folder.display()
            );
            Err(Error::output(video, problem))
        }
        Err(error) => Err(Error::output(video, format!("ffmpeg cannot be run: {error}"))),
    }
}

/// An endlessly animated PNG; viewers without support show the first frame.
fn animated_png(files: &[PathBuf], fps: u16) -> Result<Vec<u8>> {
    let failed = |error: png::EncodingError| {
        Error::output("the animated PNG", format!("cannot be encoded: {error}"))
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
