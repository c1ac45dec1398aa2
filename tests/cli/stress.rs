//! Hostile inputs: whole training steps, every pass against its CPU reference in f64, and the outcome of each.
//!
//! The table is [`cases::CASES`]: an input, its outcome in words, and the expected outcome in a checkable form. A row
//! fails on any other outcome. The tests run a selection; the whole table, printed, is `cargo test --release --test cli
//! whole_table -- --ignored --nocapture`.

mod cases;
mod hostile;

use std::io::Write;
use std::ops::Range;

use nightsplat::gpu::CheckReport;
use nightsplat::reference::blend_forward::blend_pixel;
use nightsplat::reference::gaussian::Planes;
use nightsplat::reference::project::{ProjectionSettings, project_gaussian};
use nightsplat::{kernels, reference};
use nightsplat_core::camera::Patch;

use cases::{CASES, Case, Effort, Expect};
use hostile::Hostile;
use nightsplat_models::gaussians::ATTRIBUTES;

use crate::common::prelude::*;

/// Runs every second of the quick rows, so that the cores share them.
fn run_half(half: usize) {
    let quick = CASES.iter().filter(|case| case.effort == Effort::Quick);
    assert_as_expected(quick.skip(half).step_by(2).map(|case| case.run(&gpu())).collect());
}

fn assert_as_expected(rows: Vec<Row>) {
    let wrong: Vec<String> = rows
        .into_iter()
        .filter_map(|row| row.problem.map(|problem| format!("{}: {problem}", row.name)))
        .collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn hostile_inputs_have_the_outcomes_of_the_table() {
    run_half(0);
}

#[test]
fn other_hostile_inputs_have_the_outcomes_of_the_table() {
    run_half(1);
}

#[test]
#[ignore = "minutes: of `make stress`"]
fn all_hostile_inputs_have_the_outcomes_of_the_whole_table() {
    let mut rows = vec![];
    let mut out = std::io::stdout();
    writeln!(out, "input | view | Gaussians | error | of kernel | render | gradient | outcome")
        .unwrap();
    for case in CASES {
        let row = case.run(&gpu());
        writeln!(out, "{}", row.line()).unwrap();
        rows.push(row);
    }
    assert_as_expected(rows);
}

#[test]
fn every_input_of_the_table_is_named_once() {
    let mut names: Vec<_> = CASES.iter().map(|case| case.name).collect();
    names.sort_unstable();
    assert!(names.windows(2).all(|pair| pair[0] != pair[1]));
}

/// Number of Gaussians times pixels beyond which the whole render is not compared in f64, which evaluates all of them.
const MAX_FRAGMENTS: usize = 40_000_000;

/// The outcome of a case.
struct Row {
    name: &'static str,
    outcome: &'static str,
    /// Width and height of the view.
    size: [u32; 2],
    gaussians: usize,
    /// Of the last step.
    loss: Option<f64>,
    /// The kernel with the largest error in units of its rounding bound, and that error; `None` if nothing was
    /// compared.
    error: Option<(&'static str, f64)>,
    /// The largest difference between the render and that of the f64 references, relative to values above 1.
    render_error: Option<f64>,
    /// The largest gradient; infinite if one is not finite.
    gradient: Option<f64>,
    /// The actual outcome, if it is not the expected one.
    problem: Option<String>,
}

impl Row {
    /// The row in the format of docs/measurements.md.
    fn line(&self) -> String {
        let number =
            |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.1e}"));
        let (kernel, error) = self.error.unzip();
        let cells = [
            self.name.to_owned(),
            format!("{}x{}", self.size[0], self.size[1]),
            self.gaussians.to_string(),
            error.map_or("-".to_owned(), |error| format!("{error:.3}")),
            kernel.unwrap_or("-").to_owned(),
            number(self.render_error),
            number(self.gradient),
            self.problem.as_ref().map_or(self.outcome.to_owned(), |why| format!("WRONG: {why}")),
        ];
        cells.join(" | ")
    }
}

impl Case {
    /// Trains on it, with every pass checked, and inspects the outcome.
    fn run(&self, gpu: &Gpu) -> Row {
        let mut row = Row {
            name: self.name,
            outcome: self.outcome,
            size: [0; 2],
            gaussians: 0,
            loss: None,
            error: None,
            render_error: None,
            gradient: None,
            problem: None,
        };
        let came = (self.build)(gpu).and_then(|hostile| self.train(gpu, hostile, &mut row));
        row.problem = match (came, &self.expect) {
            (Ok(()), Expect::Refusal(_)) => Some("it was not refused".to_owned()),
            (Ok(()), _) => row.problem,
            (Err(error), Expect::Refusal(part)) if error.to_string().contains(part) => None,
            (Err(error), _) => Some(error.to_string()),
        };
        row
    }

    fn train(&self, gpu: &Gpu, hostile: Hostile, row: &mut Row) -> nightsplat::Result<()> {
        let Hostile { dataset, gaussians, config, concerned, files: _files } = hostile;
        let camera = dataset.views[0].camera;
        row.size = [camera.width, camera.height];
        let is_checked = self.effort != Effort::Unchecked;
        let mut report = CheckReport::default();
        let mut checked = |work: &mut dyn FnMut() -> nightsplat::Result<()>| {
            if !is_checked {
                return work();
            }
            let (done, passes) = gpu.checked(work);
            report.extend(passes);
            done
        };
        let mut begun = None;
        checked(&mut || {
            begun = Some(match &gaussians {
                Some(gaussians) => {
                    Trainer::from_gaussians(gpu, config.clone(), &dataset, gaussians)?
                }
                None => Trainer::new(gpu, config.clone(), &dataset)?,
            });
            Ok(())
        })?;
        let Some(mut trainer) = begun else { return Ok(()) };
        let before = trainer.gaussians_in_frame()?;
        row.gaussians = before.count;
        // A step that overflows its memory is repeated.
        while trainer.steps_done() < config.steps {
            let next = trainer.steps_done() + 1;
            checked(&mut || {
                let reports = trainer.advance(next)?;
                row.loss = reports.last().map(|report| report.loss).or(row.loss);
                Ok(())
            })?;
        }
        let after = trainer.gaussians_in_frame()?;
        let gradients = trainer.gradients()?;
        let largest = |values: &[f32]| {
            // Written so that a NaN counts as infinity.
            let magnitude = |value: &f32| {
                if value.is_finite() { f64::from(value.abs()) } else { f64::INFINITY }
            };
            values.iter().map(magnitude).fold(0.0, f64::max)
        };
        row.gradient = Some(largest(&gradients.parameters));
        let worst = report.kernels().into_iter().max_by(|a, b| a.2.total_cmp(&b.2));
        row.error = worst.map(|(kernel, _, error)| (kernel, error));
        row.render_error = render_error(&mut trainer, &config, &camera, &after)?;
        let of_concerned = |gaussians: &Gaussians| of_gaussians(gaussians, &concerned);
        row.problem = if let Some(difference) = report.first_difference() {
            Some(difference.to_string())
        } else if !row.loss.is_some_and(f64::is_finite) {
            Some(format!("the loss is {:?}", row.loss))
        } else if !row.gradient.is_some_and(f64::is_finite) {
            Some("a gradient is not finite".to_owned())
        } else if !largest(&after.parameters).is_finite() && largest(&before.parameters).is_finite()
        {
            Some("a parameter became what is not finite".to_owned())
        } else if !row.render_error.is_none_or(|error| error <= MAX_RENDER_ERROR) {
            Some(format!("the render is off by {:?}", row.render_error))
        } else {
            match self.expect {
                Expect::NoTrace if largest(&of_concerned(&gradients)) > 0.0 => {
                    Some("it leaves a gradient".to_owned())
                }
                Expect::NoTrace if of_concerned(&before) != of_concerned(&after) => {
                    Some("it moves".to_owned())
                }
                Expect::Learns if largest(&of_concerned(&gradients)) == 0.0 => {
                    Some("it has no gradient".to_owned())
                }
                _ => None,
            }
        };
        Ok(())
    }
}

/// A splat whose alpha is close to 1/255 may count or not, and there may be two.
const MAX_RENDER_ERROR: f64 = 2.0 / 255.0;

/// Every parameter of some Gaussians.
fn of_gaussians(gaussians: &Gaussians, wanted: &Range<usize>) -> Vec<f32> {
    let planes = ATTRIBUTES.iter().map(|spec| gaussians.plane(spec.attribute));
    let selected = planes.flat_map(|plane| {
        let width = plane.len() / gaussians.count.max(1);
        &gaussians.parameters[plane.start + wanted.start * width..][..wanted.len() * width]
    });
    selected.copied().collect()
}

/// The largest difference between the trainer's render and that of the references in f64, without tiles; `None` if that
/// takes too long.
fn render_error(
    trainer: &mut Trainer,
    config: &TrainConfig,
    camera: &Camera,
    gaussians: &Gaussians,
) -> nightsplat::Result<Option<f64>> {
    let pixels = camera.width as usize * camera.height as usize;
    if gaussians.count * pixels > MAX_FRAGMENTS {
        return Ok(None);
    }
    let render = trainer.render(camera)?.colors;
    let settings = config.render_settings();
    let sh_degree = config.schedule.sh_degree(config.steps, config.sh_degree);
    let camera =
        reference::camera::ReferenceCamera::from(&kernels::Camera::from(&Patch::from(camera)));
    let Gaussians { count, shape, .. } = *gaussians;
    let planes =
        Planes { count, feature_count: 0, sh_degree: shape.sh_degree, rest_by_column: false };
    let (near, alpha_max) = (settings.near.into(), settings.max_alpha.into());
    let project = |i| {
        let gaussian = planes.load(&gaussians.parameters, i);
        let RenderSettings { raw_colors, antialiased, .. } = settings;
        let projection =
            ProjectionSettings { near, sh_degree, raw_colors, antialiased, lamp: None };
        project_gaussian(&camera, projection, &gaussian)
    };
    let mut seen: Vec<_> = (0..count).filter_map(project).collect();
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let colors: Vec<f64> = seen.iter().flat_map(|seen| seen.color.to_array()).collect();
    let splats: Vec<_> = seen.into_iter().map(|seen| seen.splat).collect();
    let mut largest: f64 = 0.0;
    for (y, x) in (0..render.height).flat_map(|y| (0..render.width).map(move |x| (y, x))) {
        let center = DVec2::new(x.into(), y.into()) + 0.5;
        let (expected, _) = blend_pixel(&splats, &colors, &[0.0; 3], center, alpha_max);
        for (actual, expected) in render.pixel(x, y).into_iter().zip(expected) {
            let error = (f64::from(actual) - expected).abs() / expected.abs().max(1.0);
            // Written so that a NaN is not a small error.
            largest = if error <= largest { largest } else { error };
        }
    }
    Ok(Some(largest))
}
