//! Every parser of external files as a function of bytes, for fuzzing and `tests/photographs/hostile_bytes.rs`.
//!
//! A parser may refuse any input with an error of one line. It never panics, and what it accepts is valid.

use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_models::gaussians::ply;

use nightsplat::train::check_checkpoint;
use nightsplat::{
    Dataset, Image, ImageFile, LoadOptions, Model, Profile, Result, ToneSettings, TrainConfig,
};

/// A parser, by the name of its fuzz target and of its folder of seeds.
pub(crate) type Parser = (&'static str, fn(&[u8]));

/// All of them.
pub(crate) const PARSERS: [Parser; 17] = [
    ("colmap_cameras_bin", |bytes| dataset("colmap/binary", "sparse/0/cameras.bin", bytes)),
    ("colmap_images_bin", |bytes| dataset("colmap/binary", "sparse/0/images.bin", bytes)),
    ("colmap_points_bin", |bytes| dataset("colmap/binary", "sparse/0/points3D.bin", bytes)),
    ("colmap_cameras_txt", |bytes| dataset("colmap/text", "sparse/0/cameras.txt", bytes)),
    ("colmap_images_txt", |bytes| dataset("colmap/text", "sparse/0/images.txt", bytes)),
    ("colmap_points_txt", |bytes| dataset("colmap/text", "sparse/0/points3D.txt", bytes)),
    ("transforms_json", |bytes| dataset("lom", "transforms_train.json", bytes)),
    ("ply", |bytes| {
        file("ply", bytes, |path| {
            let gaussians = ply::load(path)?;
            assert!(gaussians.parameters.iter().all(|value| value.is_finite()));
            Ok(())
        });
    }),
    ("spz", |bytes| file("spz", bytes, model)),
    ("sog", |bytes| file("sog", bytes, model)),
    ("checkpoint", |bytes| file("safetensors", bytes, check_checkpoint)),
    ("config_toml", |bytes| file("toml", bytes, |path| TrainConfig::load(path)?.check())),
    ("curve_toml", |bytes| file("toml", bytes, curve)),
    ("curve_csv", |bytes| file("csv", bytes, curve)),
    ("curve_cube", |bytes| file("cube", bytes, curve)),
    ("exr", |bytes| file("exr", bytes, image)),
    ("jpeg", |bytes| file("jpg", bytes, image)),
];

fn model(path: &Path) -> Result<()> {
    let Model { gaussians, near, .. } = Model::load(path)?;
    assert!(gaussians.parameters.iter().all(|value| value.is_finite()) && near > 0.0);
    Ok(())
}

fn curve(path: &Path) -> Result<()> {
    if path.extension().is_some_and(|extension| extension == "toml") {
        printed(Profile::load(path).map(drop));
    }
    let settings = ToneSettings::load(path)?;
    // What is plotted, shown and trained with.
    let statistics = settings.plain_statistics();
    for t in [0.0, 0.1, 0.5, 1.0, 2.0, 1e6] {
        let value = settings.value(t, &statistics);
        assert!((0.0..=1.0).contains(&value), "{value} at {t}");
    }
    Ok(())
}

fn image(path: &Path) -> Result<()> {
    let (width, height) = Image::size_of(path)?;
    // As a dataset asks before anything is decoded.
    if u64::from(width) * u64::from(height) > 1 << 22 {
        return Ok(());
    }
    let image = Image::load(path)?;
    assert_eq!(image.data.len(), 3 * image.pixel_count());
    Image::load_as_stored(path).map(drop)
}

/// Writes the bytes as a file of that extension and reads it.
fn file(extension: &str, bytes: &[u8], read: impl FnOnce(&Path) -> Result<()>) {
    let path = FOLDER.with(|folder| folder.path().join("file").with_extension(extension));
    fs::write(&path, bytes).unwrap();
    printed(read(&path));
}

/// Puts the bytes in the place of one file of a dataset and loads that.
fn dataset(set: &str, file: &str, bytes: &[u8]) {
    let root = FOLDER.with(|folder| folder.path().join(set));
    if !root.exists() {
        copy(&fixtures().join(set), &root);
    }
    let original = fs::read(root.join(file)).unwrap_or_default();
    fs::write(root.join(file), bytes).unwrap();
    printed(Dataset::load(&root, &LoadOptions::default()).map(|dataset| {
        assert!(dataset.points.iter().all(|point| point.position.is_finite()));
        let cameras = dataset.views.iter().map(|view| view.camera);
        for camera in cameras {
            assert!(camera.focal.is_finite() && camera.view_from_world.is_finite());
        }
    }));
    fs::write(root.join(file), original).unwrap();
}

/// An error is one line.
fn printed(outcome: Result<()>) {
    if let Err(error) = outcome {
        let message = error.to_string();
        assert!(!message.is_empty() && !message.contains('\n'), "{message:?}");
    }
}

thread_local! {
    static FOLDER: tempfile::TempDir = tempfile::tempdir().unwrap();
}

/// The small sets that are committed with the tests.
fn fixtures() -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"))
        .ancestors()
        .map(|folder| folder.join("tests/fixtures"));
    tests.into_iter().find(|folder| folder.exists()).unwrap()
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().flatten() {
        let (from, to) = (entry.path(), to.join(entry.file_name()));
        if from.is_dir() {
            copy(&from, &to);
        } else {
            fs::copy(from, to).unwrap();
        }
    }
}
