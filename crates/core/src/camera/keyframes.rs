//! Camera paths in files: keyframes in our own format, and nerfstudio's camera paths.
//!
//! Positions are in the dataset's world. Ours, with every member but `nightsplat_path` and `keyframes` optional:
//!
//! ```json
//! {"nightsplat_path": 1, "fps": 30, "loop": false, "easing": "smooth", "size": [1280, 720], "fov": 50,
//!  "keyframes": [{"time": 0, "position": [0, -1, -4], "target": [0, 0, 0]},
//!                {"time": 2, "position": [4, -1, 0], "rotation": [0.7, 0, -0.7, 0], "fov": 35}]}
//! ```
//!
//! A keyframe looks at its `target`, or its `rotation` (w, x, y, z) maps the axes of the camera (x right, y down, z
//! forward) to the world. Times are seconds, fields of view vertical, in degrees. Between keyframes, positions follow
//! cubic Hermite curves with the tangents of Catmull and Rom for uneven times.

use std::path::Path;

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, DVec4};
use serde::Deserialize;
use serde_json::Value;

use super::Camera;
use super::path::looking;
use crate::input;
use crate::{Error, Result};

/// The version of paths that this build reads.
const VERSION: u32 = 1;

/// A frame of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathFrame {
    /// World to view.
    pub view_from_world: DAffine3,
    /// The vertical field of view, radians.
    pub fov: Option<f64>,
}

impl PathFrame {
    /// The camera of the frame: a pinhole with its field of view, or the lens of `like`, of that or another size.
    pub fn camera(&self, like: &Camera, size: Option<[u32; 2]>) -> Camera {
        let resized = size.map_or(*like, |size| like.framed(size));
        let Self { view_from_world, fov } = *self;
        match fov {
            Some(fov) => Camera::perspective(view_from_world, fov, [resized.width, resized.height]),
            None => Camera { view_from_world, ..resized },
        }
    }
}

/// The frames of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct FramePath {
    /// In their order in time.
    pub frames: Vec<PathFrame>,
    /// Frames per second, if the file says.
    pub fps: Option<f64>,
    /// Width and height in pixels.
    pub size: Option<[u32; 2]>,
}

/// How time runs along a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Easing {
    /// At the speed of the keyframes.
    #[default]
    Linear,
    /// Slow at the first and at the last keyframe.
    Smooth,
}

impl Easing {
    /// The time, 0 to 1, of a frame at 0 to 1.
    fn at(self, time: f64) -> f64 {
        match self {
            Self::Linear => time,
            Self::Smooth => time * time * (3.0 - 2.0 * time),
        }
    }
}

/// The file in our format.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Keyframes {
    #[serde(rename = "nightsplat_path")]
    _version: u32,
    fps: Option<f64>,
    #[serde(default, rename = "loop")]
    is_loop: bool,
    #[serde(default)]
    easing: Easing,
    size: Option<[u32; 2]>,
    fov: Option<f64>,
    keyframes: Vec<Keyframe>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Keyframe {
    time: Option<f64>,
    position: DVec3,
    target: Option<DVec3>,
    rotation: Option<[f64; 4]>,
    fov: Option<f64>,
}

/// nerfstudio's file, as its viewer exports it: a camera for every frame, in OpenGL's axes.
#[derive(Clone, Debug, Deserialize)]
struct Nerfstudio {
    camera_path: Vec<NerfstudioFrame>,
    fps: Option<f64>,
    render_height: Option<f64>,
    render_width: Option<f64>,
}

#[derive(Clone, Debug, Deserialize)]
struct NerfstudioFrame {
    /// Row-major, 4x4.
    camera_to_world: Vec<f64>,
    fov: Option<f64>,
}

/// Changes of a path on the command line.
#[derive(Clone, Copy, Debug, Default)]
pub struct PathOptions {
    /// The number of frames, instead of that of the times.
    pub frames: Option<usize>,
    /// Frames per second, instead of the file's.
    pub fps: Option<f64>,
    /// How a camera moves between keyframes.
    pub easing: Option<Easing>,
    /// The last keyframe is followed by the first.
    pub is_loop: bool,
}

impl FramePath {
    /// Reads a file; keyframes with a target are upright about `up`.
    pub fn load(path: &Path, up: DVec3, options: &PathOptions) -> Result<Self> {
        let refused = |problem: String| Error::input(path, problem);
        let json: Value = serde_json::from_str(&input::text(path)?)
            .map_err(|error| refused(format!("is not JSON: {error}")))?;
        if json.get("camera_path").is_some() {
            return Self::of_nerfstudio(json, options).map_err(refused);
        }
        match json.get("nightsplat_path") {
            None => {
                let problem = "is no camera path: it has neither `nightsplat_path` nor nerfstudio's `camera_path`";
                Err(refused(problem.to_owned()))
            }
            Some(version) if *version != VERSION => Err(refused(format!(
                "is a camera path of version {version}; this build reads version {VERSION}"
            ))),
            Some(_) => Self::of_keyframes(json, up, options).map_err(refused),
        }
    }

    fn of_nerfstudio(json: Value, options: &PathOptions) -> Result<Self, String> {
        let file: Nerfstudio = serde_json::from_value(json).map_err(|error| error.to_string())?;
        if options.easing.is_some() || options.is_loop {
            let problem = "has a camera for every frame, which --easing and --loop do not change";
            return Err(problem.to_owned());
        }
        let frame = |(number, frame): (usize, &NerfstudioFrame)| {
            let matrix = <[f64; 16]>::try_from(frame.camera_to_world.as_slice());
            let matrix = matrix.map(|rows| DMat4::from_cols_array(&rows).transpose());
            let matrix = matrix.ok().filter(DMat4::is_finite);
            let pose = matrix.filter(|matrix| matrix.determinant().abs() > 1e-12).map(opengl_pose);
            let pose = pose.ok_or_else(|| {
                format!("frame {number}: camera_to_world is no pose of 16 finite numbers")
            })?;
            Ok(PathFrame { view_from_world: pose, fov: field_of_view(frame.fov)? })
        };
        let all = file.camera_path.iter().enumerate().map(frame);
        let all: Vec<PathFrame> = all.collect::<Result<_, String>>()?;
        let frames = match options.frames {
            Some(count) if !all.is_empty() => {
                (0..count).map(|index| all[index * all.len() / count]).collect()
            }
            _ => all,
        };
        let size = file.render_width.zip(file.render_height);
        let size = size.map(|(width, height)| [width as u32, height as u32]);
        Self { frames, fps: options.fps.or(file.fps), size }.checked()
    }

    fn of_keyframes(json: Value, up: DVec3, options: &PathOptions) -> Result<Self, String> {
        let mut file: Keyframes =
            serde_json::from_value(json).map_err(|error| error.to_string())?;
        file.is_loop |= options.is_loop;
        let knots = knots(&file, up)?;
        let fps = options.fps.or(file.fps);
        if let Some(fps) = fps.filter(|fps| !(fps.is_finite() && *fps > 0.0)) {
            return Err(format!("fps is {fps}; it is above 0"));
        }
        let duration = knots.last().map_or(0.0, |last| last.time) - knots[0].time;
        let easing = options.easing.unwrap_or(file.easing);
        let by_time =
            || (duration * fps.unwrap_or(30.0)).round() as usize + usize::from(!file.is_loop);
        let count = options.frames.unwrap_or_else(by_time).max(1);
        // A loop ends one frame before its beginning.
        let steps = if file.is_loop { count } else { count.saturating_sub(1) }.max(1);
        let frame = |index: usize| {
            let along = easing.at(index as f64 / steps as f64);
            interpolated(&knots, file.is_loop, knots[0].time + along * duration)
        };
        let frames = (0..count).map(frame).collect();
        Self { frames, fps, size: file.size }.checked()
    }

    fn checked(self) -> Result<Self, String> {
        if self.frames.is_empty() {
            return Err("has no frame".to_owned());
        }
        match self.size {
            Some([width, height]) if width == 0 || height == 0 => {
                Err(format!("has frames of {width}x{height} pixels"))
            }
            _ => Ok(self),
        }
    }
}

/// From degrees to radians.
fn field_of_view(degrees: Option<f64>) -> Result<Option<f64>, String> {
    match degrees {
        Some(fov) if !(fov > 0.0 && fov < 180.0) => {
            Err(format!("a field of view of {fov} degrees is none; it is above 0 and below 180"))
        }
        fov => Ok(fov.map(f64::to_radians)),
    }
}

/// World to view from a camera with y up that looks along -z; scale is taken out.
fn opengl_pose(world_from_camera: DMat4) -> DAffine3 {
    let axis = |column: usize| world_from_camera.col(column).truncate().normalize_or_zero();
    let matrix = DMat3::from_cols(axis(0), -axis(1), -axis(2));
    let rotation = DQuat::from_mat3(&matrix).normalize();
    let center = world_from_camera.col(3).truncate();
    DAffine3::from_rotation_translation(rotation, center).inverse()
}

/// A keyframe with its time.
#[derive(Clone, Copy, Debug)]
struct Knot {
    time: f64,
    center: DVec3,
    /// Camera to world, in the hemisphere of the knot before.
    turn: DVec4,
    fov: Option<f64>,
}

/// The keyframes with the time, rotation and field of view of each, and the first one again at the end of a loop.
fn knots(file: &Keyframes, up: DVec3) -> Result<Vec<Knot>, String> {
    let mut knots: Vec<Knot> = vec![];
    for (number, keyframe) in file.keyframes.iter().enumerate() {
        let problem = |what: &str| format!("keyframe {number} {what}");
        let rotation = match (keyframe.rotation, keyframe.target) {
            (Some([w, x, y, z]), None) => Some(DQuat::from_xyzw(x, y, z, w)),
            (None, Some(target)) if target.distance(keyframe.position) > 0.0 => {
                let pose = looking(keyframe.position, target, up).inverse();
                Some(DQuat::from_mat3(&pose.matrix3))
            }
            _ => None,
        };
        let turn = rotation.filter(|turn| turn.length_squared() > 0.0).map(DQuat::normalize);
        let turn = turn.filter(|turn| turn.is_finite() && keyframe.position.is_finite());
        let mut turn = DVec4::from(turn.ok_or_else(|| {
            problem("needs a position and either a target elsewhere or a rotation w, x, y, z")
        })?);
        let time = keyframe.time.unwrap_or(number as f64);
        if let Some(last) = knots.last() {
            if time.is_nan() || time <= last.time {
                return Err(problem("is not later than the one before"));
            }
            // Both signs are the same rotation; the nearer one gives the shorter path.
            turn *= if last.turn.dot(turn) < 0.0 { -1.0 } else { 1.0 };
        }
        let fov = field_of_view(keyframe.fov.or(file.fov))?;
        knots.push(Knot { time, center: keyframe.position, turn, fov });
    }
    let (Some(&first), Some(&last)) = (knots.first(), knots.last()) else {
        return Err("has no keyframe".to_owned());
    };
    if knots.iter().any(|knot| knot.fov.is_some() != first.fov.is_some()) {
        return Err("has a field of view in some keyframes only; give `fov` for all".to_owned());
    }
    if file.is_loop && knots.len() > 1 {
        // Back in the mean time between keyframes.
        let time = last.time + (last.time - first.time) / (knots.len() - 1) as f64;
        let turn = if last.turn.dot(first.turn) < 0.0 { -first.turn } else { first.turn };
        knots.push(Knot { time, turn, ..first });
    }
    Ok(knots)
}

/// The frame at a time between the first and the last knot.
fn interpolated(knots: &[Knot], is_loop: bool, time: f64) -> PathFrame {
    let last = knots.len() - 1;
    let segment = knots.partition_point(|knot| knot.time <= time).clamp(1, last.max(1)) - 1;
    let (from, to) = (&knots[segment], &knots[(segment + 1).min(last)]);
    let length = to.time - from.time;
    let t = if length > 0.0 { ((time - from.time) / length).clamp(0.0, 1.0) } else { 0.0 };
    // The neighbours of a knot; across the seam of a loop, or the knot itself at an end.
    let around = |index: usize| {
        let span = knots[last].time - knots[0].time;
        let before = match index {
            0 if is_loop && last > 0 => {
                Knot { time: knots[last - 1].time - span, ..knots[last - 1] }
            }
            0 => knots[0],
            _ => knots[index - 1],
        };
        let after = match index {
            _ if index == last && is_loop && last > 0 => {
                Knot { time: knots[1].time + span, ..knots[1] }
            }
            _ if index == last => knots[last],
            _ => knots[index + 1],
        };
        (before, after)
    };
    let tangent = |index: usize| {
        let (before, after) = around(index);
        let span = (after.time - before.time).max(f64::MIN_POSITIVE);
        let turn = knots[index].turn;
        let toward = |other: DVec4| if turn.dot(other) < 0.0 { -other } else { other };
        ((after.center - before.center) / span, (toward(after.turn) - toward(before.turn)) / span)
    };
    let [a, b, c, d] = hermite(t);
    let (from_tangent, to_tangent) = (tangent(segment), tangent((segment + 1).min(last)));
    let center = a * from.center + c * to.center + length * (b * from_tangent.0 + d * to_tangent.0);
    let turn = a * from.turn + c * to.turn + length * (b * from_tangent.1 + d * to_tangent.1);
    let fov = from.fov.zip(to.fov).map(|(from, to)| from + (to - from) * t * t * (3.0 - 2.0 * t));
    let rotation = DQuat::from_vec4(turn).normalize();
    PathFrame {
        view_from_world: DAffine3::from_rotation_translation(rotation, center).inverse(),
        fov,
    }
}

/// The weights of the first value, its tangent, the second value and its tangent.
fn hermite(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [2.0 * t3 - 3.0 * t2 + 1.0, t3 - 2.0 * t2 + t, 3.0 * t2 - 2.0 * t3, t3 - t2]
}

impl Camera {
    /// The camera with a frame of another size and shape: the vertical field of view stays, and the principal point its
    /// share.
    #[doc(hidden)]
    pub fn framed(&self, [width, height]: [u32; 2]) -> Self {
        let factor = f64::from(height) / f64::from(self.height);
        let half = |camera: [u32; 2]| glam::DVec2::new(camera[0].into(), camera[1].into()) * 0.5;
        let off_center = self.principal_point - half([self.width, self.height]);
        Self {
            width,
            height,
            focal: self.focal * factor,
            principal_point: half([width, height]) + off_center * factor,
            ..*self
        }
    }

    /// The camera with a vertical field of view in radians.
    #[doc(hidden)]
    pub fn with_fov(&self, fov: f64) -> Self {
        let focal = 0.5 * f64::from(self.height) / (0.5 * fov).tan();
        Self { focal: self.focal * (focal / self.focal.y), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(text: &str, options: &PathOptions) -> Result<FramePath> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("path.json");
        std::fs::write(&path, text).unwrap();
        FramePath::load(&path, DVec3::NEG_Y, options)
    }

    const SQUARE: &str = r#"{"nightsplat_path": 1, "fov": 50, "keyframes": [
        {"position": [4, 0, 0], "target": [0, 0, 0]}, {"position": [0, 0, 4], "target": [0, 0, 0]},
        {"position": [-4, 0, 0], "target": [0, 0, 0]}, {"position": [0, 0, -4], "target": [0, 0, 0]}]}"#;

    fn center(frame: &PathFrame) -> DVec3 {
        frame.view_from_world.inverse().translation
    }

    #[test]
    fn a_path_passes_its_keyframes_in_their_time_and_looks_at_their_targets() {
        let options = PathOptions { fps: Some(10.0), ..PathOptions::default() };
        let path = load(SQUARE, &options).unwrap();
        assert_eq!((path.frames.len(), path.fps, path.size), (31, Some(10.0), None));
        let corners = [DVec3::X, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Z].map(|corner| 4.0 * corner);
        for (index, corner) in corners.into_iter().enumerate() {
            let frame = &path.frames[10 * index];
            assert!(center(frame).distance(corner) < 1e-9, "{index}");
            let target = frame.view_from_world.transform_point3(DVec3::ZERO);
            assert!(target.distance(DVec3::new(0.0, 0.0, 4.0)) < 1e-9, "{target}");
            assert!((frame.fov.unwrap() - 50_f64.to_radians()).abs() < 1e-12);
        }
        let steps = path.frames.windows(2).map(|two| center(&two[0]).distance(center(&two[1])));
        assert!(steps.fold(0.0, f64::max) < 1.0);
        for frame in &path.frames {
            assert!((frame.view_from_world.matrix3.determinant() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_loop_closes_smoothly_and_easing_slows_the_ends() {
        let with = |options: PathOptions| load(SQUARE, &options).unwrap().frames;
        let looped =
            with(PathOptions { frames: Some(40), is_loop: true, ..PathOptions::default() });
        let step = |a: usize, b: usize| center(&looped[a]).distance(center(&looped[b]));
        assert_eq!(looped.len(), 40);
        assert!((step(39, 0) - step(0, 1)).abs() < 0.02, "{} {}", step(39, 0), step(0, 1));
        // All quarters of the circle look alike.
        assert!((center(&looped[5]).length() - center(&looped[35]).length()).abs() < 1e-9);
        let smooth = PathOptions {
            frames: Some(31),
            easing: Some(Easing::Smooth),
            ..PathOptions::default()
        };
        let smooth = with(smooth);
        let step = |a: usize, b: usize| center(&smooth[a]).distance(center(&smooth[b]));
        assert!(step(0, 1) < 0.2 * step(15, 16), "{} {}", step(0, 1), step(15, 16));
        assert!(center(&smooth[30]).distance(DVec3::new(0.0, 0.0, -4.0)) < 1e-9);
    }

    #[test]
    fn a_camera_path_of_nerfstudio_has_a_camera_for_every_frame() {
        let text = r#"{"camera_type": "perspective", "render_height": 72, "render_width": 128, "fps": 24,
            "seconds": 1, "camera_path": [
            {"camera_to_world": [1,0,0,1, 0,1,0,2, 0,0,1,3, 0,0,0,1], "fov": 60, "aspect": 1.7},
            {"camera_to_world": [1,0,0,2, 0,1,0,2, 0,0,1,3, 0,0,0,1], "fov": 60, "aspect": 1.7}]}"#;
        let path = load(text, &PathOptions::default()).unwrap();
        assert_eq!((path.frames.len(), path.fps, path.size), (2, Some(24.0), Some([128, 72])));
        assert!(center(&path.frames[1]).distance(DVec3::new(2.0, 2.0, 3.0)) < 1e-12);
        // It looks along -z, with y up.
        let ahead = path.frames[0].view_from_world.transform_point3(DVec3::new(1.0, 2.5, 1.0));
        assert!(ahead.distance(DVec3::new(0.0, -0.5, 2.0)) < 1e-12, "{ahead}");
        let eased = PathOptions { easing: Some(Easing::Smooth), ..PathOptions::default() };
        assert!(load(text, &eased).unwrap_err().to_string().contains("a camera for every frame"));
    }

    #[test]
    fn a_file_that_is_no_path_is_refused_with_the_reason() {
        let refused = |text: &str, part: &str| {
            let message = load(text, &PathOptions::default()).unwrap_err().to_string();
            assert!(message.contains("path.json") && message.contains(part), "{message}");
        };
        refused("[", "is not JSON");
        refused("{}", "neither `nightsplat_path` nor");
        refused(r#"{"nightsplat_path": 2, "keyframes": []}"#, "of version 2; this build reads");
        let with = |frame: &str| format!(r#"{{"nightsplat_path": 1, "keyframes": [{frame}]}}"#);
        refused(&with(""), "has no keyframe");
        refused(&with(r#"{"position": [0, 0, 1]}"#), "keyframe 0 needs a position and either");
        refused(&with(r#"{"position": [0, 0, 1], "target": [0, 0, 1]}"#), "a target elsewhere");
        refused(&with(r#"{"position": [0, 0, 1], "rotation": [0, 0, 0, 0]}"#), "keyframe 0");
        let look = r#"{"time": 1, "position": [0, 0, 1], "target": [0, 0, 0]}"#;
        refused(&with(&format!("{look}, {look}")), "keyframe 1 is not later");
        refused(&with(&look.replace("1]", "1], \"fov\": 180")), "180 degrees is none");
        refused(&with(&look.replace("time", "tmie")), "unknown field `tmie`");
        refused(r#"{"camera_path": [{"camera_to_world": [1, 2]}]}"#, "frame 0: camera_to_world");
        refused(r#"{"camera_path": []}"#, "has no frame");
    }

    #[test]
    fn another_size_keeps_the_vertical_field_of_view() {
        let camera = Camera::perspective(DAffine3::IDENTITY, 0.8, [64, 48]);
        let wide = camera.framed([320, 96]);
        assert_eq!(wide, Camera::perspective(DAffine3::IDENTITY, 0.8, [320, 96]));
        let near = wide.with_fov(0.5);
        let expected = Camera::perspective(DAffine3::IDENTITY, 0.5, [320, 96]);
        assert!(near.focal.distance(expected.focal) < 1e-9);
    }
}
