//! A program that stands in for COLMAP, and photographs and models for it.

#![allow(dead_code, reason = "the tests of the command use a part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nightsplat_photographs::image::{Image, ImageFile as _};

use super::synthetic::{Model, SIZE, model, name};
use crate::common::{file_names, not_run};

/// A program `colmap-stub` with the command line of COLMAP, and a few lines of shell for each of its commands.
pub(crate) fn stub(folder: &Path, cases: &str) {
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
pub(crate) fn learned_stub(folder: &Path, cases: &str) {
    stub(folder, cases);
    let path = folder.join("colmap-stub");
    let option = "  --AlikedExtraction.max_num_features arg (=2048)";
    let lines = fs::read_to_string(&path).unwrap();
    let help =
        format!("[ $command = feature_extractor ] && echo '{option}'\n[ $command = mapper ] &&");
    fs::write(&path, lines.replacen("[ $command = mapper ] &&", &help, 1)).unwrap();
}

/// The case of a stub that finds the models in `models`.
pub(crate) const MODELS: &str = "mapper) cp -r $root/models/* $output;;";

/// The case of a stub that keeps what it sees in `seen`, and finds nothing.
pub(crate) const SEEN: &str = "mapper) cp -r $images $root/seen; exit 1;;";

/// A shell script with these lines.
pub(crate) fn script(path: &Path, lines: &str) {
    use std::os::unix::fs::PermissionsExt;
    fs::write(path, format!("#!/bin/sh\n{lines}\n")).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
}

/// Dark photographs with some detail, `photos/v00.png` to `v08.png`.
pub(crate) fn photographed(root: &Path) -> PathBuf {
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    for index in 0..9 {
        dark_picture(index).save_png8(photos.join(name(index)).with_extension("png")).unwrap();
    }
    photos
}

/// The mean of an image.
pub(crate) fn mean(path: &Path) -> f32 {
    let data = Image::load(path).unwrap().data;
    data.iter().sum::<f32>() / data.len() as f32
}

pub(crate) fn dark_picture(index: usize) -> Image {
    Image::from_fn(SIZE.0, SIZE.1, |x, y| {
        let value = 0.02 + 0.06 * f32::from((x / 3 + y / 4 + index as u32).is_multiple_of(2));
        [value, 0.8 * value, 0.6 * value]
    })
}

/// A failed dataset leaves only its log.
pub(crate) fn nothing_is_left(root: &Path) {
    let mut beside = file_names(root);
    beside.retain(|name| name.starts_with("scene") && name != "scene.colmap.log");
    assert!(beside.is_empty(), "{beside:?}");
}

/// Bright photographs `day/v00.png` to `day/v03.png`: names of dark photographs, too.
pub(crate) fn bright(root: &Path) -> PathBuf {
    let day = root.join("day");
    fs::create_dir_all(&day).unwrap();
    for index in 0..4 {
        let picture = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
            [0.3 + 0.5 * f32::from((x / 4 + y / 3 + index).is_multiple_of(2)); 3]
        });
        picture.save_png8(day.join(name(index as usize)).with_extension("png")).unwrap();
    }
    day
}

/// A model of the first eight dark photographs, three of which are called bright ones.
pub(crate) fn mixed() -> Model {
    let mut model = model(8);
    for (_, _, _, name) in &mut model.images[..3] {
        *name = format!("bright/v{:02}.png", name[1..3].parse::<usize>().unwrap() - 5);
    }
    model
}

/// Whether an external program is installed; prints a line if not.
#[track_caller]
pub(crate) fn is_installed(program: &str) -> bool {
    let is_there = Command::new(program).arg("-h").stdin(Stdio::null()).output().is_ok();
    if !is_there {
        not_run(program, "it is not installed");
    }
    is_there
}
