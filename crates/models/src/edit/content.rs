//! The Gaussians of a model while it is edited: those of a PLY stay in the file, and are read part by part, until an
//! operation needs all of them at once.

use std::borrow::Cow;
use std::path::Path;

use nightsplat_core::Result;

use super::operation::ModelChecksum;
use super::step::Step;
use crate::export::Provenance;
use crate::files;
use crate::gaussians::ply::parts::{PartFile, save_parts};
use crate::gaussians::{Gaussians, Lengths};

/// The Gaussians of a model after some steps.
#[derive(Debug)]
pub struct Content {
    source: ContentSource,
    count: usize,
    /// None of the Gaussians, with their shape and origin.
    none: Gaussians,
}

#[derive(Debug)]
enum ContentSource {
    Whole(Gaussians),
    /// The steps apply to each part when it is read.
    Parts(PartFile, Vec<Step>),
}

impl Content {
    /// The finite Gaussians of a file; warns if there are others, and refuses a file of others alone.
    pub fn of_file(path: &Path, file: PartFile) -> Result<Self> {
        let count = file.count();
        let mut content = Self::of_parts(file);
        content.apply(Step::Finite)?;
        files::warn_of_left_out(path, count, content.count)?;
        Ok(content)
    }

    fn of_parts(file: PartFile) -> Self {
        let mut none = Gaussians::zeros(0, file.shape());
        none.origin = file.facts().origin;
        Self { count: file.count(), none, source: ContentSource::Parts(file, vec![]) }
    }

    /// Gaussians in memory.
    pub fn of_whole(gaussians: Gaussians) -> Self {
        let mut none = Gaussians::zeros(0, gaussians.shape);
        none.origin = gaussians.origin;
        Self { count: gaussians.count, none, source: ContentSource::Whole(gaussians) }
    }

    /// The number of Gaussians.
    pub fn count(&self) -> usize {
        self.count
    }

    /// None of the Gaussians, with their shape and origin.
    pub fn none(&self) -> &Gaussians {
        &self.none
    }

    /// The checksum of a model by which an edit list names it.
    pub fn fingerprint(&self) -> Result<String> {
        let mut fingerprint = ModelChecksum::new(self.count, self.none.shape, self.none.origin);
        self.each_part(|part| {
            fingerprint.add(part);
            Ok(())
        })?;
        Ok(fingerprint.text())
    }

    /// The distance from the origin within which half of the Gaussians are.
    pub fn size(&self) -> Result<f64> {
        let mut lengths = Lengths::default();
        self.each_part(|part| {
            part.means().iter().for_each(|mean| lengths.add(mean.length()));
            Ok(())
        })?;
        Ok(lengths.median())
    }

    /// Takes a step; a model may have no Gaussians left after it.
    pub fn apply(&mut self, step: Step) -> Result<()> {
        let removes = step.removes();
        step.apply(0, &mut self.none);
        match &mut self.source {
            ContentSource::Whole(gaussians) => {
                step.apply(0, gaussians);
                self.count = gaussians.count;
            }
            ContentSource::Parts(_, steps) => {
                steps.push(step);
                if removes {
                    let mut count = 0;
                    self.each_part(|part| {
                        count += part.count;
                        Ok(())
                    })?;
                    self.count = count;
                }
            }
        }
        Ok(())
    }

    /// All Gaussians, in memory.
    pub fn whole(&self) -> Result<Cow<'_, Gaussians>> {
        if let ContentSource::Whole(gaussians) = &self.source {
            return Ok(Cow::Borrowed(gaussians));
        }
        let mut whole = Gaussians::zeros(self.count, self.none.shape);
        whole.origin = self.none.origin;
        let mut first = 0;
        self.each_part(|part| {
            whole.replace(first, part);
            first += part.count;
            Ok(())
        })?;
        Ok(Cow::Owned(whole))
    }

    /// Replaces the Gaussians.
    pub fn set(&mut self, gaussians: Gaussians) {
        *self = Self::of_whole(gaussians);
    }

    /// Writes a PLY.
    pub fn save_ply(&self, provenance: &Provenance, out: &Path) -> Result<()> {
        let comments = provenance.ply_comments(&self.none);
        save_parts(out, &self.none, self.count, &comments, |take| self.each_part(|part| take(part)))
    }

    fn each_part(&self, mut take: impl FnMut(&Gaussians) -> Result<()>) -> Result<()> {
        match &self.source {
            ContentSource::Whole(gaussians) => take(gaussians),
            ContentSource::Parts(file, steps) => {
                let mut firsts = vec![0; steps.len()];
                file.read(|mut part| {
                    for (step, first) in steps.iter().zip(&mut firsts) {
                        let count = part.count;
                        step.apply(*first, &mut part);
                        *first += count;
                    }
                    take(&part)
                })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::super::operation::{Region, Span, fingerprint};
    use super::*;
    use crate::export::tests::drawn;

    /// Every step, one after the other.
    fn steps(content: &mut Content) {
        let far = DVec3::new(0.0, 0.0, 1e6);
        for step in [
            Step::Crop(Region::Sphere(DVec3::ZERO, 5.5)),
            Step::Rotate(DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7)),
            Step::OpacityMin(0.1),
            Step::Move { by: DVec3::ONE, is_far: false },
            Step::Scale(0.3),
            Step::Move { by: far, is_far: true },
            Step::delete(&[Span::Range(40, 47), Span::One(3), Span::Range(5, 21)], 70).unwrap(),
            Step::ShDegree(1),
            Step::Crop(Region::Box(far - 9.0, far + 1.5)),
        ] {
            content.apply(step).unwrap();
        }
    }

    #[test]
    fn a_file_that_is_read_in_parts_becomes_the_same_as_in_memory() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let model = drawn(100, 2);
        model.save(path("model.ply")).unwrap();
        let mut whole = Content::of_whole(model.clone());
        steps(&mut whole);
        assert!(whole.count() > 10 && whole.count() < 60, "{}", whole.count());
        let provenance = Provenance::default();
        whole.save_ply(&provenance, &path("whole.ply")).unwrap();
        for part in [1, 7, 64, 1000] {
            let file = PartFile::open(&path("model.ply"), part).unwrap().unwrap();
            let mut parts = Content::of_parts(file);
            assert_eq!(parts.fingerprint().unwrap(), fingerprint(&model));
            assert_eq!(parts.size().unwrap(), Content::of_whole(model.clone()).size().unwrap());
            steps(&mut parts);
            assert_eq!((parts.count(), parts.none()), (whole.count(), whole.none()));
            assert_eq!(parts.whole().unwrap(), whole.whole().unwrap(), "parts of {part}");
            parts.save_ply(&provenance, &path("parts.ply")).unwrap();
            let [a, b] = ["whole.ply", "parts.ply"].map(|name| std::fs::read(path(name)).unwrap());
            assert!(a == b, "parts of {part}");
        }
        // One that is not finite is left out, read in parts or whole.
        let mut broken = model.clone();
        broken.raw_opacities_mut()[70] = f32::NEG_INFINITY;
        broken.save(path("broken.ply")).unwrap();
        let (file, _) = files::open_parts(&path("broken.ply"), 16).unwrap().unwrap();
        let content = Content::of_file(&path("broken.ply"), file).unwrap();
        let (read, _) = files::read(&path("broken.ply")).unwrap();
        assert_eq!((content.count(), content.whole().unwrap().into_owned()), (99, read.clone()));
        assert_eq!(content.fingerprint().unwrap(), fingerprint(&read));
        assert_eq!(read.means()[70], model.means()[71]);
        whole.apply(Step::OpacityMin(0.9999)).unwrap();
        assert_eq!(whole.count(), 0);
    }
}
