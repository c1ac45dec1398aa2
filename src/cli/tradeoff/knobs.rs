//! What is compared: presets, and variations of one setting around the balanced one.

use crate::cli::batch::point::{Axis, PRESET, Point, SEED};
use crate::train::Preset;
use crate::{Error, Result};

/// The preset that settings are varied around.
pub(super) const BASE: Preset = Preset::Balanced;

/// The settings that are varied where nothing else is asked for: what trades time and memory for quality.
const KNOBS: [(&str, &str); 8] = [
    ("steps", "500,1000"),
    ("stop.gain", "0.02,0.1"),
    // Steps at a quarter and at half the size of the views; the schedule of `balanced` has 0 and 200.
    ("schedule.resolution_steps", "[0,0],[0,1000]"),
    ("schedule.boost", "1"),
    ("max_gaussians", "2000,4000"),
    ("sh_degree", "0,1"),
    ("density.gradient_threshold", "2e-4,8e-4"),
    ("ssim_weight", "0"),
];

/// What would change the scores by changing what is scored, or is said by another option.
const NO_KNOBS: [(&str, &str); 6] = [
    (
        "downscale",
        "changes what is scored; smaller views of the same scores are --knob schedule.resolution_steps=[0,1000]",
    ),
    ("dataset", "is one for all points"),
    ("reference", "is what is scored against"),
    ("eval_every", "changes no point; give --eval-every"),
    (SEED, "has an option of its own; give --seeds"),
    (PRESET, "has an option of its own; give --presets"),
];

/// The settings to vary: the built-in ones if `built_in`, and `KEY=LIST` of `given`, which replace those of their key.
///
/// # Errors
/// [`Error::Usage`] for a list without values, given twice, or of a setting that is none to vary.
pub(super) fn axes(given: &[String], built_in: bool) -> Result<Vec<Axis>> {
    let given: Vec<Axis> =
        given.iter().map(|text| Axis::parse("knob", text)).collect::<Result<_>>()?;
    for (index, axis) in given.iter().enumerate() {
        if let Some((key, why)) = NO_KNOBS.iter().find(|(key, _)| *key == axis.key) {
            return Err(Error::Usage(format!("--knob {key}: it {why}")));
        }
        if given[..index].iter().any(|other| other.key == axis.key) {
            return Err(Error::Usage(format!("--knob {} is given twice; give one list", axis.key)));
        }
    }
    let mut axes = vec![];
    for (key, list) in KNOBS.iter().filter(|_| built_in) {
        if given.iter().all(|axis| axis.key != *key) {
            axes.push(Axis::new(key, list)?);
        }
    }
    axes.extend(given);
    Ok(axes)
}

/// The presets, then every value of every axis around [`BASE`], which is there if there are axes; each with every seed.
pub(super) fn points(presets: &[Preset], axes: &[Axis], seeds: Option<&Axis>) -> Vec<Point> {
    let mut names: Vec<&str> = vec![];
    let base = (!axes.is_empty()).then_some(BASE);
    for preset in presets.iter().copied().chain(base) {
        if !names.contains(&preset.name()) {
            names.push(preset.name());
        }
    }
    let of = |preset: &str| vec![(PRESET.to_owned(), preset.to_owned())];
    let mut points: Vec<Vec<(String, String)>> = names.into_iter().map(of).collect();
    for axis in axes {
        points.extend(axis.values.iter().map(|value| {
            let mut values = of(BASE.name());
            values.push((axis.key.clone(), value.clone()));
            values
        }));
    }
    let seeds = seeds.map_or(&[][..], |axis| &axis.values);
    let seeded = |values: Vec<(String, String)>| -> Vec<Point> {
        let with = |seed: &String| {
            let seed = (SEED.to_owned(), seed.clone());
            Point { values: values.iter().cloned().chain([seed]).collect() }
        };
        if seeds.is_empty() { vec![Point { values }] } else { seeds.iter().map(with).collect() }
    };
    points.into_iter().flat_map(seeded).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::TrainConfig;

    #[test]
    fn every_built_in_knob_is_a_setting_and_changes_the_base() {
        let mut base = TrainConfig::default();
        BASE.apply(&mut base).unwrap();
        for axis in axes(&[], true).unwrap() {
            for value in &axis.values {
                let config = base.with(&[format!("{}={value}", axis.key)]).unwrap();
                config.check().unwrap();
                assert_ne!(config, base, "{}={value}", axis.key);
            }
        }
    }

    #[test]
    fn points_are_presets_and_single_changes_of_the_base() {
        let knobs =
            axes(&["sh_degree=2".to_owned(), "tile=[8,8],[16,8]".to_owned()], false).unwrap();
        let seeds = Axis::new(SEED, "1,2").unwrap();
        let names: Vec<String> =
            points(&[Preset::Draft], &knobs, Some(&seeds)).iter().map(Point::name).collect();
        assert_eq!(
            names[..4],
            [
                "preset=draft,seed=1",
                "preset=draft,seed=2",
                "preset=balanced,seed=1",
                "preset=balanced,seed=2"
            ]
        );
        assert_eq!(names[4], "preset=balanced,sh_degree=2,seed=1");
        assert!(
            names.len() == 10 && names[6].starts_with("preset=balanced,tile=_8,8_"),
            "{names:?}"
        );
        assert_eq!(points(&[Preset::Draft, Preset::Draft], &[], None).len(), 1);
        // A list of one's own replaces the built-in one.
        let own = axes(&["steps=3".to_owned()], true).unwrap();
        assert_eq!(own.iter().filter(|axis| axis.key == "steps").count(), 1);
        assert_eq!(own.last().unwrap().values, ["3"]);
    }

    #[test]
    fn what_is_no_knob_is_refused_with_what_is() {
        for (given, part) in [
            ("steps", "V1,V2"),
            ("steps=", "empty"),
            ("downscale=2", "resolution_steps"),
            ("seed=1,2", "--seeds"),
            ("preset=fast", "--presets"),
        ] {
            let message = axes(&[given.to_owned()], true).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
        let twice = ["steps=1".to_owned(), "steps=2".to_owned()];
        assert!(axes(&twice, false).unwrap_err().to_string().contains("twice"));
    }
}
