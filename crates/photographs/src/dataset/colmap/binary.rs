//! The binary encoding: little-endian records after a 64-bit count, every read checked against the file's end.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use nightsplat_core::camera::Lens;
use nightsplat_core::{Error, Result};

use super::{MODELS, ModelImage, ModelPoint, lens, pose, remedy};
use crate::tree;

pub(super) fn cameras(path: &Path) -> Result<BTreeMap<u32, Lens>> {
    let bytes = tree::bytes(path)?;
    let mut reader = Reader::new(path, "camera", &bytes);
    reader.records(|reader| {
        let (id, model) = (reader.u32()?, reader.u32()?);
        let (width, height) = (reader.u64()?, reader.u64()?);
        let row = MODELS.get(model as usize);
        let (name, parameters) = row.ok_or_else(|| {
            let problem = format!("camera {id} has the unknown model {model}; {}", remedy(""));
            Error::input(path, problem)
        })?;
        let parameters = (0..*parameters).map(|_| reader.f64()).collect::<Result<Vec<f64>>>()?;
        let lens = lens(name, width, height, &parameters);
        Ok((id, lens.map_err(|problem| Error::input(path, format!("camera {id} {problem}")))?))
    })
}

pub(super) fn images(path: &Path) -> Result<Vec<ModelImage>> {
    let bytes = tree::bytes(path)?;
    let mut reader = Reader::new(path, "image", &bytes);
    reader.records(|reader| {
        let id = reader.u32()?;
        let quaternion = [reader.f64()?, reader.f64()?, reader.f64()?, reader.f64()?];
        let translation = [reader.f64()?, reader.f64()?, reader.f64()?];
        let (camera, name) = (reader.u32()?, reader.name()?);
        // x, y and the point's id of every keypoint, which the tracks of points repeat.
        let keypoints = reader.u64()?;
        reader.skip(keypoints, 24)?;
        Ok(ModelImage { id, camera, name, view_from_world: pose(quaternion, translation) })
    })
}

/// The file of images with those that `renamed` gives a name, under that name.
pub(in crate::dataset) fn images_renamed(
    path: &Path,
    renamed: impl Fn(&str) -> Option<String>,
) -> Result<Vec<u8>> {
    let bytes = tree::bytes(path)?;
    let mut reader = Reader::new(path, "image", &bytes);
    let kept: Vec<Option<Vec<u8>>> = reader.records(|reader| {
        // Id, pose and camera.
        let head = reader.take(4 + 7 * 8 + 4)?;
        let name = reader.name()?;
        let (rest, count) = (reader.rest, reader.u64()?);
        reader.skip(count, 24)?;
        let keypoints = &rest[..rest.len() - reader.rest.len()];
        Ok(renamed(&name).map(|name| [head, name.as_bytes(), &[0], keypoints].concat()))
    })?;
    let kept: Vec<Vec<u8>> = kept.into_iter().flatten().collect();
    Ok([&(kept.len() as u64).to_le_bytes()[..], &kept.concat()].concat())
}

pub(super) fn points(path: &Path) -> Result<BTreeMap<u64, ModelPoint>> {
    let bytes = tree::bytes(path)?;
    let mut reader = Reader::new(path, "point", &bytes);
    reader.records(|reader| {
        let id = reader.u64()?;
        let position = DVec3::new(reader.f64()?, reader.f64()?, reader.f64()?);
        // Red, green, blue (3 bytes) and the reprojection error.
        reader.skip(1, 3 + 8)?;
        let mut images = Vec::new();
        for _ in 0..reader.u64()? {
            images.push(reader.u32()?);
            reader.skip(1, 4)?;
        }
        Ok((id, ModelPoint { position, images }))
    })
}

struct Reader<'a> {
    path: &'a Path,
    record: &'static str,
    /// Index and count of the records, for messages.
    progress: (u64, u64),
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, record: &'static str, bytes: &'a [u8]) -> Self {
        Self { path, record, progress: (0, 0), rest: bytes }
    }

    /// Grows as records are read: a corrupt count ends at the file's end and allocates nothing in advance.
    fn records<T, C: FromIterator<T>>(
        &mut self,
        mut read: impl FnMut(&mut Self) -> Result<T>,
    ) -> Result<C> {
        let count = self.u64()?;
        let mut next = |index| {
            self.progress = (index + 1, count);
            read(self)
        };
        (0..count).map(&mut next).collect()
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or_else(|| self.cut_short())?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    fn u32(&mut self) -> Result<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64> {
        self.array().map(f64::from_le_bytes)
    }

    fn skip(&mut self, count: u64, size: u64) -> Result<()> {
        let length = count.checked_mul(size).and_then(|length| usize::try_from(length).ok());
        self.take(length.ok_or_else(|| self.cut_short())?).map(drop)
    }

    /// Up to the terminating zero.
    fn name(&mut self) -> Result<String> {
        let length =
            self.rest.iter().position(|byte| *byte == 0).ok_or_else(|| self.cut_short())?;
        let name = String::from_utf8_lossy(self.take(length)?).into_owned();
        self.skip(1, 1)?;
        Ok(name)
    }

    fn cut_short(&self) -> Error {
        let (record, (index, count)) = (self.record, self.progress);
        let problem = format!("is cut short at {record} {index} of {count}; copy it again");
        Error::input(self.path, problem)
    }
}
