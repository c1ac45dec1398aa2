//! What the points came to: scores, costs, who is on the front, and what each change of the base costs and gains.

use serde_json::{Map, Value, json};

use super::knobs::BASE;
use crate::base::output::csv_field;
use crate::cli::batch::Run;
use crate::cli::batch::csv::number;
use crate::cli::batch::point::{PRESET, Point, SEED};
use crate::cli::batch::sample::{deviation, mean};
use crate::results::report::{Best, Column, Table};
use crate::results::run::{Progress, load_progress};

/// A figure of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Measure {
    Psnr,
    ChannelMean,
    Ssim,
    Seconds,
    ProcessorSeconds,
    Joules,
    Steps,
    Gaussians,
    DeviceBytes,
    HostBytes,
}

impl Measure {
    pub(super) const ALL: [Self; 10] = [
        Self::Psnr,
        Self::ChannelMean,
        Self::Ssim,
        Self::Seconds,
        Self::ProcessorSeconds,
        Self::Joules,
        Self::Steps,
        Self::Gaussians,
        Self::DeviceBytes,
        Self::HostBytes,
    ];

    /// Its column in CSV and JSON, its place in `metrics.json`, its heading, and the digits shown.
    fn row(self) -> (&'static str, &'static str, &'static str, usize) {
        match self {
            Self::Psnr => ("psnr", "/mean/psnr", "PSNR, dB", 2),
            Self::ChannelMean => {
                ("psnr_channel_mean", "/mean/psnr_channel_mean", "channel-mean PSNR, dB", 2)
            }
            Self::Ssim => ("ssim", "/mean/ssim", "SSIM", 3),
            Self::Seconds => ("seconds", "/seconds", "time, s", 1),
            Self::ProcessorSeconds => {
                ("processor_seconds", "/spent/processor_seconds", "processor time, s", 1)
            }
            Self::Joules => ("joules", "/spent/joules", "energy, J", 0),
            Self::Steps => ("steps", "/steps", "steps", 0),
            Self::Gaussians => ("gaussians", "/gaussians", "Gaussians", 0),
            Self::DeviceBytes => ("device_bytes", "/spent/device_bytes", "device, MiB", 1),
            Self::HostBytes => ("host_bytes", "/spent/host_bytes", "host, MiB", 0),
        }
    }

    pub(super) fn name(self) -> &'static str {
        self.row().2
    }

    /// A value as tables and plots show it.
    pub(super) fn shown(self, value: f64) -> f64 {
        let is_memory = matches!(self, Self::DeviceBytes | Self::HostBytes);
        if is_memory { value / f64::from(1 << 20) } else { value }
    }

    fn column(self, best: Best) -> Column {
        let (_, _, name, digits) = self.row();
        Column { name: name.to_owned(), digits, best }
    }
}

/// The finished runs of a point, over their seeds.
#[derive(Clone, Debug)]
pub(super) struct Outcome {
    /// The point without its seed.
    pub(super) point: Point,
    /// Of the first run that finished.
    pub(super) progress: Vec<Progress>,
    /// Of every finished run.
    metrics: Vec<Value>,
}

impl Outcome {
    /// Reads what the finished ones of `runs` came to; a point without any is there too.
    pub(super) fn all(runs: &[Run]) -> Vec<Self> {
        let mut outcomes: Vec<Self> = vec![];
        for run in runs {
            let mut point = run.point.clone();
            point.values.retain(|(key, _)| key != SEED);
            let index = outcomes.iter().position(|one| one.point == point).unwrap_or_else(|| {
                outcomes.push(Self { point, progress: vec![], metrics: vec![] });
                outcomes.len() - 1
            });
            let Some(metrics) = run.metrics() else { continue };
            let outcome = &mut outcomes[index];
            if outcome.metrics.is_empty() {
                outcome.progress = load_progress(&run.folder);
            }
            outcome.metrics.push(metrics);
        }
        outcomes
    }

    pub(super) fn preset(&self) -> &str {
        self.point.value(PRESET).unwrap_or_default()
    }

    /// The setting that differs from the base's, and its value; none for a preset.
    pub(super) fn knob(&self) -> Option<(&str, &str)> {
        let mut others = self.point.values.iter().filter(|(key, _)| key != PRESET);
        others.next().map(|(key, value)| (key.as_str(), value.as_str()))
    }

    pub(super) fn is_base(&self) -> bool {
        self.preset() == BASE.name() && self.knob().is_none()
    }

    /// `fast`, or `steps = 500` for a change of the base.
    pub(super) fn name(&self) -> String {
        self.knob()
            .map_or_else(|| self.preset().to_owned(), |(key, value)| format!("{key} = {value}"))
    }

    pub(super) fn runs(&self) -> usize {
        self.metrics.len()
    }

    /// The mean over the seeds, in the unit of `metrics.json`.
    pub(super) fn mean(&self, of: Measure) -> Option<f64> {
        mean(&self.values(of))
    }

    fn deviation(&self, of: Measure) -> Option<f64> {
        deviation(&self.values(of))
    }

    fn values(&self, of: Measure) -> Vec<f64> {
        let (_, place, ..) = of.row();
        self.metrics.iter().filter_map(|metrics| metrics.pointer(place)?.as_f64()).collect()
    }
}

/// The indices of the points (cost, gain) that no other beats, the cheapest first: none is as cheap and as good but for one
/// that is just the same, of which the first is taken.
pub(super) fn front(points: &[(f64, f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len())
        .filter(|&index| points[index].0.is_finite() && points[index].1.is_finite())
        .collect();
    // Stable: of equals, the first stays first.
    order.sort_by(|&a, &b| {
        points[a].0.total_cmp(&points[b].0).then(points[b].1.total_cmp(&points[a].1))
    });
    let mut best = f64::NEG_INFINITY;
    order.retain(|&index| {
        let gains = points[index].1 > best;
        best = best.max(points[index].1);
        gains
    });
    order
}

/// The indices of the outcomes on the front of two measures.
pub(super) fn front_of(outcomes: &[Outcome], cost: Measure, gain: Measure) -> Vec<usize> {
    let point = |outcome: &Outcome| {
        let value = |of| outcome.mean(of).unwrap_or(f64::NAN);
        (value(cost), value(gain))
    };
    front(&outcomes.iter().map(point).collect::<Vec<_>>())
}

/// Every point with every figure, in order.
pub(super) fn table(outcomes: &[Outcome]) -> Table {
    let measures = measures(outcomes);
    let is_score =
        |measure: Measure| matches!(measure, Measure::Psnr | Measure::ChannelMean | Measure::Ssim);
    let has_seeds = outcomes.iter().any(|outcome| outcome.runs() > 1);
    let mut columns = vec![];
    for &measure in &measures {
        columns.push(measure.column(if is_score(measure) {
            Best::Greatest
        } else {
            Best::Unmarked
        }));
        if has_seeds && measure == Measure::Psnr {
            columns.push(Column { name: "sd".to_owned(), digits: 2, best: Best::Unmarked });
        }
    }
    let row = |(index, outcome): (usize, &Outcome)| {
        let mut values = vec![];
        for &measure in &measures {
            values.push(outcome.mean(measure).map(|value| measure.shown(value)));
            if has_seeds && measure == Measure::Psnr {
                values.push(outcome.deviation(measure));
            }
        }
        (format!("{}  {}", index + 1, outcome.name()), values)
    };
    Table {
        title: "Every run".to_owned(),
        label: "run".to_owned(),
        columns,
        rows: outcomes.iter().enumerate().map(row).collect(),
    }
}

/// The measures that any outcome has.
fn measures(outcomes: &[Outcome]) -> Vec<Measure> {
    let has = |measure: &Measure| outcomes.iter().any(|one| one.mean(*measure).is_some());
    Measure::ALL.into_iter().filter(has).collect()
}

/// What each change of the base gains and costs; none where there are no changes, or the base is not finished.
pub(super) fn marginal_table(outcomes: &[Outcome]) -> Option<Table> {
    let base = outcomes.iter().find(|outcome| outcome.is_base() && outcome.runs() > 0)?;
    let measures = measures(outcomes);
    let changed: Vec<&Outcome> =
        outcomes.iter().filter(|outcome| outcome.knob().is_some()).collect();
    let row = |outcome: &&Outcome| {
        let difference = |&of: &Measure| Some(of.shown(outcome.mean(of)? - base.mean(of)?));
        (outcome.name(), measures.iter().map(difference).collect())
    };
    let table = Table {
        title: format!("What each change of {} gains and costs: the difference to it", BASE.name()),
        label: "change".to_owned(),
        columns: measures.iter().map(|measure| measure.column(Best::Unmarked)).collect(),
        rows: changed.iter().map(row).collect(),
    };
    (!table.rows.is_empty()).then_some(table)
}

/// A line per point: what it is, the mean and the standard deviation of every figure, and whether it is on the fronts of
/// PSNR against time on the wall and on the processor.
pub(super) fn csv(outcomes: &[Outcome]) -> String {
    let mut header =
        vec!["preset".to_owned(), "knob".to_owned(), "value".to_owned(), "runs".to_owned()];
    for measure in Measure::ALL {
        let (key, ..) = measure.row();
        header.extend([key.to_owned(), format!("{key}_sd")]);
    }
    let fronts = FRONTS.map(|(name, cost)| {
        header.push(name.to_owned());
        front_of(outcomes, cost, Measure::Psnr)
    });
    let line = |(index, outcome): (usize, &Outcome)| {
        let (knob, value) = outcome.knob().unwrap_or_default();
        let mut cells = vec![
            csv_field(outcome.preset()),
            csv_field(knob),
            csv_field(value),
            outcome.runs().to_string(),
        ];
        for measure in Measure::ALL {
            cells.extend([number(outcome.mean(measure)), number(outcome.deviation(measure))]);
        }
        cells.extend(fronts.iter().map(|front| front.contains(&index).to_string()));
        cells.join(",")
    };
    let lines = std::iter::once(header.join(",")).chain(outcomes.iter().enumerate().map(line));
    lines.map(|line| line + "\n").collect()
}

/// The fronts of PSNR that CSV and JSON name.
const FRONTS: [(&str, Measure); 2] =
    [("on_front", Measure::Seconds), ("on_processor_front", Measure::ProcessorSeconds)];

/// A line per score on the way of the first run of each point.
pub(super) fn anytime_csv(outcomes: &[Outcome]) -> String {
    let mut text = "point,step,seconds,processor_seconds,joules,gaussians,psnr,ssim\n".to_owned();
    for outcome in outcomes {
        for Progress { step, seconds, processor_seconds, joules, gaussians, psnr, ssim, .. } in
            &outcome.progress
        {
            let (name, processor, joules) =
                (csv_field(&outcome.point.name()), number(*processor_seconds), number(*joules));
            text += &format!(
                "{name},{step},{seconds},{processor},{joules},{gaussians},{psnr},{ssim}\n"
            );
        }
    }
    text
}

/// The same as JSON, with the differences to the base.
pub(super) fn json(outcomes: &[Outcome]) -> Value {
    let base = outcomes.iter().find(|outcome| outcome.is_base());
    let fronts = FRONTS.map(|(name, cost)| (name, front_of(outcomes, cost, Measure::Psnr)));
    let of = |(index, outcome): (usize, &Outcome)| {
        let figures = |value: &dyn Fn(Measure) -> Option<f64>| {
            let of = |measure: Measure| (measure.row().0.to_owned(), json!(value(measure)));
            Measure::ALL.into_iter().map(of).collect::<Map<_, _>>()
        };
        let mut entry = json!({
            "preset": outcome.preset(),
            "knob": outcome.knob().map(|(key, _)| key),
            "value": outcome.knob().map(|(_, value)| value),
            "runs": outcome.runs(),
            "mean": figures(&|of| outcome.mean(of)),
        });
        if let Some(base) = base.filter(|_| outcome.knob().is_some()) {
            entry["difference"] = figures(&|of| Some(outcome.mean(of)? - base.mean(of)?)).into();
        }
        for (name, front) in &fronts {
            entry[*name] = front.contains(&index).into();
        }
        entry
    };
    outcomes.iter().enumerate().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_has_what_nothing_beats_the_cheapest_first() {
        let points =
            [(10.0, 24.0), (5.0, 22.0), (20.0, 23.9), (5.0, 21.0), (40.0, 26.0), (f64::NAN, 99.0)];
        assert_eq!(front(&points), [1, 0, 4]);
        assert_eq!(front(&[(1.0, 2.0), (1.0, 2.0)]), [0]);
        assert_eq!(front(&[(2.0, 2.0), (1.0, 2.0)]), [1]);
        assert!(front(&[]).is_empty());
    }

    fn outcome(values: &[(&str, &str)], scores: &[(f64, f64, f64)]) -> Outcome {
        let metrics = |&(psnr, seconds, bytes): &(f64, f64, f64)| {
            json!({"mean": {"psnr": psnr, "ssim": 0.5}, "seconds": seconds, "steps": 10, "gaussians": 7,
                "spent": {"processor_seconds": 2.0 * seconds, "joules": null, "device_bytes": bytes}})
        };
        let values = values.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        Outcome {
            point: Point { values: values.collect() },
            progress: vec![],
            metrics: scores.iter().map(metrics).collect(),
        }
    }

    fn outcomes() -> Vec<Outcome> {
        let mib = 1048576.0;
        vec![
            outcome(&[("preset", "fast")], &[(24.0, 10.0, mib)]),
            outcome(&[("preset", "balanced")], &[(25.0, 20.0, 3.0 * mib), (26.0, 40.0, 3.0 * mib)]),
            outcome(&[("preset", "balanced"), ("steps", "5")], &[(23.5, 15.0, 2.0 * mib)]),
            outcome(&[("preset", "balanced"), ("steps", "9")], &[]),
        ]
    }

    #[test]
    fn a_change_costs_and_gains_its_difference_to_the_base() {
        let table = marginal_table(&outcomes()).unwrap();
        let names: Vec<&str> = table.columns.iter().map(|column| column.name.as_str()).collect();
        let expected = [
            "PSNR, dB",
            "SSIM",
            "time, s",
            "processor time, s",
            "steps",
            "Gaussians",
            "device, MiB",
        ];
        assert_eq!(names, expected, "what nothing has is no column");
        let values = [-2.0, 0.0, -15.0, -30.0, 0.0, 0.0, -1.0].map(Some).to_vec();
        assert_eq!(table.rows[0], ("steps = 5".to_owned(), values));
        assert_eq!(table.rows[1], ("steps = 9".to_owned(), vec![None; 7]));
        let mut lost = outcomes();
        lost[1].metrics.clear();
        assert!(marginal_table(&lost).is_none(), "there is nothing to differ from");
    }

    #[test]
    fn the_files_have_a_line_per_point_with_means_spreads_and_fronts() {
        let csv = csv(&outcomes());
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(
            lines[0],
            "preset,knob,value,runs,psnr,psnr_sd,psnr_channel_mean,psnr_channel_mean_sd,ssim,ssim_sd,seconds,seconds_sd,\
             processor_seconds,processor_seconds_sd,joules,joules_sd,steps,steps_sd,gaussians,gaussians_sd,device_bytes,\
             device_bytes_sd,host_bytes,host_bytes_sd,on_front,on_processor_front"
        );
        assert!(lines[1].starts_with("fast,,,1,24,,,,0.5,,10,,20,,"), "{csv}");
        assert!(
            lines[2].starts_with("balanced,,,2,25.5,0.7071") && lines[2].ends_with("true,true"),
            "{csv}"
        );
        assert!(
            lines[3].starts_with("balanced,steps,5,1,23.5") && lines[3].ends_with("false,false"),
            "{csv}"
        );
        let json = json(&outcomes());
        assert_eq!(json[2]["difference"]["psnr"], -2.0);
        assert_eq!((&json[0]["on_front"], &json[0]["difference"]), (&json!(true), &Value::Null));
        let table = table(&outcomes());
        assert_eq!(
            (table.rows[2].0.as_str(), table.columns[1].name.as_str()),
            ("3  steps = 5", "sd")
        );
    }
}
