//! `--growth`: how time and memory grow with Gaussians, pixels and channels.

use std::io::Write;

use anyhow::Result;
use serde_json::{Value, json};

use super::scene::{self, Scene};
use super::tune::Pass;
use super::{Bench, table, total};
use crate::Error;
use crate::photographs::tone::ToneCurve;
use crate::splats::render::{RenderSettings, Renderer};
use crate::splats::scene::{Features, MAX_SH_DEGREE, Shape};

/// Gaussians, in those that are asked for: 10 000 to 500 000 at the default.
const GAUSSIANS: [f64; 5] = [0.5, 1.5, 5.0, 12.5, 25.0];

/// Pixels, in those of the view that is asked for: 0.1 to 8 million at the default.
const PIXELS: [f64; 6] = [0.5, 1.5, 5.0, 10.0, 20.0, 40.0];

/// 3 to 11 channels, a feature more each time.
const CHANNELS: [Features; 5] = [
    Features::NONE,
    Features { depth: true, ..Features::NONE },
    Features { depth: true, structure: true, ..Features::NONE },
    Features { illumination: false, ..Features::ALL },
    Features::ALL,
];

/// What one quantity does while the others stay.
struct Axis {
    quantity: &'static str,
    /// What was timed.
    of: &'static str,
    points: Vec<Point>,
}

/// One value of the quantity.
struct Point {
    value: f64,
    /// Milliseconds on the device, the least of the runs, and the most bytes of device memory; or why it does not fit.
    measured: Result<(f64, u64), String>,
}

/// Measures every axis and prints it.
///
/// # Errors
/// The device gives no timestamps or is lost.
pub(super) fn run(bench: &Bench, size: [u32; 2], gaussians: usize, as_json: bool) -> Result<()> {
    let grown = |by: f64| size.map(|side| (f64::from(side) * by.sqrt()).round() as u32);
    let count = |by: f64| ((gaussians as f64 * by).round() as usize).max(1);
    let axes = [
        Axis::of("Gaussians", "step", &GAUSSIANS, |by| {
            (count(by) as f64, step(bench, size, count(by)))
        })?,
        Axis::of("pixels", "step", &PIXELS, |by| {
            let [width, height] = grown(by);
            (f64::from(width) * f64::from(height), step(bench, [width, height], gaussians))
        })?,
        Axis::of("channels", "rasteriser", &CHANNELS, |features| {
            (features.channels() as f64, rasteriser(bench, size, gaussians, features))
        })?,
    ];
    let mut out = std::io::stdout().lock();
    if as_json {
        let properties = bench.gpu.properties();
        let report = json!({
            "device": properties.name,
            "driver": properties.driver,
            "width": size[0],
            "height": size[1],
            "gaussians": gaussians,
            "axes": axes.iter().map(Axis::as_json).collect::<Vec<_>>(),
        });
        writeln!(out, "{report:#}")?;
        return Ok(());
    }
    let [width, height] = size;
    writeln!(out, "where they stay: {width}x{height} pixels, {gaussians} Gaussians, 3 channels\n")?;
    for axis in &axes {
        writeln!(out, "{}", axis.as_text())?;
    }
    Ok(())
}

/// A training step of the plain model.
fn step(bench: &Bench, [width, height]: [u32; 2], gaussians: usize) -> crate::Result<(f64, u64)> {
    bench.gpu.reset_peak_memory();
    let scene = Scene::new(width, height, gaussians);
    let mut trainer = scene::plain(&bench.gpu, &scene, ToneCurve::Ap3)?;
    let milliseconds = bench.least(|| Ok(total(&trainer.profile_step()?)))?;
    Ok((milliseconds, bench.gpu.peak_memory()))
}

/// The rasteriser, there and back: the channels of a render reach no further, but for the parts that ask for them.
fn rasteriser(
    bench: &Bench,
    [width, height]: [u32; 2],
    gaussians: usize,
    features: Features,
) -> crate::Result<(f64, u64)> {
    bench.gpu.reset_peak_memory();
    let shape = Shape { sh_degree: MAX_SH_DEGREE, features };
    let camera = scene::camera(width, height);
    let on_device = scene::gaussians(&camera, gaussians, shape).upload(&bench.gpu)?;
    let settings = RenderSettings { shape, ..RenderSettings::default() };
    let mut renderer = Renderer::new(&bench.gpu, settings)?;
    renderer.reserve(gaussians, [&camera])?;
    renderer.render_channels(&on_device, &camera, &super::tune::OPTIONS)?;
    let mut pass = Pass::new(bench, camera, on_device)?;
    let milliseconds = bench.least(|| Ok(pass.profile(bench, &mut renderer)?[2]))?;
    Ok((milliseconds, bench.gpu.peak_memory()))
}

impl Axis {
    /// Measures each point; one that the device cannot hold says so.
    fn of<T: Copy>(
        quantity: &'static str,
        of: &'static str,
        points: &[T],
        measure: impl Fn(T) -> (f64, crate::Result<(f64, u64)>),
    ) -> crate::Result<Self> {
        let point = |&point: &T| {
            let (value, measured) = measure(point);
            let measured = match measured {
                Ok(measured) => Ok(measured),
                Err(
                    error @ (Error::OutOfMemory { .. }
                    | Error::BufferTooLarge { .. }
                    | Error::Crowded { .. }
                    | Error::Usage(_)),
                ) => Err(error.to_string()),
                Err(error) => return Err(error),
            };
            Ok(Point { value, measured })
        };
        let points = points.iter().map(point).collect::<crate::Result<_>>()?;
        Ok(Self { quantity, of, points })
    }

    /// The values that fit, with their milliseconds and bytes.
    fn fitting(&self) -> impl Iterator<Item = (f64, f64, u64)> + '_ {
        let measured = |point: &Point| {
            let (milliseconds, bytes) = *point.measured.as_ref().ok()?;
            Some((point.value, milliseconds, bytes))
        };
        self.points.iter().filter_map(measured)
    }

    /// p of the fit c x^p to the milliseconds and to the bytes.
    fn exponents(&self) -> [Option<f64>; 2] {
        [
            exponent(self.fitting().map(|(value, milliseconds, _)| [value, milliseconds])),
            exponent(self.fitting().map(|(value, _, bytes)| [value, bytes as f64])),
        ]
    }

    fn as_json(&self) -> Value {
        let [time, memory] = self.exponents();
        let point = |point: &Point| match &point.measured {
            Ok((milliseconds, bytes)) => {
                json!({ "value": point.value, "ms": milliseconds, "bytes": bytes })
            }
            Err(why) => json!({ "value": point.value, "does_not_fit": why }),
        };
        json!({
            "quantity": self.quantity,
            "timed": self.of,
            "points": self.points.iter().map(point).collect::<Vec<_>>(),
            "time_exponent": time,
            "memory_exponent": memory,
        })
    }

    fn as_text(&self) -> String {
        let head = [self.quantity, &format!("{}, ms", self.of), "memory, MB"].map(str::to_owned);
        let row = |point: &Point| match &point.measured {
            Ok((milliseconds, bytes)) => vec![
                point.value.to_string(),
                format!("{milliseconds:.2}"),
                format!("{:.1}", *bytes as f64 / 1e6),
            ],
            Err(why) => vec![point.value.to_string(), why.clone()],
        };
        let shown = |exponent: Option<f64>| exponent.map_or("-".to_owned(), |p| format!("{p:.2}"));
        let [time, memory] = self.exponents().map(shown);
        let mut rows = vec![head.to_vec()];
        rows.extend(self.points.iter().map(row));
        rows.push(vec!["exponent".to_owned(), time, memory]);
        table::aligned(&rows)
    }
}

/// The slope of a line through the logarithms, by least squares; none of fewer than two different values.
fn exponent(points: impl Iterator<Item = [f64; 2]>) -> Option<f64> {
    let logs: Vec<[f64; 2]> = points.map(|point| point.map(f64::ln)).collect();
    let mean = |of: usize| logs.iter().map(|log| log[of]).sum::<f64>() / logs.len() as f64;
    let [x, y] = [mean(0), mean(1)];
    let across: f64 = logs.iter().map(|log| (log[0] - x) * (log[1] - y)).sum();
    let along: f64 = logs.iter().map(|log| (log[0] - x).powi(2)).sum();
    Some(across / along).filter(|slope| slope.is_finite())
}

#[cfg(test)]
mod tests {
    use super::exponent;

    #[test]
    fn the_exponent_of_a_power_is_found_and_one_point_has_none() {
        let power = [1.0, 3.0, 10.0].map(|x: f64| [x, 5.0 * x.powf(1.25)]);
        assert!((exponent(power.into_iter()).unwrap_or_default() - 1.25).abs() < 1e-12);
        assert_eq!(exponent([[2.0, 3.0]].into_iter()), None);
        assert_eq!(exponent([].into_iter()), None);
    }
}
