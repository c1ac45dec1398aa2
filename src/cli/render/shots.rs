//! What `render` renders: the dataset's views, or the frames of a path.

use glam::DVec3;
use nightsplat_core::camera::{Camera, CameraModel, CameraPath, FramePath, PathOptions};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::Orientation;

use super::{PathChoice, RenderArgs};
use crate::train::TrainConfig;
use crate::{Error, Result};

/// An image to render.
pub(super) struct Shot {
    /// File name without extension.
    pub(super) name: String,
    pub(super) camera: Camera,
    /// How its image is rotated for display.
    pub(super) orientation: Orientation,
}

/// The number of frames, unless the path states it.
const FRAMES: usize = 120;
/// Frames per second, unless the path states them.
const FPS: u16 = 30;

/// The images to render, and the frames per second of their video.
pub(super) fn shots(
    args: &RenderArgs,
    config: &TrainConfig,
    dataset: &Dataset,
) -> Result<(Vec<Shot>, u16)> {
    let (mut shots, fps, size) = match &args.path {
        None => (of_views(args, dataset)?, None, None),
        Some(path) => of_path(args, path, config, dataset)?,
    };
    for Shot { camera, .. } in &mut shots {
        if let Some(size) = args.size.map(|size| size.0).or(size) {
            *camera = camera.framed(size);
        }
        if let Some(fov) = args.fov {
            if camera.model != CameraModel::Pinhole {
                let problem = "--fov is of pinhole cameras, and these are fisheyes; leave it out";
                return Err(Error::Usage(problem.to_owned()));
            }
            *camera = camera.with_fov(fov.to_radians());
        }
    }
    Ok((shots, args.fps.or(fps).unwrap_or(FPS)))
}

fn of_views(args: &RenderArgs, dataset: &Dataset) -> Result<Vec<Shot>> {
    let includes = |view: &&View| args.split.is_none_or(|split| split.includes(view));
    let shot = |view: &View| {
        let View { name, camera, orientation, .. } = view;
        Shot { name: name.clone(), camera: *camera, orientation: *orientation }
    };
    let shots: Vec<Shot> = dataset.views.iter().filter(includes).map(shot).collect();
    if shots.is_empty() {
        return Err(Error::input(&dataset.root, "has no view of that split; try --split all"));
    }
    Ok(shots)
}

/// The frames, their number per second, and their size, if the path says them.
type Frames = (Vec<Shot>, Option<u16>, Option<[u32; 2]>);

fn of_path(
    args: &RenderArgs,
    path: &PathChoice,
    config: &TrainConfig,
    dataset: &Dataset,
) -> Result<Frames> {
    let poses: Vec<Camera> = dataset.train_views().map(View::upright_camera).collect();
    let up = config.up.and_then(|up| DVec3::from_array(up).try_normalize());
    let up = up.unwrap_or_else(|| dataset.up());
    let count = args.frames.map(|frames| frames as usize);
    let (cameras, fps, size) = match path {
        PathChoice::File(file) => {
            let options = PathOptions {
                frames: count,
                fps: args.fps.map(f64::from),
                easing: args.easing.map(Into::into),
                is_loop: args.is_loop,
            };
            let frame_path = FramePath::load(file, up, &options)?;
            let first = poses.first().ok_or_else(|| {
                Error::input(&dataset.root, "has no training view, whose size a path takes")
            })?;
            let size = frame_path.size.or(Some([first.width, first.height]));
            let cameras: Vec<Camera> =
                frame_path.frames.iter().map(|frame| frame.camera(first, size)).collect();
            (
                cameras,
                frame_path.fps.map(|fps| fps.round().clamp(1.0, 1000.0) as u16),
                frame_path.size,
            )
        }
        named => {
            if args.easing.is_some() || args.is_loop {
                let problem = "--easing and --loop are of keyframes; give a file with --path";
                return Err(Error::Usage(problem.to_owned()));
            }
            let path = match named {
                PathChoice::Named(path) => *path,
                _ => suited(&poses, up),
            };
            (path.cameras_about(&poses, up, count.unwrap_or(FRAMES))?, None, None)
        }
    };
    // A mirrored photograph shows a mirrored world.
    let first = dataset.train_views().next().map(|view| view.orientation.mirror());
    let orientation = first.unwrap_or_default();
    // Numbered as ffmpeg expects.
    let shot = |(index, camera)| Shot { name: format!("{index:05}"), camera, orientation };
    Ok(((0..).zip(cameras).map(shot).collect(), fps, size))
}

/// The path that `auto` chooses, which is logged.
fn suited(poses: &[Camera], up: DVec3) -> CameraPath {
    let path = CameraPath::suited_about(poses, up);
    let reason = match path {
        CameraPath::Orbit => "an orbit: the cameras surround the scene",
        CameraPath::Arc => "an arc: the cameras cover a part of the circle",
        CameraPath::Spiral => "a spiral: the cameras look in parallel",
        CameraPath::Interpolate => "through all cameras: they look outwards",
    };
    tracing::info!("the path is {reason}");
    path
}
