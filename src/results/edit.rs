//! Changes of a model: transforms, crops, merges, and the removal of floaters.
//!
//! Operations apply in the given order. Those that measure the photographs do so in the dataset's world, wherever the
//! model was moved to before. The same model, operations and dataset give the same bits.

mod capture;
mod evidence;

use std::fmt::Write as _;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use glam::DVec3;
use nightsplat_core::camera::enclosing_sphere;
use nightsplat_core::output::{create_folder_of, is_same_file, write_whole};
use nightsplat_core::ply::PlyHeader;
use nightsplat_models::edit::content::Content;
use nightsplat_models::edit::floaters::{self, CameraPositions, Floaters};
use nightsplat_models::edit::operation::{EditList, Operation, Region, Scale, Span, fingerprint};
use nightsplat_models::edit::placement::Placement;
use nightsplat_models::edit::step::Step;
use nightsplat_models::export::{EDITS, Format, Provenance};
use nightsplat_models::gaussians::ply::parts::PART;
use nightsplat_models::gaussians::{Features, Gaussians, ModelFacts, Shape, is_far};
use nightsplat_photographs::tree::check_writable;

use self::capture::ModelPhotographs;
use self::evidence::Measured;
use crate::results::eval::ScoreReference;
use crate::results::finished_run::{Opener, is_model};
use crate::results::{models, run};
use crate::{Error, Result};

/// The rendered weight, in pixels over all training views, from which a Gaussian is shown by them.
const SHOWN: f64 = 0.01;

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
    /// What the test views are scored against, and their PSNR before the first operation that changes renders.
    score: Option<(ScoreReference, f64)>,
}

/// The PSNR of the test views, dB.
pub(crate) struct EditScore {
    pub(crate) before: f64,
    pub(crate) after: f64,
    /// What they are scored against.
    pub(crate) against: &'static str,
}

impl Editor {
    /// Opens a run or a model file.
    pub(crate) fn open(path: &Path, dataset: Option<&Path>, opener: Opener) -> Result<Self> {
        let (content, facts) = match models::open_parts(path, PART)? {
            Some((file, facts)) => (Content::of_file(path, file)?, facts),
            None => {
                let (gaussians, facts) = models::read(path)?;
                (Content::of_whole(gaussians), facts)
            }
        };
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
            score: None,
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

    /// Applies an operation and says in a line what it did. `observe` is called with the rounds that are done of a long
    /// one, and the most that it has.
    pub(crate) fn apply(
        &mut self,
        operation: &Operation,
        observe: &dyn Fn(usize, usize),
    ) -> Result<String> {
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
            Operation::Floaters => (self.remove_floaters(observe)?, operation.clone()),
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
                return self.apply(&Operation::Up(Some(up)), observe);
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
        let facts = self.facts.clone();
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

    /// The dataset that was named, or that of the run.
    pub(crate) fn dataset_folder(&self) -> Option<PathBuf> {
        let of_run = || Some(run::load_config(&self.path).ok()?.dataset);
        self.dataset.clone().or_else(of_run).filter(|folder| folder.is_dir())
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

    /// Scores the test views before an operation that changes renders, unless that is done, or no photograph tells what
    /// they are to look like.
    pub(crate) fn score_before(&mut self) -> Result<()> {
        if self.score.is_some() || (is_model(&self.path) && self.dataset.is_none()) {
            return Ok(());
        }
        if let Some(mut reference) = self.open_capture()?.score_reference()?
            && let Some(before) = self.psnr(&mut reference)?
        {
            self.score = Some((reference, before));
        }
        Ok(())
    }

    /// The score of the test views before and after all operations, if they were scored before.
    pub(crate) fn score(&mut self) -> Result<Option<EditScore>> {
        let Some((mut reference, before)) = self.score.take() else { return Ok(None) };
        let against = reference.against.name();
        let after = self.psnr(&mut reference)?;
        Ok(after.map(|after| EditScore { before, after, against }))
    }

    /// The mean PSNR of the test views, dB; `None` without any.
    fn psnr(&self, reference: &mut ScoreReference) -> Result<Option<f64>> {
        let run = (!is_model(&self.path)).then_some(&*self.path);
        let Some(capture) = &self.capture else { return Ok(None) };
        capture.psnr(run, &*self.content.whole()?, &self.facts, &self.placement, reference)
    }

    /// Removes floaters.
    fn remove_floaters(&mut self, observe: &dyn Fn(usize, usize)) -> Result<String> {
        self.open_capture()?;
        let (placement, facts) = (self.placement, &self.facts);
        let Some(capture) = &self.capture else { return Ok(String::new()) };
        let targets = capture.targets()?;
        let measured = |gaussians: &Gaussians| {
            Measured::new(capture, placement, gaussians, facts).evidence(&targets)
        };
        let gaussians = self.content.whole()?;
        let cameras = capture.cameras();
        let positions = cameras.iter().map(|camera| placement.camera(camera).center()).collect();
        let cameras = CameraPositions { positions, near: capture.near(facts, &placement) };
        let Floaters { keep, contradicted, unseen } =
            floaters::find(&gaussians, &cameras, measured, observe)?;
        let kept = retained("floaters", gaussians.into_owned(), &keep)?;
        self.content.set(kept);
        Ok(format!("floaters: {contradicted} contradicted, {unseen} unseen"))
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
        let sums =
            Measured::new(capture, self.placement, &gaussians, &self.facts).summed_weights()?;
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
        let name = match region {
            Region::Box(low, high) => format!("crop to the box from {low:.4} to {high:.4}"),
            Region::Sphere(center, radius) => {
                format!("crop to the sphere at {center:.4} of radius {radius:.4}")
            }
            Region::Cameras => return self.crop_to_cameras(),
        };
        self.step(&name, Step::Crop(*region))?;
        Ok((name, Operation::Crop(*region)))
    }

    /// Removes what is outside the sphere of the cameras and shown by no training view.
    fn crop_to_cameras(&mut self) -> Result<(String, Operation)> {
        let (center, radius) = enclosing_sphere(&self.open_capture()?.cameras());
        if radius == 0.0 {
            let problem = "crop cameras: all cameras stand in one place; give a box or a sphere";
            return Err(Error::Usage(problem.to_owned()));
        }
        let placement = self.placement;
        let (center, radius) = (placement.point(center), radius * placement.scale);
        let name =
            format!("crop to the sphere at {center:.4} of radius {radius:.4}, and what views show");
        let Some(capture) = &self.capture else { return Ok((name, Operation::Delete(vec![]))) };
        let gaussians = self.content.whole()?;
        let shown = Measured::new(capture, placement, &gaussians, &self.facts).summed_weights()?;
        let inside = Region::Sphere(center, radius);
        let keep = (0..gaussians.count)
            .map(|index| inside.contains(gaussians.position(index)) || shown[index] >= SHOWN);
        let keep: Vec<bool> = keep.collect();
        let kept = retained(&name, gaussians.into_owned(), &keep)?;
        self.content.set(kept);
        Ok((name, Operation::Delete(Span::of_false(&keep))))
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
        if facts.targets.is_some() && facts.targets != self.facts.targets {
            self.facts.targets = None;
        }
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
