//! A small dark multi-view dataset of an analytic scene, with the true normal-light photograph of every view.
//!
//! The scene is ray-traced in linear light. The reference is the encoded render, 2x2 supersampled. The dark photograph
//! is the same light divided by [`DARKENING`], with the shot and read noise of a small sensor, encoded and quantised to
//! 8 bits: as a camera stores it if the exposure is far too short.

use std::f64::consts::PI;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use rayon::prelude::*;
use serde_json::{Value, json};

use self::room::{FOCUS, Room};
use crate::base::random::Stream;
use crate::camera::{Camera, CameraModel, KannalaBrandt};
use crate::photographs::image::{Image, srgb_from_linear};
use crate::{Error, Result};

mod room;

/// How much darker the dark photographs are, in linear light.
pub const DARKENING: f64 = 25.0;

/// Electrons of a pixel at the reference's white.
const FULL_WELL: f64 = 9000.0;

/// Standard deviation of the read noise, electrons.
const READ_NOISE: f64 = 2.0;

/// The exposure and noise of the dark photographs of a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// How much darker they are than the references, in linear light.
    pub darkening: f64,
    /// Electrons of a pixel at the reference's white: shot noise has the variance of signal / this.
    pub full_well: f64,
    /// Standard deviation of the read noise, electrons.
    pub read_noise: f64,
    /// Extra stops of the views, cyclically, from the first on.
    pub stops: Vec<f64>,
}

/// A small sensor, far too short an exposure.
impl Default for Capture {
    fn default() -> Self {
        Self {
            darkening: DARKENING,
            full_well: FULL_WELL,
            read_noise: READ_NOISE,
            stops: vec![0.0],
        }
    }
}

impl Capture {
    /// Well lit, and without noise.
    #[cfg(feature = "testing")]
    pub fn clean() -> Self {
        Self { darkening: 1.0, full_well: f64::INFINITY, read_noise: 0.0, ..Self::default() }
    }
}

/// Every this many views, from the first, one is a test view.
const TEST_EVERY: usize = 8;

/// The streams of random numbers of the seed; the room's textures use stream 0.
const NOISE_STREAM: u64 = 1;
const POINT_STREAM: u64 = 2;

/// Options of [`write()`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SyntheticOptions {
    /// Photographs, at least 2; every 8th is a test view.
    pub views: usize,
    /// Pixels per row, at least 16.
    pub width: u32,
    /// Rows, at least 16.
    pub height: u32,
    /// Changes the textures, the noise and the sampled points.
    pub seed: u64,
    /// Use a fisheye that sees 130 degrees across the image's longer side; black outside its circle.
    pub fisheye: bool,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        Self { views: 24, width: 160, height: 120, seed: 0, fisheye: false }
    }
}

/// The fisheye of such a dataset.
const FISHEYE: KannalaBrandt = KannalaBrandt { coefficients: [0.03, -0.008, 0.002, -0.0004] };

/// The angle off its axis at the middle of the image's shorter sides, radians.
const FISHEYE_REACH: f64 = 65.0 * PI / 180.0;

impl SyntheticOptions {
    fn check(&self) -> Result<()> {
        const SIDES: std::ops::RangeInclusive<u32> = 16..=8192;
        if !(2..=999).contains(&self.views) {
            return Err(Error::Usage(format!(
                "{} views cannot be made; ask for 2 to 999",
                self.views
            )));
        }
        if !SIDES.contains(&self.width) || !SIDES.contains(&self.height) {
            let (width, height) = (self.width, self.height);
            return Err(Error::Usage(format!(
                "views of {width}x{height} cannot be made; ask for sides of 16 to 8192"
            )));
        }
        Ok(())
    }
}

/// Writes the dataset to `dir` in the layout of the LOM benchmark: `low/` and `high/` (PNG), `transforms_train.json`,
/// `transforms_test.json`, `transforms_val.json`, and a COLMAP text model in `colmap_sparse/0`.
///
/// The model's points are on surfaces that at least two views see, to the precision of a good reconstruction; their
/// colours are all grey, because the colours of a real one come from photographs that training must not see. Equal
/// options give equal bytes. Files of an earlier set are replaced.
///
/// # Errors
/// [`Error::Usage`] for invalid options, [`Error::Output`] if a file cannot be written.
pub fn write(dir: impl AsRef<Path>, options: &SyntheticOptions) -> Result<()> {
    write_captured(dir, options, &Capture::default())
}

/// As [`write()`], with another exposure and noise of the dark photographs.
///
/// # Errors
/// As [`write()`].
pub fn write_captured(
    dir: impl AsRef<Path>,
    options: &SyntheticOptions,
    capture: &Capture,
) -> Result<()> {
    options.check()?;
    let dir = dir.as_ref();
    let (low, high, sparse) = (dir.join("low"), dir.join("high"), dir.join("colmap_sparse/0"));
    for folder in [&low, &high, &sparse] {
        fs::create_dir_all(folder)
            .map_err(|error| Error::output(folder, format!("cannot be made: {error}")))?;
    }
    // The lists of frames make the dataset look complete, so those of an earlier dataset are removed first, and new
    // ones are written last.
    for split in ["train", "test", "val"] {
        let list = dir.join(format!("transforms_{split}.json"));
        if list.exists() {
            fs::remove_file(&list)
                .map_err(|error| Error::output(&list, format!("cannot be replaced: {error}")))?;
        }
    }

    let room = Room::new(options.seed);
    let cameras: Vec<Camera> = (0..options.views).map(|view| camera(view, options)).collect();
    for (view, camera) in cameras.iter().enumerate() {
        let radiance = render(&room, camera);
        reference(&radiance, camera).save_png8(high.join(file_name(view)))?;
        let noise = Stream::new(options.seed, NOISE_STREAM << 32 | view as u64);
        let stops = capture.stops.get(view % capture.stops.len().max(1)).copied();
        let darkening = capture.darkening / stops.unwrap_or(0.0).exp2();
        dark_photograph(&radiance, camera, capture, darkening, noise)
            .save_png8(low.join(file_name(view)))?;
    }
    for (name, text) in colmap_model(&room, &cameras, options.seed) {
        write_file(&sparse.join(name), &text)?;
    }
    let (test, train): (Vec<usize>, Vec<usize>) =
        (0..options.views).partition(|view| view % TEST_EVERY == 0);
    for (split, folder, views) in
        [("train", "low", &train[..]), ("test", "high", &test), ("val", "high", &test[..1])]
    {
        let list = transforms(&cameras, folder, views);
        write_file(&dir.join(format!("transforms_{split}.json")), &format!("{list:#}\n"))?;
    }
    Ok(())
}

fn write_file(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text)
        .map_err(|error| Error::output(path, format!("cannot be written: {error}")))
}

/// The photograph's name, the same in `low/`, `high/` and the COLMAP model.
fn file_name(view: usize) -> String {
    format!("{view:03}.png")
}

/// Cameras on a part of a sphere in front of the scene, spread evenly by a low-discrepancy sequence (Roberts' R2), so
/// that every 8th is among the others.
fn camera(view: usize, options: &SyntheticOptions) -> Camera {
    const AZIMUTH: f64 = 0.75; // radians to either side
    const ELEVATION: (f64, f64) = (0.24, 0.62); // radians
    const DISTANCE: (f64, f64) = (2.95, 3.45);
    let fraction = |step: f64| (0.5 + step * view as f64).fract();
    let azimuth = AZIMUTH * (2.0 * fraction(0.754_877_666) - 1.0);
    let elevation = ELEVATION.0 + (ELEVATION.1 - ELEVATION.0) * fraction(0.569_840_291);
    let distance = DISTANCE.0 + (DISTANCE.1 - DISTANCE.0) * fraction(0.381_966_011);
    let (sin, cos) = azimuth.sin_cos();
    let back = DVec3::new(sin * elevation.cos(), -cos * elevation.cos(), elevation.sin());

    let right = DVec3::Z.cross(back).normalize();
    let world_from_view = DMat3::from_cols(right, -back.cross(right), -back);
    let size = DVec2::new(options.width.into(), options.height.into());
    let (model, focal) = if options.fisheye {
        (CameraModel::Fisheye(FISHEYE), 0.5 / FISHEYE.radius(FISHEYE_REACH))
    } else {
        (CameraModel::Pinhole, 0.92)
    };
    let focal = focal * size.max_element();
    Camera {
        width: options.width,
        height: options.height,
        focal: DVec2::new(focal, 1.01 * focal),
        principal_point: size * DVec2::new(0.525, 0.485),
        model,
        view_from_world: DAffine3::from_mat3_translation(world_from_view, FOCUS + distance * back)
            .inverse(),
    }
}

/// The unit direction, in the world, of the ray through a pixel position; `None` outside a fisheye's circle.
fn ray(camera: &Camera, pixel: DVec2) -> Option<DVec3> {
    let in_view = camera.in_view(pixel, 1.0)?;
    Some((camera.view_from_world.matrix3.transpose() * in_view).normalize())
}

/// Linear radiance in row-major order, the mean of 2x2 rays per pixel.
fn render(room: &Room, camera: &Camera) -> Vec<DVec3> {
    const OFFSETS: [DVec2; 4] = [
        DVec2::new(0.25, 0.25),
        DVec2::new(0.75, 0.25),
        DVec2::new(0.25, 0.75),
        DVec2::new(0.75, 0.75),
    ];
    let center = camera.center();
    let radiance = |index: u32| {
        let corner = DVec2::new((index % camera.width).into(), (index / camera.width).into());
        OFFSETS
            .iter()
            .filter_map(|&offset| Some(room.radiance(center, ray(camera, corner + offset)?)))
            .sum::<DVec3>()
            / 4.0
    };
    (0..camera.width * camera.height).into_par_iter().map(radiance).collect()
}

/// The normal-light photograph.
fn reference(radiance: &[DVec3], camera: &Camera) -> Image {
    photograph(camera, |pixel, channel| radiance[pixel][channel])
}

/// The underexposed photograph.
fn dark_photograph(
    radiance: &[DVec3],
    camera: &Camera,
    &Capture { full_well, read_noise, .. }: &Capture,
    darkening: f64,
    noise: Stream,
) -> Image {
    if full_well.is_infinite() {
        return photograph(camera, |pixel, channel| radiance[pixel][channel] / darkening);
    }
    photograph(camera, |pixel, channel| {
        let electrons = full_well * radiance[pixel][channel] / darkening;
        // Shot noise is Poisson; at tens of electrons, the normal distribution of equal variance is close.
        let deviation = (electrons + read_noise * read_noise).sqrt();
        (electrons + deviation * noise.normal(3 * pixel as u64 + channel as u64)) / full_well
    })
}

/// An image of linear values at (pixel, channel), encoded, clamped to [0, 1].
fn photograph(camera: &Camera, linear: impl Fn(usize, usize) -> f64) -> Image {
    let encoded = |pixel: usize, channel: usize| {
        srgb_from_linear(linear(pixel, channel) as f32).clamp(0.0, 1.0)
    };
    Image::from_fn(camera.width, camera.height, |x, y| {
        [0, 1, 2].map(|channel| encoded((y * camera.width + x) as usize, channel))
    })
}

/// The list of a split's frames, in the format of instant-ngp: poses are world-from-camera in OpenGL axes.
fn transforms(cameras: &[Camera], folder: &str, views: &[usize]) -> Value {
    let Camera { width, height, focal, principal_point, model, .. } = cameras[0];
    let frame = |&view: &usize| {
        let pose = cameras[view].view_from_world.inverse();
        let [right, down, forward] =
            [pose.matrix3.x_axis, pose.matrix3.y_axis, pose.matrix3.z_axis];
        let mut rows = [0, 1, 2]
            .map(|row| [right[row], -down[row], -forward[row], pose.translation[row]])
            .to_vec();
        rows.push([0.0, 0.0, 0.0, 1.0]);
        json!({ "file_path": format!("{folder}/{}", file_name(view)), "transform_matrix": rows })
    };
    let mut list = json!({
        "camera_angle_x": 2.0 * (f64::from(width) / (2.0 * focal.x)).atan(),
        "camera_angle_y": 2.0 * (f64::from(height) / (2.0 * focal.y)).atan(),
        "fl_x": focal.x, "fl_y": focal.y,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "cx": principal_point.x, "cy": principal_point.y,
        "w": f64::from(width), "h": f64::from(height),
        "frames": views.iter().map(frame).collect::<Vec<_>>(),
    });
    if let CameraModel::Fisheye(KannalaBrandt { coefficients: [k1, k2, k3, k4] }) = model {
        list["camera_model"] = "OPENCV_FISHEYE".into();
        for (key, value) in [("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4)] {
            list[key] = value.into();
        }
        // Keys of a pinhole.
        for key in ["camera_angle_x", "camera_angle_y", "p1", "p2"] {
            list.as_object_mut().map(|list| list.remove(key));
        }
    }
    list
}

/// A sparse point: its position and the views that see it, with the pixel positions.
struct SparsePoint {
    position: DVec3,
    track: Vec<(usize, DVec2)>,
}

/// Points on surfaces that at least two views see.
fn sparse_points(room: &Room, cameras: &[Camera], seed: u64) -> Vec<SparsePoint> {
    const DRAWS: u64 = 2400;
    const DRAWS_PER_POINT: u64 = 16;
    const PRECISION: f64 = 0.002; // standard deviation of a position, world units
    let stream = Stream::new(seed, POINT_STREAM << 32);
    let sample = |index: u64| {
        let uniform = |draw: u64| stream.uniform(index * DRAWS_PER_POINT + draw);
        let camera = &cameras[(uniform(0) * cameras.len() as f64) as usize];
        let pixel =
            DVec2::new(uniform(1) * f64::from(camera.width), uniform(2) * f64::from(camera.height));
        let position = room.first_point(camera.center(), ray(camera, pixel)?)?;
        let seen =
            |(view, camera): (usize, &Camera)| Some((view, seen_at(room, camera, position)?));
        let track: Vec<_> = cameras.iter().enumerate().filter_map(seen).collect();
        // Each normal sample takes two counters.
        let error = DVec3::from_array(
            [2, 3, 4].map(|draw| stream.normal(index * DRAWS_PER_POINT / 2 + draw)),
        );
        (track.len() >= 2).then(|| SparsePoint { position: position + PRECISION * error, track })
    };
    (0..DRAWS).into_par_iter().filter_map(sample).collect()
}

/// The pixel position at which a camera sees a position on a surface, unless it is occluded.
fn seen_at(room: &Room, camera: &Camera, position: DVec3) -> Option<DVec2> {
    const TOLERANCE: f64 = 1e-3;
    let pixel = camera.project(position)?;
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all();
    let first = room.first_point(camera.center(), ray(camera, pixel)?)?;
    (inside && first.distance(position) < TOLERANCE).then_some(pixel)
}

/// The files of a COLMAP text model, by name and content.
fn colmap_model(room: &Room, cameras: &[Camera], seed: u64) -> [(&'static str, String); 3] {
    const GREY: &str = "128 128 128";
    let points = sparse_points(room, cameras, seed);
    let Camera { width, height, focal, principal_point, model, .. } = cameras[0];
    let (name, distortion) = match model {
        CameraModel::Pinhole => ("PINHOLE", String::new()),
        CameraModel::Fisheye(lens) => {
            ("OPENCV_FISHEYE", lens.coefficients.map(|k| format!(" {k}")).concat())
        }
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
            file_name(view),
            observations[view].trim_end()
        );
    }
    [("cameras.txt", camera_list), ("images.txt", image_list), ("points3D.txt", point_list)]
}
