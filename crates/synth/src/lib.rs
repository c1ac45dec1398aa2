//! A small dark multi-view dataset of an analytic scene, with the true normal-light photograph of every view.
//!
//! The scene is ray-traced in linear light: a corner of a room, or a street. The reference is the encoded render, 2x2
//! supersampled. The dark photograph is the same light divided by [`DARKENING`], with the shot and read noise of a
//! small sensor, encoded and quantised to 8 bits: as a camera stores it if the exposure is far too short. In a street
//! this light also falls eightfold from one end to the other; that of the references does not. With a lamp that is
//! fixed to the camera, the photographs have its light instead.
//!
//! [`Night`] adds what a scene has at night, and [`CameraFaults`] what a camera does wrong there. All light is linear
//! until it has passed lens, shutter and noise.

use std::f64::consts::PI;
use std::fs;
use std::ops::RangeInclusive;
use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use nightsplat_core::camera::{Camera, CameraModel, KannalaBrandt};
use nightsplat_core::output::create_folder;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::{Image, ImageFile, srgb_from_linear};
use rayon::prelude::*;
use serde_json::{Value, json};

pub use self::capture::{CameraFaults, Capture};
pub use self::night::Night;
use self::night::ViewLights;
use self::room::Room;
use self::street::Street;

mod capture;
mod colmap;
mod lamp;
mod night;
mod room;
mod shapes;
mod street;
pub mod varied;

/// What is photographed.
trait Scene: Sync {
    /// The linear radiance along a ray, in the light of the references, and in that of the photographs before they are
    /// darkened, which is that of a camera's lamp if it carries one.
    fn radiance(&self, origin: DVec3, direction: DVec3, lights: &ViewLights) -> [DVec3; 2];

    /// The first point along a ray.
    fn first_point(&self, origin: DVec3, direction: DVec3) -> Option<DVec3>;

    /// The unit normal of the first surface along a ray.
    fn first_normal(&self, origin: DVec3, direction: DVec3) -> Option<DVec3>;

    /// The position of camera `view` of `views`, and the unit vector from what it looks at towards it.
    fn camera_position(&self, view: usize, views: usize) -> [DVec3; 2];

    /// The radius of a street lamp, and the positions of all.
    fn lamp_size(&self) -> f64;
    fn street_lamps(&self) -> Vec<DVec3>;

    /// The positions of the headlights that a camera at a position sees, by a draw in [0, 1).
    fn headlights(&self, center: DVec3, along: f64) -> [DVec3; 2];
}

/// How much darker the dark photographs are, in linear light.
pub const DARKENING: f64 = 25.0;

/// Every this many views, from the first, one is a test view.
const TEST_EVERY: usize = 8;

/// The stream of random numbers of the seed for points; the scene uses stream 0, [`capture`] and [`night`] others.
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
    /// A street of this many plots, of one world unit each, instead of the room. Cameras fly along it, and each sees a
    /// stretch of about three.
    pub street: Option<u32>,
    /// The photographs are lit by a lamp that is fixed to the camera, with half its strength this many degrees off its
    /// axis, 5 to 80. The cameras of a room then come close and look around.
    pub lamp: Option<f64>,
    /// What the scene has at night; not with `lamp`.
    pub night: Night,
    /// Write the normal map of every training view, in 16 bits, with x right, y down and z forward, to `normals/`.
    pub normals: bool,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        Self {
            views: 24,
            width: 160,
            height: 120,
            seed: 0,
            fisheye: false,
            street: None,
            lamp: None,
            night: Night::NONE,
            normals: false,
        }
    }
}

impl SyntheticOptions {
    /// A street of this many plots: six photographs of 128x96 a plot.
    pub fn street(plots: u32) -> Self {
        let views = 6 * plots as usize;
        Self { views, width: 128, height: 96, street: Some(plots), ..Self::default() }
    }
}

/// The fisheye of such a dataset.
const FISHEYE: KannalaBrandt = KannalaBrandt { coefficients: [0.03, -0.008, 0.002, -0.0004] };

/// The angle off its axis at the middle of the image's shorter sides, radians.
const FISHEYE_REACH: f64 = 65.0 * PI / 180.0;

impl SyntheticOptions {
    fn check(&self) -> Result<()> {
        const SIDES: RangeInclusive<u32> = 16..=8192;
        const PLOTS: RangeInclusive<u32> = 1..=10_000;
        const VIEWS: RangeInclusive<usize> = 2..=99_999;
        const LAMPS: RangeInclusive<f64> = 5.0..=80.0;
        let refused = |what: String, remedy: String| Err(Error::Usage(format!("{what}; {remedy}")));
        let Self { views, width, height, street, lamp, fisheye, night, .. } = *self;
        if !VIEWS.contains(&views) {
            let remedy = format!("ask for 2 to {}", VIEWS.end());
            return refused(format!("{views} views cannot be made"), remedy);
        }
        if !SIDES.contains(&width) || !SIDES.contains(&height) {
            let remedy = "ask for sides of 16 to 8192".to_owned();
            return refused(format!("views of {width}x{height} cannot be made"), remedy);
        }
        if let Some(plots) = street.filter(|plots| !PLOTS.contains(plots)) {
            let remedy = format!("ask for 1 to {}", PLOTS.end());
            return refused(format!("a street of {plots} plots cannot be made"), remedy);
        }
        if street.is_some() && fisheye {
            let what = "a street is not made with a fisheye".to_owned();
            return refused(what, "ask for one of both".to_owned());
        }
        if let Some(degrees) = lamp.filter(|degrees| !LAMPS.contains(degrees)) {
            let what = format!("a lamp of half its strength at {degrees} degrees cannot be made");
            return refused(what, format!("ask for {} to {}", LAMPS.start(), LAMPS.end()));
        }
        if lamp.is_some() && night != Night::NONE {
            let what = "a night in the light of the camera's lamp is not made".to_owned();
            return refused(what, "leave out --lamp, or the sky, lamps and haze".to_owned());
        }
        Ok(())
    }
}

/// Writes the dataset to `dir` in the layout of the LOM benchmark: `low/` and `high/` (PNG), `transforms_train.json`,
/// `transforms_test.json`, `transforms_val.json`, and a COLMAP text model in `colmap_sparse/0`. With a lamp, `lit/` has
/// the test views in its light, without noise and not darkened: what a render with the lamp should look like.
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

/// As [`write()`], with another exposure, noise and faults of the dark photographs.
///
/// # Errors
/// As [`write()`].
pub fn write_captured(
    dir: impl AsRef<Path>,
    options: &SyntheticOptions,
    capture: &Capture,
) -> Result<()> {
    options.check()?;
    capture.check()?;
    let dir = dir.as_ref();
    let (low, high, sparse) = (dir.join("low"), dir.join("high"), dir.join("colmap_sparse/0"));
    let lit = options.lamp.map(|_| dir.join("lit"));
    let normals = options.normals.then(|| dir.join("normals"));
    for folder in [&low, &high, &sparse].into_iter().chain(&lit).chain(&normals) {
        create_folder(folder)?;
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

    let (walked, sky, seed) = (options.lamp.is_some(), options.night.sky, options.seed);
    let (scene, draws): (Box<dyn Scene>, u64) = match options.street {
        None => (Box::new(Room::new(seed, walked, sky)), 2400),
        Some(plots) => (Box::new(Street::new(plots, seed, sky)), 400 * u64::from(plots)),
    };
    let camera = |view| camera(scene.camera_position(view, options.views), options);
    let cameras: Vec<Camera> = (0..options.views).map(camera).collect();
    for (view, camera) in cameras.iter().enumerate() {
        let name = file_name(view, cameras.len());
        let lights = ViewLights::new(options, &*scene, camera, view);
        let [even, dim] =
            render(&*scene, camera, &lights).map(|light| capture.faults.channels(light));
        bright_photograph(&even, camera).save_png8(high.join(&name))?;
        if let Some(lit) = lit.as_ref().filter(|_| is_test(view)) {
            bright_photograph(&dim, camera).save_png8(lit.join(&name))?;
        }
        capture.photograph(&dim, camera, view, seed).save_png8(low.join(&name))?;
        if let Some(normals) = normals.as_ref().filter(|_| !is_test(view)) {
            normal_map(&*scene, camera).save_png16(normals.join(&name))?;
        }
    }
    for (name, text) in colmap::model(&*scene, &cameras, draws, options.seed) {
        write_file(&sparse.join(name), &text)?;
    }
    let (test, train): (Vec<usize>, Vec<usize>) =
        (0..options.views).partition(|&view| is_test(view));
    for (split, folder, views) in
        [("train", "low", &train[..]), ("test", "high", &test), ("val", "high", &test[..1])]
    {
        let list = transforms(&cameras, folder, views);
        write_file(&dir.join(format!("transforms_{split}.json")), &format!("{list:#}\n"))?;
    }
    Ok(())
}

fn is_test(view: usize) -> bool {
    view.is_multiple_of(TEST_EVERY)
}

fn write_file(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text)
        .map_err(|error| Error::output(path, format!("cannot be written: {error}")))
}

/// The photograph's name, the same in `low/`, `high/` and the COLMAP model.
fn file_name(view: usize, views: usize) -> String {
    let digits = (views - 1).to_string().len().max(3);
    format!("{view:0digits$}.png")
}

/// The camera at a position, with the direction from what it looks at.
fn camera([center, back]: [DVec3; 2], options: &SyntheticOptions) -> Camera {
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
        view_from_world: DAffine3::from_mat3_translation(world_from_view, center).inverse(),
    }
}

/// The unit direction, in the world, of the ray through a pixel position; `None` outside a fisheye's circle.
fn ray(camera: &Camera, pixel: DVec2) -> Option<DVec3> {
    let in_view = camera.in_view(pixel, 1.0)?;
    Some((camera.view_from_world.matrix3.transpose() * in_view).normalize())
}

/// Linear radiance in row-major order, the mean of 2x2 rays per pixel, in both lights.
fn render(scene: &dyn Scene, camera: &Camera, lights: &ViewLights) -> [Vec<DVec3>; 2] {
    const OFFSETS: [DVec2; 4] = [
        DVec2::new(0.25, 0.25),
        DVec2::new(0.75, 0.25),
        DVec2::new(0.25, 0.75),
        DVec2::new(0.75, 0.75),
    ];
    let center = camera.center();
    let radiance = |index: u32| {
        let corner = DVec2::new((index % camera.width).into(), (index / camera.width).into());
        let rays = OFFSETS.iter().filter_map(|&offset| ray(camera, corner + offset));
        let sums = rays
            .map(|ray| lights.seen(scene, center, ray, scene.radiance(center, ray, lights)))
            .fold([DVec3::ZERO; 2], |sums, pair| [sums[0] + pair[0], sums[1] + pair[1]]);
        (sums[0] / 4.0, sums[1] / 4.0)
    };
    let (even, dim) = (0..camera.width * camera.height).into_par_iter().map(radiance).unzip();
    [even, dim]
}

/// (n + 1) / 2 of the normals in the view, at the centres of pixels; grey where there is no surface.
fn normal_map(scene: &dyn Scene, camera: &Camera) -> Image {
    let view_from_world = camera.view_from_world.matrix3;
    Image::from_fn(camera.width, camera.height, |x, y| {
        let ray = ray(camera, DVec2::new(x.into(), y.into()) + 0.5);
        let normal = ray.and_then(|ray| scene.first_normal(camera.center(), ray));
        let in_view = view_from_world * normal.unwrap_or_default();
        (0.5 * in_view + 0.5).as_vec3().to_array()
    })
}

/// The normal-light photograph.
fn bright_photograph(radiance: &[DVec3], camera: &Camera) -> Image {
    photograph(camera, |pixel, channel| radiance[pixel][channel])
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
        json!({ "file_path": format!("{folder}/{}", file_name(view, cameras.len())), "transform_matrix": rows })
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
