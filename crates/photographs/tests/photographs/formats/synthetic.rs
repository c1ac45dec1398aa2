//! A small capture on a ring of cameras, written in every supported layout.

#![allow(dead_code, reason = "the tests of the command use less")]

use std::fs::{self, File};
use std::io::Write as _;
use std::ops::Range;
use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use image::{ImageBuffer, Luma};
use nightsplat_photographs::dataset::{Dataset, LoadOptions, Split, View};
use nightsplat_photographs::image::{Image, ImageFile};
use serde_json::{Value, json};
use zip::write::{SimpleFileOptions, ZipWriter};

pub(crate) use crate::common::Folder;
use crate::common::contents;

pub(crate) const SIZE: (u32, u32) = (40, 30);
pub(crate) const FOCAL: DVec2 = DVec2::new(35.0, 36.0);
pub(crate) const PRINCIPAL_POINT: DVec2 = DVec2::new(18.0, 16.0);

/// View number `index`: world to view, `OpenCV` axes, looking at the origin from a ring.
pub(crate) fn pose(index: usize) -> DAffine3 {
    let angle = 0.4 * index as f64;
    let center = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.5 + 0.1 * (index % 3) as f64);
    let forward = -center.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let world_from_view = DMat3::from_cols(right, forward.cross(right), forward);
    DAffine3 { matrix3: world_from_view, translation: center }.inverse()
}

pub(crate) fn name(index: usize) -> String {
    format!("v{index:02}")
}

/// The dark photograph's value; the normal-light photograph is four times as bright.
pub(crate) fn dark(index: usize) -> f32 {
    (10 + index) as f32 / 255.0
}

pub(crate) fn photograph(path: &Path, size: (u32, u32), value: f32) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    Image::filled(size.0, size.1, [value; 3]).save_png8(path).unwrap();
}

pub(crate) fn photographs(root: &Path, folder: &str, views: Range<usize>, gain: f32) {
    photographs_of_size(root, folder, views, SIZE, gain);
}

/// [`photographs`] of any size.
pub(crate) fn photographs_of_size(
    root: &Path,
    folder: &str,
    views: Range<usize>,
    size: (u32, u32),
    gain: f32,
) {
    for index in views {
        let path = root.join(folder).join(name(index)).with_extension("png");
        photograph(&path, size, gain * dark(index));
    }
}

/// Nine photographs that are black beyond this distance from their middle.
pub(crate) fn circles(root: &Path, radius: f64) {
    fs::create_dir_all(root.join("images")).unwrap();
    for index in 0..9 {
        let image = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
            let (from_x, from_y) = (f64::from(x) - 19.5, f64::from(y) - 14.5);
            let value = 0.04 + 0.05 * ((x + 3 * y + 2 * index) % 7) as f32 / 7.0;
            [if from_x.hypot(from_y) < radius { value } else { 0.0 }; 3]
        });
        image.save_png8(root.join(format!("images/v0{index}.png"))).unwrap();
    }
}

/// A frame of a transforms file: view to world, OpenGL axes.
pub(crate) fn frame(index: usize, file_path: &str) -> Value {
    frame_of(&pose(index), file_path)
}

/// [`frame`] for any pose.
pub(crate) fn frame_of(pose: &DAffine3, file_path: &str) -> Value {
    let world_from_gl = pose.inverse() * DAffine3::from_scale(DVec3::new(1.0, -1.0, -1.0));
    let (m, t) = (world_from_gl.matrix3, world_from_gl.translation);
    let row = |row: usize| json!([m.col(0)[row], m.col(1)[row], m.col(2)[row], t[row]]);
    json!({ "file_path": file_path, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]] })
}

pub(crate) fn transforms(frames: Vec<Value>) -> Value {
    json!({
        "w": f64::from(SIZE.0), "h": f64::from(SIZE.1), "fl_x": FOCAL.x, "fl_y": FOCAL.y,
        "cx": PRINCIPAL_POINT.x, "cy": PRINCIPAL_POINT.y, "frames": frames,
    })
}

/// The listing of some photographs of a folder, by this ending.
pub(crate) fn listed(folder: &str, views: Range<usize>, ending: &str) -> Value {
    transforms(
        views.map(|index| frame(index, &format!("{folder}/{}{ending}", name(index)))).collect(),
    )
}

/// Sets these keys of an object.
pub(crate) fn extend(object: &mut Value, keys: &Value) {
    object.as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
}

pub(crate) fn write_json(path: impl AsRef<Path>, value: &Value) {
    fs::write(path, serde_json::to_string_pretty(value).unwrap()).unwrap();
}

impl Folder {
    /// A COLMAP model in `sparse/0`, and its photographs in `images`.
    pub(crate) fn with_model(model: &Model) -> Self {
        let folder = Self::empty();
        photographs(&folder, "images", 0..model.images.len(), 1.0);
        model.write_binary(&folder.join("sparse/0"));
        folder
    }

    /// The same as text.
    pub(crate) fn with_text_model(model: &Model) -> Self {
        let folder = Self::empty();
        photographs(&folder, "images", 0..model.images.len(), 1.0);
        model.write_text(&folder.join("sparse/0"));
        folder
    }

    /// The model in both encodings.
    pub(crate) fn with_either_model(model: &Model) -> [Self; 2] {
        [Self::with_model(model), Self::with_text_model(model)]
    }

    /// A listing, changed by `edit`, and its photographs in `images`.
    pub(crate) fn with_listing(views: usize, edit: impl FnOnce(&mut Value)) -> Self {
        let folder = Self::empty();
        photographs(&folder, "images", 0..views, 1.0);
        let mut listing = listed("images", 0..views, ".png");
        edit(&mut listing);
        write_json(folder.join("transforms.json"), &listing);
        folder
    }

    /// Ten views in the layout of LOM, two of them for tests.
    pub(crate) fn lom() -> Self {
        let folder = Self::empty();
        lom(&folder, 10, &[2, 5]);
        folder
    }
}

/// `low/` for training and `high/` for scores, both for every view: the layout of LOM.
pub(crate) fn lom(root: &Path, views: usize, tests: &[usize]) {
    photographs(root, "low", 0..views, 1.0);
    photographs(root, "high", 0..views, 4.0);
    let (test, train): (Vec<usize>, Vec<usize>) =
        (0..views).partition(|index| tests.contains(index));
    let frames = |folder: &str, views: &[usize]| {
        views.iter().map(|index| frame(*index, &format!("{folder}/{}.png", name(*index)))).collect()
    };
    write_json(root.join("transforms_train.json"), &transforms(frames("low", &train)));
    write_json(root.join("transforms_test.json"), &transforms(frames("high", &test)));
    write_json(root.join("transforms_val.json"), &transforms(frames("high", &test[..1])));
}

/// A COLMAP model in memory.
#[derive(Clone)]
pub(crate) struct Model {
    /// Id, model name, its number, parameters.
    pub(crate) cameras: Vec<(u32, &'static str, u32, Vec<f64>)>,
    /// Id, pose, camera, name.
    pub(crate) images: Vec<(u32, DAffine3, u32, String)>,
    /// Id, position, ids of images.
    pub(crate) points: Vec<(u64, DVec3, Vec<u32>)>,
}

/// Image ids are indices plus 7 in reverse order, to detect code that confuses ids and indices.
pub(crate) fn model(views: usize) -> Model {
    let parameters = vec![FOCAL.x, FOCAL.y, PRINCIPAL_POINT.x, PRINCIPAL_POINT.y];
    let image = |index: usize| (index as u32 + 7, pose(index), 3, format!("{}.png", name(index)));
    let point = |index: usize| {
        let angle = index as f64;
        let seen_by =
            (0..views).filter(|view| (view + index).is_multiple_of(3)).map(|view| view as u32 + 7);
        (
            100 + index as u64,
            DVec3::new(angle.cos(), angle.sin(), 0.2 * (3.0 * angle).sin()),
            seen_by.collect(),
        )
    };
    Model {
        cameras: vec![(3, "PINHOLE", 1, parameters)],
        images: (0..views).rev().map(image).collect(),
        points: (0..20).map(point).collect(),
    }
}

impl Model {
    pub(crate) fn write_binary(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        let mut cameras = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for (id, _, model, parameters) in &self.cameras {
            cameras.extend([*id, *model].iter().flat_map(|value| value.to_le_bytes()));
            cameras.extend([SIZE.0, SIZE.1].iter().flat_map(|side| u64::from(*side).to_le_bytes()));
            cameras.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
        }
        let mut images = (self.images.len() as u64).to_le_bytes().to_vec();
        for (id, pose, camera, name) in &self.images {
            images.extend(id.to_le_bytes());
            images.extend(
                quaternion_and_translation(pose).iter().flat_map(|value| value.to_le_bytes()),
            );
            images.extend(camera.to_le_bytes());
            images.extend(name.bytes().chain([0]));
            // One keypoint without a point.
            images.extend(1_u64.to_le_bytes().iter().chain(&[0; 16]).chain(&[255; 8]));
        }
        let mut points = (self.points.len() as u64).to_le_bytes().to_vec();
        for (id, position, track) in &self.points {
            points.extend(id.to_le_bytes());
            points.extend(position.to_array().iter().flat_map(|value| value.to_le_bytes()));
            points.extend([200, 100, 50].iter().chain(&0.5_f64.to_le_bytes()));
            points.extend((track.len() as u64).to_le_bytes());
            points.extend(track.iter().flat_map(|image| [*image, 0]).flat_map(u32::to_le_bytes));
        }
        fs::write(folder.join("cameras.bin"), cameras).unwrap();
        fs::write(folder.join("images.bin"), images).unwrap();
        fs::write(folder.join("points3D.bin"), points).unwrap();
    }

    pub(crate) fn write_text(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        let numbers =
            |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let mut cameras = "# Camera list\n".to_owned();
        for (id, model, _, parameters) in &self.cameras {
            cameras += &format!("{id} {model} {} {} {}\n", SIZE.0, SIZE.1, numbers(parameters));
        }
        let mut images = "# Image list\n".to_owned();
        for (index, (id, pose, camera, name)) in self.images.iter().enumerate() {
            // Every other one has no keypoint: an empty line.
            let keypoints = if index % 2 == 0 { "1.5 2.5 -1" } else { "" };
            images += &format!(
                "{id} {} {camera} {name}\n{keypoints}\n",
                numbers(&quaternion_and_translation(pose))
            );
        }
        let mut points = "# 3D point list\n".to_owned();
        for (id, position, track) in &self.points {
            let track: String = track.iter().map(|image| format!(" {image} 0")).collect();
            points += &format!("{id} {} 200 100 50 0.5{track}\n", numbers(&position.to_array()));
        }
        fs::write(folder.join("cameras.txt"), cameras).unwrap();
        fs::write(folder.join("images.txt"), images).unwrap();
        fs::write(folder.join("points3D.txt"), points).unwrap();
    }
}

fn quaternion_and_translation(pose: &DAffine3) -> [f64; 7] {
    let rotation = glam::DQuat::from_mat3(&pose.matrix3);
    let t = pose.translation;
    [rotation.w, rotation.x, rotation.y, rotation.z, t.x, t.y, t.z]
}

/// Puts an orientation into a JPEG's Exif.
pub(crate) fn orient(path: &Path, orientation: u8) {
    let bytes = fs::read(path).unwrap();
    let exif = [
        b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(),
        &[orientation, 0, 0, 0],
        &[0; 4],
    ];
    let exif = exif.concat();
    let segment = [&[0xFF, 0xE1][..], &(exif.len() as u16 + 2).to_be_bytes(), &exif].concat();
    fs::write(path, [&bytes[..2], &segment, &bytes[2..]].concat()).unwrap();
}

/// Packs a folder into an archive, below `prefix`.
pub(crate) fn pack(from: &Path, zip: &Path, prefix: &str) {
    let mut writer = ZipWriter::new(File::create(zip).unwrap());
    let packed = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
    for (path, bytes) in contents(from) {
        writer.start_file(format!("{prefix}{}", path.display()), packed).unwrap();
        writer.write_all(&bytes).unwrap();
    }
    writer.start_file("__MACOSX/._x.png", packed).unwrap();
    writer.finish().unwrap();
}

pub(crate) fn load(root: &Path) -> Dataset {
    load_with(root, LoadOptions::default())
}

pub(crate) fn load_with(root: &Path, options: LoadOptions) -> Dataset {
    Dataset::load(root, &options).unwrap()
}

pub(crate) fn names(dataset: &Dataset, split: Split) -> Vec<&str> {
    dataset.views.iter().filter(|view| view.split == split).map(|view| view.name.as_str()).collect()
}

pub(crate) fn view<'a>(dataset: &'a Dataset, name: &str) -> &'a View {
    dataset.views.iter().find(|view| view.name == name).unwrap()
}

/// A JPEG of one grey with an orientation in its Exif.
pub(crate) fn jpeg(path: &Path, (width, height): (u32, u32), orientation: u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    ImageBuffer::from_fn(width, height, |x, _| Luma([20 + (x > width / 2) as u8 * 20]))
        .save(path)
        .unwrap();
    orient(path, orientation);
}

/// The left half of the image is white.
pub(crate) fn half_mask(path: &Path, size: (u32, u32)) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let half = |x: u32, _| [f32::from(2 * x < size.0); 3];
    Image::from_fn(size.0, size.1, half).save_png8(path).unwrap();
}
