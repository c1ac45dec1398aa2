//! Clips: their sharpest frames, and those of HDR.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_pose::PoseOptions;

use crate::common::{Folder, file_names, not_run, says};
use crate::stub::{SEEN, dark_picture, is_installed, nothing_is_left, script, stub};
use crate::synthetic::SIZE;
use crate::{pose, refused};

#[test]
fn the_sharpest_frame_of_each_window_of_a_clip_is_used() {
    if !is_installed("ffmpeg") {
        return;
    }
    let root = &Folder::empty();
    fs::create_dir(root.join("frames")).unwrap();
    // Two seconds of eight frames; the third of every four is sharp.
    for index in 0..16 {
        let picture = dark_picture(index / 4);
        let frame =
            if index % 4 == 2 { picture } else { picture.resized(10, 8).resized(SIZE.0, SIZE.1) };
        frame.save_png8(root.join(format!("frames/{index:03}.png"))).unwrap();
    }
    let made = Command::new("ffmpeg")
        .args(["-framerate", "8", "-i", "frames/%03d.png", "-c:v", "ffv1", "clip.mkv"])
        .current_dir(root)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    stub(root, SEEN);
    let clip = PoseOptions { photos: root.join("clip.mkv"), ..pose(root) };
    let told = refused(&clip, 3, &["mapper ended with"]);
    says(&told, &["4 photographs brightened"]);
    let seen = [3, 7, 11, 15].map(|frame| format!("frame_{frame:06}.png"));
    assert_eq!(file_names(root.join("seen")), seen);
    nothing_is_left(root);
}

/// A clip of one dark image, made by ffmpeg with these filters and options; `None` if this ffmpeg cannot.
fn clip_of(root: &Path, name: &str, filters: &str, options: &[&str]) -> Option<PathBuf> {
    dark_picture(1).save_png8(root.join("source.png")).unwrap();
    let clip = root.join(name);
    let still = "-v error -loop 1 -framerate 8 -i source.png -frames:v 4 -c:v ffv1";
    let made = Command::new("ffmpeg")
        .args(still.split(' '))
        .args(["-vf", filters])
        .args(options)
        .arg(&clip)
        .current_dir(root)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    made.status.success().then_some(clip)
}

#[test]
fn hdr_and_wide_gamut_clips_give_the_frames_of_an_sdr_clip() {
    if !is_installed("ffmpeg") || !is_installed("ffprobe") {
        return;
    }
    let root = &Folder::empty();
    stub(root, SEEN);
    let seen = |clip: &Path| {
        let clip = PoseOptions { photos: clip.to_owned(), ..pose(root) };
        let told = refused(&clip, 3, &["mapper ended with"]);
        let frame = fs::read_dir(root.join("seen")).unwrap().next().unwrap().unwrap().path();
        let frame = Image::load(frame);
        fs::remove_dir_all(root.join("seen")).unwrap();
        nothing_is_left(root);
        (frame.unwrap(), told)
    };
    let plain = clip_of(root, "plain.mkv", "null", &[]).unwrap();
    let (expected, message) = seen(&plain);
    assert!(!message.contains("HDR") && !message.contains("converted to sRGB"), "{message}");
    for (transfer, part) in
        [("arib-std-b67", "HDR (HLG)"), ("smpte2084", "HDR (PQ)"), ("bt709", "Rec. 2020")]
    {
        let filters = format!(
            "zscale=pin=bt709:tin={}:min=gbr:p=bt2020:t={transfer}:m=bt2020nc:r=tv:npl=203,format=yuv444p12le",
            if transfer == "bt709" { "bt709" } else { "iec61966-2-1" }
        );
        let tags =
            ["-color_primaries", "bt2020", "-color_trc", transfer, "-colorspace", "bt2020nc"];
        let Some(clip) = clip_of(root, "wide.mkv", &filters, &tags) else {
            not_run("ffmpeg", "this one has no zscale");
            return;
        };
        let (frame, message) = seen(&clip);
        assert!(message.contains(part), "{message}");
        let differences = frame.data.iter().zip(&expected.data).map(|(a, b)| (a - b).abs());
        let mean = differences.sum::<f32>() / frame.data.len() as f32;
        assert!(mean < 0.01, "{transfer}: {mean}");
        fs::remove_file(clip).unwrap();
    }
}

#[test]
fn without_the_hdr_filters_of_ffmpeg_the_error_has_the_command() {
    let root = &Folder::empty();
    dark_picture(1).save_png8(root.join("source.png")).unwrap();
    let copy = format!("for last; do :; done; cp {}/source.png $(printf $last 1)", root.display());
    script(&root.join("ffmpeg"), &copy);
    script(&root.join("ffprobe"), "echo arib-std-b67");
    root.write("clip.mov", "a clip");
    let options = PoseOptions {
        photos: root.join("clip.mov"),
        colmap: "true".into(),
        ffmpeg: root.join("ffmpeg"),
        ..pose(root)
    };
    refused(&options, 3, &["clip.mov: is HDR (HLG)", "zscale=t=linear", "sdr.mp4"]);
    script(&root.join("ffprobe"), "exit 1");
    says(&refused(&options, 3, &[]), &["ffprobe", "assuming SDR"]);
}
