//! `nightsplat pose`: external programs, their failures, and the written dataset; COLMAP itself if it is installed.

use super::synthetic::*;
use crate::common::command::{file_names, says};
use crate::common::not_run;
use crate::common::prelude::*;

/// A program `colmap-stub` with the command line of COLMAP, and a few lines of shell for each of its commands.
pub(super) fn stub(folder: &Path, cases: &str) {
    let path = folder.join("colmap-stub");
    let lines = format!(
        "root={}\n\
         command=$1; shift\n\
         if [ \"$1\" = -h ]; then\n\
         [ $command = mapper ] && echo '  --Mapper.init_min_tri_angle arg (=16)'\n\
         exit 0\n\
         fi\n\
         while [ $# -gt 0 ]; do\n\
         case $1 in\n\
         --database_path) database=$2;;\n\
         --image_path) images=$2;;\n\
         --output_path) output=$2;;\n\
         --image_list_path) list=$2;;\n\
         --ImageReader.mask_path) masks=$2;;\n\
         --Mapper.init_min_tri_angle) angle=$2;;\n\
         esac\n\
         shift\n\
         done\n\
         case $command in\n\
         {cases}\n\
         esac\n",
        folder.display()
    );
    script(&path, &lines);
}

/// A [`stub`] that lists learned features.
pub(super) fn learned_stub(folder: &Path, cases: &str) {
    stub(folder, cases);
    let path = folder.join("colmap-stub");
    let option = "  --AlikedExtraction.max_num_features arg (=2048)";
    let lines = fs::read_to_string(&path).unwrap();
    let help =
        format!("[ $command = feature_extractor ] && echo '{option}'\n[ $command = mapper ] &&");
    fs::write(&path, lines.replacen("[ $command = mapper ] &&", &help, 1)).unwrap();
}

/// The command for `photos` with the stub, and these options.
pub(super) fn pose(options: &str) -> String {
    format!("pose @photos --out @scene --colmap @colmap-stub {options}")
}

/// The case of a stub that finds the models in `models`.
pub(super) const MODELS: &str = "mapper) cp -r $root/models/* $output;;";

/// The case of a stub that keeps what it sees in `seen`, and finds nothing.
const SEEN: &str = "mapper) cp -r $images $root/seen; exit 1;;";

/// A shell script with these lines.
fn script(path: &Path, lines: &str) {
    use std::os::unix::fs::PermissionsExt;
    fs::write(path, format!("#!/bin/sh\n{lines}\n")).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
}

/// Dark photographs with some detail, `photos/v00.png` to `v08.png`.
pub(super) fn photographed(root: &Path) -> PathBuf {
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    for index in 0..9 {
        dark_picture(index).save_png8(photos.join(name(index)).with_extension("png")).unwrap();
    }
    photos
}

/// The mean of an image.
pub(super) fn mean(path: &Path) -> f32 {
    let data = Image::load(path).unwrap().data;
    data.iter().sum::<f32>() / data.len() as f32
}

fn dark_picture(index: usize) -> Image {
    Image::from_fn(SIZE.0, SIZE.1, |x, y| {
        let value = 0.02 + 0.06 * f32::from((x / 3 + y / 4 + index as u32).is_multiple_of(2));
        [value, 0.8 * value, 0.6 * value]
    })
}

/// A failed dataset leaves only its log.
fn nothing_is_left(root: &Path) {
    let mut beside = file_names(root);
    beside.retain(|name| name.starts_with("scene") && name != "scene.colmap.log");
    assert!(beside.is_empty(), "{beside:?}");
}

#[test]
fn the_dark_photographs_get_the_cameras_of_the_largest_model() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    model(2).write_binary(&root.join("models/0"));
    model(8).write_binary(&root.join("models/1"));
    stub(root, "mapper) cp -r $root/models/* $output; cp -r $images $root/seen;;");
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["8 of 9 photographs", "nightsplat train"]);
    let stages =
        ["9 photographs brightened", "features extracted", "features matched", "cameras placed"];
    says(&stderr, &stages);
    for index in 0..8 {
        let file = name(index) + ".png";
        let [dark, kept] =
            [&photos, &out.join("images")].map(|folder| fs::read(folder.join(&file)).unwrap());
        assert_eq!(dark, kept, "{file}");
        assert!(
            mean(&root.join("seen").join(&file)) > 4.0 * mean(&photos.join(&file)),
            "COLMAP sees {file} in the dark"
        );
    }
    assert!(!out.join("images/v08.png").exists() && !out.join("work").exists());
    says(&root.text("scene/colmap.log"), &["$ "]);
    let dataset = load(&out);
    assert_eq!((dataset.views.len(), dataset.points.len()), (8, 20));
    // An existing folder is kept, unless `pose` wrote it and may replace it.
    root.refused(&pose(""), 1, &["scene", "exists already", "--overwrite"]);
    root.succeed(&pose("--overwrite"));
    fs::remove_file(out.join("colmap.log")).unwrap();
    root.refused(&pose("--overwrite"), 1, &["exists already; choose another folder"]);
}

/// One photograph in nine has no camera, so all are matched again.
#[test]
fn a_failed_second_matching_keeps_the_cameras_of_the_first() {
    let root = &Folder::empty();
    photographed(root);
    model(8).write_binary(&root.join("models/0"));
    let once = "[ -e $root/once ] && exit 9; touch $root/once; cp -r $root/models/* $output";
    stub(root, &format!("mapper) {once};;"));
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["8 of 9 photographs"]);
    says(&stderr, &["using the cameras found so far"]);
}

#[test]
fn cameras_are_registered_globally_by_colmap_or_else_by_glomap() {
    let root = &Folder::empty();
    photographed(root);
    model(8).write_binary(&root.join("models/0"));
    let globally = |out: &str, glomap: &str| {
        pose(&format!("--mapper global --glomap {glomap}")).replace("@scene", out)
    };
    // COLMAP has this command from 4.0 on.
    stub(root, "help) echo global_mapper;;\nglobal_mapper) cp -r $root/models/* $output;;");
    says(&root.succeed(&globally("@new", "/nowhere/glomap")), &["8 of 9 photographs"]);
    let log = root.text("new/colmap.log");
    let calibrated = log.find(" view_graph_calibrator --database_path").unwrap();
    assert!(log.find(" global_mapper --database_path").unwrap() > calibrated, "{log}");

    stub(root, MODELS);
    fs::rename(root.join("colmap-stub"), root.join("glomap")).unwrap();
    stub(root, "mapper) exit 9;;");
    root.succeed(&globally("@old", "@glomap"));
    assert_eq!(load(&root.join("old")).views.len(), 8);
    let parts = ["`/nowhere/glomap` is not found", "COLMAP 4.0", "--glomap PATH"];
    root.refused(&globally("@none", "/nowhere/glomap"), 2, &parts);
    assert!(!root.join("none").exists());
    let lost = "global_mapper) echo 'failed to create sparse model'; exit 1;;";
    stub(root, &format!("help) echo global_mapper;;\n{lost}"));
    let (_, stderr) = root.run(&globally("@none", "glomap"), 3);
    says(&stderr, &["no cameras for these 9 photographs"]);
}

#[test]
fn a_failure_of_colmap_is_reported_in_a_line_and_leaves_no_dataset() {
    let root = &Folder::empty();
    photographed(root);
    model(2).write_binary(&root.join("models/0"));
    let pair = "mapper) echo 'E0 => No good initial image pair found'; exit 1;;";
    let fails = "feature_extractor) echo first; echo; echo no such camera >&2; exit 3;;";
    for (cases, parts) in [
        (fails, &["feature_extractor ended with", "3: no such camera"][..]),
        ("exhaustive_matcher) kill -9 $$;;", &["_matcher ended with signal: 9", "no output"]),
        (MODELS, &["no cameras for these 9 photographs", "scene.colmap.log"]),
        (pair, &["no cameras for these 9"]),
        ("mapper) echo broken; exit 1;;", &["mapper ended with", "broken"]),
    ] {
        stub(root, cases);
        let (_, stderr) = root.run(&pose(""), 3);
        let errors: Vec<&str> = stderr.lines().filter(|line| line.starts_with("error: ")).collect();
        assert_eq!(errors.len(), 1, "{stderr}");
        says(errors[0], parts);
        assert!(root.join("scene.colmap.log").is_file());
        nothing_is_left(root);
    }
}

#[test]
fn colmap_gets_the_focal_length_of_the_exif() {
    let root = &Folder::empty();
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    // Orientation 6 and a focal length of 28 mm equivalent, big-endian as in some cameras.
    let exif = b"MM\0*\0\0\0\x08\0\x02\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\x87\x69\0\x04\0\0\0\x01\0\0\0\x26\0\0\0\0\
        \0\x01\xa4\x05\0\x03\0\0\0\x01\0\x1c\0\0\0\0\0\0";
    for index in 0..3 {
        let jpeg = fs::read(crate::common::fixture("jpeg/444.jpg")).unwrap();
        let length = (exif.len() as u16 + 8).to_be_bytes();
        let segment = [&[0xFF, 0xE1][..], &length, b"Exif\0\0", exif].concat();
        let turned = [&jpeg[..2], &segment, &jpeg[2..]].concat();
        fs::write(photos.join(format!("{index}.JPG")), turned).unwrap();
    }
    stub(root, SEEN);
    root.run(&pose(""), 3);
    for index in 0..3 {
        let seen = fs::read(root.join(format!("seen/{index}.JPG"))).unwrap();
        let focal = b"\xa4\x05\0\x03\0\0\0\x01\0\x1c";
        assert!(seen.windows(focal.len()).any(|bytes| bytes == focal));
        // The tone-mapped copy is in the stored orientation and marked as upright: cameras are those of the stored
        // photograph.
        let upright = b"\x01\x12\0\x03\0\0\0\x01\0\x01";
        assert!(seen.windows(upright.len()).any(|bytes| bytes == upright));
        assert_eq!(Image::size_of(root.join(format!("seen/{index}.JPG"))).unwrap(), (37, 29));
    }
}

#[test]
fn problems_before_the_start_are_reported_in_a_line() {
    let root = &Folder::empty();
    let photos = photographed(root);
    fs::create_dir(root.join("empty")).unwrap();
    root.write("clip.mp4", "no clip");
    root.write("no.mp4", "");
    fs::create_dir(root.join("twice")).unwrap();
    for copy in ["twice/v00.png", "twice/v00.webp", "twice/v01.png"] {
        fs::copy(photos.join("v01.png"), root.join(copy)).unwrap();
    }
    (0..9).for_each(|i| photograph(&root.join(format!("black/{}.png", name(i))), SIZE, 0.0));
    let absent = "pose @photos --out @scene --colmap /nowhere/colmap";
    let remedies =
        ["`/nowhere/colmap` is not found", "apt install colmap", "brew install", "--colmap PATH"];
    root.refused(absent, 2, &remedies);
    assert!(root.run(absent, 2).1.len() < 240, "a short line");
    let ffmpeg = "`/nowhere/ffmpeg` is & apt install ffmpeg & --ffmpeg PATH";
    let of_true = "--out @scene --colmap true";
    root.refuses_all(&format!(
        "3 | train @photos --out @run | 9 photographs & nightsplat pose & --out DATASET
         2 | {absent} --patience -1 | --patience
         3 | pose @absent {of_true} | absent & cannot be read
         3 | pose @empty {of_true} | contains 0 photographs
         2 | pose @photos {of_true} --fps 0 | --fps
         2 | pose @clip.mp4 {of_true} --ffmpeg /nowhere/ffmpeg | {ffmpeg}
         3 | pose @clip.mp4 {of_true} --ffmpeg false | clip.mp4: is no clip & false & ended with & pass a clip
         3 | pose @no.mp4 {of_true} --ffmpeg false | no.mp4: is no clip & the file is empty & pass a clip
         3 | pose @twice {of_true} | v00.png and v00.webp have the same name
         3 | pose @black {of_true} | /black & black"
    ));
    nothing_is_left(root);
}

/// Whether an external program is installed; prints a line if not.
#[track_caller]
pub(super) fn is_installed(program: &str) -> bool {
    let is_there = Command::new(program).arg("-h").stdin(Stdio::null()).output().is_ok();
    if !is_there {
        not_run(program, "it is not installed");
    }
    is_there
}

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
    let (_, stderr) = root.run(&pose("--fps 2").replace("@photos", "@clip.mkv"), 3);
    says(&stderr, &["4 photographs brightened"]);
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
        let arguments = pose("--fps 2").replace("@photos", clip.to_str().unwrap());
        let (_, stderr) = root.run(&arguments, 3);
        let frame = fs::read_dir(root.join("seen")).unwrap().next().unwrap().unwrap().path();
        let frame = Image::load(frame);
        fs::remove_dir_all(root.join("seen")).unwrap();
        nothing_is_left(root);
        (frame.unwrap(), stderr)
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
    let arguments = "pose @clip.mov --out @scene --colmap true --ffmpeg @ffmpeg";
    root.refused(arguments, 3, &["clip.mov: is HDR (HLG)", "zscale=t=linear", "sdr.mp4"]);
    script(&root.join("ffprobe"), "exit 1");
    says(&root.run(arguments, 3).1, &["ffprobe", "assuming SDR"]);
}

/// Burns a line of text into the last rows of photographs of 200x150; its end changes.
fn burn_in_text(folder: &Path) {
    let mut files: Vec<PathBuf> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    for (index, file) in files.iter().enumerate() {
        let mut picture = Image::load(file).unwrap();
        let (width, pixels) = (picture.width as usize, picture.pixel_count());
        for pixel in 138 * width..pixels {
            let (column, row) = (pixel % width / 4, (pixel / width - 138) / 3);
            let changes = if column >= 40 { 5 * index } else { 0 };
            let is_lit = (7 * column + 13 * row + changes + column * row % 5) % 11 < 4;
            let value = f32::from(u8::from(is_lit && row < 3 && column < 48));
            (0..3).for_each(|channel| picture.data[channel * pixels + pixel] = value);
        }
        picture.save_png8(file).unwrap();
    }
}

#[test]
fn colmap_finds_the_cameras_of_a_dark_set_with_a_date_burnt_into_it() {
    if !is_installed("colmap") {
        return;
    }
    let root = &Folder::empty();
    nightsplat_synth::write(root.join("set"), &small_set(20, [200, 150], 3)).unwrap();
    burn_in_text(&root.join("set/low"));
    root.succeed("pose @set/low --out @scene");
    let (truth, found) = (load(&root.join("set")), load(&root.join("scene")));
    assert!(found.views.len() >= 15, "{} of 20", found.views.len());
    assert!(found.points.len() > 50, "{} points", found.points.len());
    // Distances between cameras, whose scale is free.
    let center = |name: &str, set: &Dataset| view(set, name).camera.center();
    let names: Vec<&str> = found.views.iter().map(|view| view.name.as_str()).collect();
    let spans = names.windows(3).map(|three| {
        let span = |set| center(three[0], set).distance(center(three[2], set));
        span(&found) / span(&truth)
    });
    let spans: Vec<f64> = spans.collect();
    let mean = spans.iter().sum::<f64>() / spans.len() as f64;
    assert!(spans.iter().all(|span| (span / mean - 1.0).abs() < 0.1), "{spans:?}");
}

#[test]
#[ignore = "two minutes: of `make stress`"]
fn real_dark_photographs_train_as_well_with_cameras_from_colmap_as_with_supplied_ones() {
    let Some(chair) = shared("data/lom/chair") else { return };
    if !is_installed("colmap") {
        return;
    }
    let folder = Folder::empty();
    let held_out = names(&load(&chair), Split::Test).join("\n");
    let chair = chair.display();
    folder.succeed(&format!("pose {chair}/low --out @scene"));
    assert_eq!(load(&folder.join("scene")).views.len(), 48);
    folder.write("scene/test.txt", held_out);
    let trained = |set: &str, out: &str| {
        let options = "--downscale 4 --steps 1000 --seed 1";
        folder.succeed(&format!("train {set} {options} --out @{out}"));
        folder.json(&format!("{out}/metrics.json"))["mean"]["psnr"].as_f64().unwrap()
    };
    let found = trained(&format!("@scene --reference {chair}/high"), "found");
    let given = trained(&chair.to_string(), "given");
    println!("{found:.2} dB with the cameras that COLMAP finds, {given:.2} dB with those supplied");
    assert!(found > given - 0.3);
}
