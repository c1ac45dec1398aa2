//! The COLMAP text model of a synthetic dataset: its cameras, and points with the views that see them.

use std::fmt::Write as _;

use glam::{DVec2, DVec3};
use nightsplat_core::camera::{Camera, CameraModel};
use nightsplat_core::random::Stream;
use rayon::prelude::*;

use super::{POINT_STREAM, Scene, file_name, ray};

/// A sparse point: its position and the views that see it, with the pixel positions.
struct SparsePoint {
    position: DVec3,
    track: Vec<(usize, DVec2)>,
}

/// Of this many drawn points on surfaces that are in view, those that at least two views see.
fn sparse_points(scene: &dyn Scene, cameras: &[Camera], draws: u64, seed: u64) -> Vec<SparsePoint> {
    const DRAWS_PER_POINT: u64 = 16;
    const PRECISION: f64 = 0.002; // standard deviation of a position, world units
    let stream = Stream::new(seed, POINT_STREAM << 32);
    let sample = |index: u64| {
        let uniform = |draw: u64| stream.uniform(index * DRAWS_PER_POINT + draw);
        let camera = &cameras[(uniform(0) * cameras.len() as f64) as usize];
        let pixel =
            DVec2::new(uniform(1) * f64::from(camera.width), uniform(2) * f64::from(camera.height));
        let position = scene.first_point(camera.center(), ray(camera, pixel)?)?;
        let seen =
            |(view, camera): (usize, &Camera)| Some((view, seen_at(scene, camera, position)?));
        let track: Vec<_> = cameras.iter().enumerate().filter_map(seen).collect();
        // Each normal sample takes two counters.
        let error = DVec3::from_array(
            [2, 3, 4].map(|draw| stream.normal(index * DRAWS_PER_POINT / 2 + draw)),
        );
        (track.len() >= 2).then(|| SparsePoint { position: position + PRECISION * error, track })
    };
    (0..draws).into_par_iter().filter_map(sample).collect()
}

/// The pixel position at which a camera sees a position on a surface, unless it is occluded.
fn seen_at(scene: &dyn Scene, camera: &Camera, position: DVec3) -> Option<DVec2> {
    const TOLERANCE: f64 = 1e-3;
    let pixel = camera.project(position)?;
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all();
    let first = scene.first_point(camera.center(), ray(camera, pixel)?)?;
    (inside && first.distance(position) < TOLERANCE).then_some(pixel)
}

/// The files of a COLMAP text model, by name and content.
pub(super) fn model(
    scene: &dyn Scene,
    cameras: &[Camera],
    draws: u64,
    seed: u64,
) -> [(&'static str, String); 3] {
    const GREY: &str = "128 128 128";
    let points = sparse_points(scene, cameras, draws, seed);
    let Camera { width, height, focal, principal_point, model, .. } = cameras[0];
    let (name, distortion) = match model {
        CameraModel::Fisheye(lens) => {
            ("OPENCV_FISHEYE", lens.coefficients.map(|k| format!(" {k}")).concat())
        }
        _ => ("PINHOLE", String::new()),
    };
    let camera_list = format!(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {name} {width} {height} {} {} {} {}{distortion}\n",
        focal.x, focal.y, principal_point.x, principal_point.y
    );

    let mut observations = vec![String::new(); cameras.len()];
    let mut observation_counts = vec![0; cameras.len()];
    let mut point_list =
        String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    // Writing to a string cannot fail, so the results below are ignored.
    for (index, SparsePoint { position, track }) in points.iter().enumerate() {
        let id = index + 1;
        let _ = write!(point_list, "{id} {} {} {} {GREY} 0.5", position.x, position.y, position.z);
        for &(view, pixel) in track {
            let _ = write!(point_list, " {} {}", view + 1, observation_counts[view]);
            let _ = write!(observations[view], "{:.3} {:.3} {id} ", pixel.x, pixel.y);
            observation_counts[view] += 1;
        }
        point_list.push('\n');
    }

    let mut image_list = String::from(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    for (view, camera) in cameras.iter().enumerate() {
        let (_, rotation, translation) = camera.view_from_world.to_scale_rotation_translation();
        let pose = [
            rotation.w,
            rotation.x,
            rotation.y,
            rotation.z,
            translation.x,
            translation.y,
            translation.z,
        ];
        let pose = pose.map(|number| number.to_string()).join(" ");
        let _ = writeln!(
            image_list,
            "{} {pose} 1 {}\n{}",
            view + 1,
            file_name(view, cameras.len()),
            observations[view].trim_end()
        );
    }
    [("cameras.txt", camera_list), ("images.txt", image_list), ("points3D.txt", point_list)]
}
