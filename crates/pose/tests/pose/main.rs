//! Cameras of dark photographs: external programs, their failures, and the written dataset; COLMAP itself if it is
//! installed. The host brightens the photographs.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;
#[path = "../../../../tests/common/log.rs"]
mod log;
#[path = "../../../photographs/tests/photographs/formats/synthetic.rs"]
mod synthetic;

mod bright;
mod cameras;
mod clips;
mod programs;
mod stub;

use std::cell::RefCell;
use std::path::Path;

use nightsplat_core::Result;
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::InverseTone;
use nightsplat_pose::{Mapper, PoseOptions, PoseProgress, PoseWatch, Posed, ToneMapper, estimate};

use common::says;

/// The photographs in `photos` of a folder, with the stub, for a dataset `scene`.
fn pose(root: &Path) -> PoseOptions {
    PoseOptions {
        photos: root.join("photos"),
        with: None,
        out: root.join("scene"),
        overwrite: false,
        colmap: root.join("colmap-stub"),
        glomap: "glomap".into(),
        ffmpeg: "ffmpeg".into(),
        patience: 2.0,
        matcher: None,
        features: None,
        mapper: Mapper::Incremental,
        colmap_options: vec![],
        camera_model: "OPENCV".to_owned(),
        colmap_gpu: false,
        fps: 2.0,
        light: None,
    }
}

fn tone_mapper() -> Result<ToneMapper> {
    Ok(Box::new(|scene, photograph, measured| {
        let curve = InverseTone::new(scene.settings(), &scene.curve_of(measured))?;
        Ok(Image::from_fn(photograph.width, photograph.height, |x, y| {
            curve.target(photograph.pixel(x, y).map(f64::from)).map(|value| value as f32)
        }))
    }))
}

/// What is found, and what is told meanwhile: lines of progress, then warnings.
fn estimated(options: &PoseOptions) -> (Result<Posed>, String) {
    let lines = RefCell::new(String::new());
    let report = |progress: PoseProgress<'_>| {
        if let PoseProgress::Line(line) = progress {
            *lines.borrow_mut() += &format!("{line}\n");
        }
    };
    let watch = PoseWatch { report: &report, stops: &|| None };
    let mut posed = None;
    let warnings = log::warnings(|| posed = Some(estimate(options, &tone_mapper, &watch)));
    (posed.unwrap(), lines.into_inner() + &warnings)
}

/// [`estimated`], of which this many photographs of all must have a camera.
#[track_caller]
fn finds_cameras(options: &PoseOptions, placed: usize, all: usize) -> String {
    let (posed, told) = estimated(options);
    let posed = posed.unwrap_or_else(|error| panic!("{error}: {told}"));
    assert_eq!((posed.placed, posed.photographs), (placed, all), "{told}");
    told
}

/// [`estimated`], which must fail with this exit code and a line that contains all of `parts`.
#[track_caller]
fn refused(options: &PoseOptions, code: u8, parts: &[&str]) -> String {
    let (posed, told) = estimated(options);
    let error = posed.expect_err(&told);
    let message = error.to_string();
    assert_eq!(error.exit_code(), code, "{message}");
    assert!(!message.contains('\n'), "more than a line: {message}");
    says(&message, parts);
    told
}
