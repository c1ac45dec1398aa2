//! Changes of a model: transforms, crops, merges, and the removal of floaters.
//!
//! Operations apply in the given order. Those that measure the photographs do so in the dataset's world, wherever the
//! model was moved to before. The same model, operations and dataset give the same bits.

mod capture;
mod content;
mod evidence;
mod floaters;
mod operation;
mod placement;
mod step;

use std::fmt::Write as _;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use glam::DVec3;
use nightsplat_core::camera::enclosing_sphere;
use nightsplat_core::output::{create_folder_of, is_same_file, write_whole};
use nightsplat_core::ply::PlyHeader;
use nightsplat_photographs::tree::check_writable;

use self::capture::ModelPhotographs;
use self::content::Content;
use self::evidence::Measured;
use self::floaters::{CameraPositions, Floaters};
use self::placement::Placement;
use self::step::Step;
use crate::results::export::{EDITS, Format, Provenance};
use crate::results::finished_run::{Opener, is_model};
use crate::results::{models, run};
use crate::splats::scene::{Features, Gaussians, ModelFacts, Shape, is_far};
use crate::{Error, Result};
pub(crate) use operation::{EditList, Operation, Region, Scale, fingerprint};

/// A model while it is edited.
pub(crate) struct Editor {
    /// The model file or run.
    path: PathBuf,
    /// The dataset, if it is not the run's.
    dataset: Option<PathBuf>,
    opener: Opener,
    content: Content,
    facts: ModelFacts,
    /// Identifies the model as it was opened.
    fingerprint: String,
    placement: Placement,
    /// Opened by the first operation that needs it.
    capture: Option<ModelPhotographs>,
    /// The operations so far, with numbers in place of what they were measured from.
    done: Vec<Operation>,
    /// The edit lists in the header of the file.
    earlier: Vec<String>,
}

impl Editor {
    /// Opens a run or a model file.
    pub(crate) fn open(path: &Path, dataset: Option<&Path>, opener: Opener) -> Result<Self> {
        let (content, facts) = Content::open(path)?;
        Ok(Self {
            path: path.to_owned(),
            dataset: dataset.map(Path::to_owned),
            opener,
            fingerprint: content.fingerprint()?,
            content,
            facts,
            placement: Placement::IDENTITY,
            capture: None,
            done: vec![],
            earlier: earlier_edits(path),
        })
    }

    /// Refuses an output that is the model itself, has no extension of a model, or cannot be written.
    pub(crate) fn check_output(model: &Path, out: &Path) -> Result<()> {
        Format::from_path(out)?;
        if is_same_file(out, model) || is_same_file(out, &model.join("model.ply")) {
            return Err(Error::output(out, "is the model itself; name another file with --out"));
        }
        check_writable(out)
    }

    /// Refuses an edit list that was made for another model.
    pub(crate) fn check_list(&self, path: &Path, list: &EditList) -> Result<()> {
        if list.model == self.fingerprint {
            return Ok(());
        }
        let (ours, other) = (&self.fingerprint, &list.model);
        let model = self.path.display();
        let problem = format!(
            "is an edit list of another model, {other}; {model} is {ours}: apply it to its own, or change `model`"
        );
        Err(Error::input(path, problem))
    }

    /// Applies an operation and says in a line what it did.
    pub(crate) fn apply(&mut self, operation: &Operation) -> Result<String> {
        operation.check().map_err(Error::Usage)?;
        if operation.needs_dataset() {
            self.open_capture()?;
        }
        let before = self.content.count();
        let (line, done) = match operation {
            Operation::Crop(region) => self.crop(region)?,
            Operation::Delete(spans) => {
                self.step("delete", Step::delete(spans, before)?)?;
                ("delete".to_owned(), operation.clone())
            }
            Operation::Floaters => (self.remove_floaters()?, operation.clone()),
            Operation::OpacityMin(least) => {
                self.step("opacity-min", Step::OpacityMin(*least))?;
                (format!("opacity-min {least}"), operation.clone())
            }
            Operation::MaxGaussians(count) => (self.keep_most(*count)?, operation.clone()),
            Operation::ShDegree(degree) => {
                self.content.apply(Step::ShDegree(*degree))?;
                (format!("sh-degree {degree}"), operation.clone())
            }
            Operation::Up(None) => {
                let up = self.up()?;
                return self.apply(&Operation::Up(Some(up)));
            }
            Operation::Up(_) | Operation::Rotate { .. } => self.rotate(operation)?,
            Operation::Scale(scale) => self.scale(scale)?,
            Operation::Move(by) => {
                let is_far = is_far(*by, self.content.none().origin, self.content.size()?);
                self.content.apply(Step::Move { by: *by, is_far })?;
                self.placement.translate(*by);
                (format!("move by {by}"), operation.clone())
            }
            Operation::Merge { file, hash } => self.merge(file, hash.as_deref())?,
        };
        self.done.push(done);
        let mut line = line;
        let count = self.content.count();
        // Writing to a string cannot fail.
        let _ = match count.cmp(&before) {
            std::cmp::Ordering::Less => {
                write!(line, ": {} of {before} Gaussians removed", before - count)
            }
            std::cmp::Ordering::Greater => {
                write!(line, ": {} Gaussians added to {before}", count - before)
            }
            std::cmp::Ordering::Equal => Ok(()),
        };
        Ok(line)
    }

    /// The operations so far, for the model as it was opened.
    pub(crate) fn list(&self) -> EditList {
        EditList::new(self.fingerprint.clone(), self.done.clone())
    }

    /// Writes the model in the format of the file's extension, with the edit list in its header, and says in a line
    /// what it has.
    pub(crate) fn save(&self, out: &Path) -> Result<String> {
        let (dataset, curve) = match is_model(&self.path) {
            true => Default::default(),
            false => {
                let config = run::load_config(&self.path)?;
                let name = config.dataset.file_name().unwrap_or_default();
                (name.to_string_lossy().into_owned(), config.tone.curve.to_string())
            }
        };
        let mut edits = self.earlier.clone();
        edits.push(self.list().line());
        let facts = self.facts;
        let provenance = Provenance { dataset, curve, facts, edits, ..Provenance::default() };
        create_folder_of(out)?;
        match Format::from_path(out)? {
            Format::Ply => self.content.save_ply(&provenance, out)?,
            format => format.write(&*self.content.whole()?, &provenance, out)?,
        }
        let (count, shape) = (self.content.count(), self.content.none().shape);
        Ok(format!("{}: {count} Gaussians, {shape}", out.display()))
    }

    /// Writes the edit list.
    pub(crate) fn save_list(&self, out: &Path) -> Result<()> {
        let mut list = self.list();
        for operation in &mut list.edits {
            if let Operation::Merge { file, .. } = operation {
                *file = std::path::absolute(&*file).unwrap_or_else(|_| file.clone());
            }
        }
        write_whole(out, list.text().as_bytes())
    }

    fn open_capture(&mut self) -> Result<&mut ModelPhotographs> {
        if self.capture.is_none() {
            let dataset = self.dataset.as_deref();
            self.capture = Some(ModelPhotographs::open(&self.path, dataset, &self.opener)?);
        }
        self.capture
            .as_mut()
            .ok_or_else(|| crate::results::finished_run::needs_photographs(&self.path))
    }

    /// Removes floaters, and says the held-out PSNR before and after.
    fn remove_floaters(&mut self) -> Result<String> {
        self.open_capture()?;
        let (placement, facts) = (self.placement, self.facts);
        let run = (!is_model(&self.path)).then(|| self.path.clone());
        let Some(capture) = &self.capture else { return Ok(String::new()) };
        let mut reference = capture.score_reference()?;
        let mut psnr = |gaussians: &Gaussians| {
            capture.psnr(run.as_deref(), gaussians, &facts, &placement, &mut reference)
        };
        let measured = |gaussians: &Gaussians| Measured::new(capture, placement, gaussians, &facts);
        let gaussians = self.content.whole()?;
        let before = psnr(&gaussians)?;
        let cameras = capture.cameras();
        let positions = cameras.iter().map(|camera| placement.camera(camera).center()).collect();
        let cameras = CameraPositions { positions, near: capture.near(&facts, &placement) };
        let Floaters { keep, contradicted, unseen } =
            floaters::find(&gaussians, &capture.targets()?, &cameras, measured)?;
        let kept = retained("floaters", gaussians.into_owned(), &keep)?;
        let after = psnr(&kept)?;
        self.content.set(kept);
        let scores = before.zip(after).map(|(before, after)| {
            format!("; held-out PSNR {before:.3} dB before, {after:.3} dB after")
        });
        let scores = scores.unwrap_or_default();
        Ok(format!("floaters: {contradicted} contradicted, {unseen} unseen{scores}"))
    }

    /// Keeps the Gaussians with the largest rendered weight over the training views; of equal ones the first.
    fn keep_most(&mut self, count: usize) -> Result<String> {
        let name = format!("max-gaussians {count}");
        if count >= self.content.count() {
            return Ok(name);
        }
        self.open_capture()?;
        let Some(capture) = &self.capture else { return Ok(name) };
        let gaussians = self.content.whole()?;
        let mut sums = vec![0.0; gaussians.count];
        Measured::new(capture, self.placement, &gaussians, &self.facts).weights(|weights| {
            sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight);
        })?;
        let mut order: Vec<usize> = (0..sums.len()).collect();
        order.sort_by(|&a, &b| sums[b].total_cmp(&sums[a]));
        let mut keep = vec![false; sums.len()];
        order[..count].iter().for_each(|&index| keep[index] = true);
        let kept = retained(&name, gaussians.into_owned(), &keep)?;
        self.content.set(kept);
        Ok(name)
    }

    /// Takes a step, unless it leaves nothing.
    fn step(&mut self, what: &str, step: Step) -> Result<()> {
        let before = self.content.count();
        self.content.apply(step)?;
        if self.content.count() == 0 { Err(leaves_nothing(what, before)) } else { Ok(()) }
    }

    fn crop(&mut self, region: &Region) -> Result<(String, Operation)> {
        let region = match region {
            Region::Cameras => {
                let cameras = self.open_capture()?.cameras();
                let (center, radius) = enclosing_sphere(&cameras);
                if radius == 0.0 {
                    let problem =
                        "crop cameras: all cameras stand in one place; give a box or a sphere";
                    return Err(Error::Usage(problem.to_owned()));
                }
                Region::Sphere(self.placement.point(center), radius * self.placement.scale)
            }
            region => *region,
        };
        let name = match region {
            Region::Box(low, high) => format!("crop to the box from {low:.3} to {high:.3}"),
            Region::Sphere(center, radius) => {
                format!("crop to the sphere at {center:.3} of radius {radius:.3}")
            }
            Region::Cameras => "crop".to_owned(),
        };
        self.step(&name, Step::Crop(region))?;
        Ok((name, Operation::Crop(region)))
    }

    /// The up direction of the photographs, in the edited world.
    fn up(&mut self) -> Result<DVec3> {
        let recorded = match is_model(&self.path) {
            true => None,
            false => {
                run::load_config(&self.path)?.up.and_then(|up| DVec3::from(up).try_normalize())
            }
        };
        let up = match recorded {
            Some(up) => up,
            None => self.open_capture()?.dataset.up(),
        };
        Ok(self.placement.rotation * up)
    }

    fn rotate(&mut self, operation: &Operation) -> Result<(String, Operation)> {
        let rotation = operation.rotation().unwrap_or_default();
        self.content.apply(Step::Rotate(rotation))?;
        self.placement.rotate(rotation);
        let (axis, angle) = rotation.to_axis_angle();
        let name = if matches!(operation, Operation::Up(_)) { "up" } else { "rotate" };
        let line = format!("{name}: turned by {:.3} degrees about {axis:.4}", angle.to_degrees());
        Ok((line, operation.clone()))
    }

    fn scale(&mut self, scale: &Scale) -> Result<(String, Operation)> {
        let (factor, note) = match (scale.factor().map_err(Error::Usage)?, scale) {
            (None, Scale::Cameras(table)) => {
                let (placement, capture) = (self.placement, self.open_capture()?);
                let (factor, note) = capture.metres_per_unit(table)?;
                (factor / placement.scale, note)
            }
            (factor, _) => (factor.unwrap_or(1.0), String::new()),
        };
        let done = Scale::Factor(factor);
        done.factor().map_err(Error::Usage)?;
        self.content.apply(Step::Scale(factor))?;
        self.placement.scale(factor);
        if let Some(near) = &mut self.facts.near {
            *near = (f64::from(*near) * factor) as f32;
        }
        Ok((format!("scale by {factor}{note}"), Operation::Scale(done)))
    }

    fn merge(&mut self, file: &Path, hash: Option<&str>) -> Result<(String, Operation)> {
        let (mut other, facts) = models::read(file)?;
        let refused = |problem: String| Err(Error::input(file, problem));
        let fingerprint = fingerprint(&other);
        if let Some(stated) = hash.filter(|stated| *stated != fingerprint) {
            return refused(format!("is model {fingerprint}, not {stated} as the edit list says"));
        }
        let appearance = |facts: &ModelFacts| {
            let defaults = crate::splats::render::RenderSettings::default();
            let raw_colors = facts.raw_colors.unwrap_or(defaults.raw_colors);
            (raw_colors, facts.max_alpha.unwrap_or(defaults.max_alpha), facts.antialiased)
        };
        if appearance(&facts) != appearance(&self.facts) {
            let problem = "renders with other colours, alpha limit or antialiasing than the model; train both alike";
            return refused(problem.to_owned());
        }
        self.facts.law = self.facts.law.filter(|law| facts.law == Some(*law));
        let mut merged = self.content.whole()?.into_owned();
        if other.shape.features != merged.shape.features {
            tracing::warn!("{}: has other features; those of both are dropped", file.display());
            merged = merged.with_features(Features::NONE);
            other = other.with_features(Features::NONE);
        }
        let degree = |gaussians: &Gaussians| gaussians.shape.sh_degree;
        let degree = degree(&other).max(degree(&merged));
        for gaussians in [&mut other, &mut merged] {
            if gaussians.shape != (Shape { sh_degree: degree, ..gaussians.shape }) {
                *gaussians = gaussians.with_sh_degree(degree);
            }
        }
        merged.append(&other);
        self.content.set(merged);
        let line = format!("merge {}", file.display());
        Ok((line, Operation::Merge { file: file.to_owned(), hash: Some(fingerprint) }))
    }
}

/// The Gaussians of a model that stay.
fn retained(what: &str, mut gaussians: Gaussians, keep: &[bool]) -> Result<Gaussians> {
    let before = gaussians.count;
    gaussians.retain(keep);
    if gaussians.count == 0 { Err(leaves_nothing(what, before)) } else { Ok(gaussians) }
}

fn leaves_nothing(what: &str, count: usize) -> Error {
    Error::Usage(format!("{what} leaves none of {count} Gaussians"))
}

/// The edit lists in the header of a PLY, oldest first.
fn earlier_edits(path: &Path) -> Vec<String> {
    /// A longer header is not read.
    const LONGEST: u64 = 1 << 22;
    let path = if path.is_dir() { path.join("model.ply") } else { path.to_owned() };
    let mut bytes = vec![];
    let read = File::open(path).and_then(|file| file.take(LONGEST).read_to_end(&mut bytes));
    let header = read.ok().and_then(|_| PlyHeader::parse(&bytes).ok());
    let comments = header.into_iter().flat_map(|header| header.comments);
    let list = |(_, comment): (usize, String)| {
        Some(comment.strip_prefix(EDITS)?.strip_prefix(": ")?.to_owned())
    };
    comments.filter_map(list).collect()
}
