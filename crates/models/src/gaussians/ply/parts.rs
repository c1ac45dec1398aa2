//! A PLY of Gaussians that is read and written part by part, in memory that does not depend on its size.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use nightsplat_core::input::unreadable;
use nightsplat_core::output::write_whole_with;
use nightsplat_core::ply::{PlyEncoding, PlyHeader};
use nightsplat_core::{Error, Result};

use super::{PlyLayout, Writer, comment_lines, unusable};
use crate::gaussians::{Gaussians, ModelFacts, Shape};

/// The Gaussians of a part: 15 MB of degree 3.
pub const PART: usize = 1 << 16;

/// A PLY file whose Gaussians are read part by part, as often as they are needed.
#[derive(Debug)]
pub struct PartFile {
    path: PathBuf,
    file: File,
    layout: PlyLayout,
    /// Gaussians of a part.
    part: usize,
}

impl PartFile {
    /// Opens a binary PLY in the INRIA layout; `None` for a file of another kind, and for what is not read twice, such
    /// as a pipe.
    pub fn open(path: &Path, part: usize) -> Result<Option<Self>> {
        let cannot = |error: std::io::Error| unreadable(path, &error);
        if !path.is_file() {
            return Ok(None);
        }
        let mut file = File::open(path).map_err(cannot)?;
        let length = file.metadata().map_err(cannot)?.len();
        let header = match PlyHeader::read(&mut file).map_err(cannot)? {
            Some(header) => header.map_err(|problem| unusable(path, &problem))?,
            None => return Ok(None),
        };
        if header.encoding == PlyEncoding::Text {
            return Ok(None);
        }
        // It may have changed since.
        let length = length.saturating_sub(header.length as u64);
        let layout = PlyLayout::new(&header, length);
        let layout = layout.map_err(|problem| unusable(path, &problem))?;
        Ok(Some(Self { path: path.to_owned(), file, layout, part }))
    }

    /// What the header states.
    pub fn facts(&self) -> &ModelFacts {
        &self.layout.facts
    }

    /// The number of Gaussians.
    pub fn count(&self) -> usize {
        self.layout.count
    }

    /// Their attributes.
    pub fn shape(&self) -> Shape {
        self.layout.shape
    }

    /// All Gaussians; their numbers may be infinite or NaN.
    pub fn whole(self) -> Result<Gaussians> {
        let mut whole = self.layout.gaussians(&[]);
        Self { part: usize::MAX, ..self }.read(|part| {
            whole = part;
            Ok(())
        })?;
        Ok(whole)
    }

    /// All Gaussians, a part at a time and in order. Their numbers may be infinite or NaN.
    pub fn read(&self, mut take: impl FnMut(Gaussians) -> Result<()>) -> Result<()> {
        let PlyLayout { count, stride, length, .. } = self.layout;
        let cannot = |error: std::io::Error| unreadable(&self.path, &error);
        let mut file = &self.file;
        file.seek(SeekFrom::Start(length as u64)).map_err(cannot)?;
        let mut vertices = vec![];
        for first in (0..count).step_by(self.part) {
            vertices.resize((count - first).min(self.part) * stride, 0);
            file.read_exact(&mut vertices).map_err(cannot)?;
            take(self.layout.gaussians(&vertices))?;
        }
        Ok(())
    }
}

/// Writes a file of `count` Gaussians of the shape and origin of `of`, which `parts` hands over in order; the same
/// bytes as of [`super::save_with_comments`].
pub fn save_parts(
    path: &Path,
    of: &Gaussians,
    count: usize,
    comments: &[String],
    parts: impl FnOnce(&mut dyn FnMut(&Gaussians) -> Result<()>) -> Result<()>,
) -> Result<()> {
    let mut failed = None;
    let written = write_whole_with(path, |partial| {
        let lines = comment_lines(of.origin, comments);
        let mut writer = Writer::new(File::create(partial)?, &lines, of.shape, count)?;
        let mut unwritten = None;
        let handed = parts(&mut |part| {
            writer.add(part).map_err(|error| {
                unwritten = Some(error);
                Error::output(path, "cannot be written")
            })
        });
        if let Some(error) = unwritten {
            return Err(error);
        }
        if let Err(error) = handed {
            failed = Some(error);
            return Err(std::io::Error::other("its parts cannot be read"));
        }
        writer.finish()
    });
    failed.map_or(written, Err)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::random::Stream;

    #[test]
    fn parts_are_the_whole_and_write_the_same_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let mut model = Gaussians::zeros(23, 2);
        let stream = Stream::new(7, 0);
        for (index, value) in (0..).zip(&mut model.parameters) {
            *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
        }
        model.origin = glam::DVec3::new(1e6, 2.0, -3.0);
        let comments = ["x".repeat(200_000), "nightsplat near 0.1".to_owned()];
        super::super::save_with_comments(&model, path("a.ply"), &comments).unwrap();
        let file = PartFile::open(&path("a.ply"), 5).unwrap().unwrap();
        assert_eq!((file.count(), file.shape(), file.facts().near), (23, 2.into(), Some(0.1)));
        let mut sizes = vec![];
        save_parts(&path("b.ply"), &model, 23, &comments, |take| {
            file.read(|part| {
                sizes.push(part.count);
                take(&part)
            })
        })
        .unwrap();
        assert_eq!(sizes, [5, 5, 5, 5, 3]);
        let [a, b] = ["a.ply", "b.ply"].map(|name| std::fs::read(path(name)).unwrap());
        assert_eq!(a, b);

        let lost = |take: &mut dyn FnMut(&Gaussians) -> Result<()>| {
            take(&model)?;
            Err(Error::input("a.ply", "is lost"))
        };
        let refused = save_parts(&path("d.ply"), &model, 23, &comments, lost).unwrap_err();
        assert!(refused.to_string().contains("a.ply: is lost"), "{refused}");
        std::fs::write(path("c.ply"), &a[..a.len() - 1]).unwrap();
        let refused = PartFile::open(&path("c.ply"), 5).unwrap_err().to_string();
        assert!(refused.contains("is truncated"), "{refused}");
        std::fs::write(path("c.spz"), "no model").unwrap();
        assert!(PartFile::open(&path("c.spz"), 5).unwrap().is_none());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
    }
}
