//! The points of a sweep: all combinations of the values of its axes, and named grids.

use crate::results::sweep::{
    ADAPTIVE, ALL_PARTS, OFFSET, PARTS, PLAIN, PRESET, SweepAxis, SweepPoint, all_curves,
};
use crate::train::{Part, Preset};
use crate::{Error, Result};

/// The named grids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Grid {
    /// Every curve
    Leaderboard,
    /// AP3 with fixed black levels from 0 to 0.2, and the adaptive one
    Offset,
    /// AP3 with alpha from 0.04 to 0.3, and linear
    Alpha,
    /// ASE with g0 or c from 1 to 4, and linear
    Gain,
    /// 3DGS, each part of LITA-GS added alone, and all parts
    Parts,
    /// The presets draft, fast, balanced and best
    Presets,
    /// The preset balanced, and single changes that trade time for quality
    Changes,
}

/// The changes of balanced.
const CHANGES: [(&str, &[&str]); 8] = [
    ("steps", &["500", "1000"]),
    ("stop.gain", &["0.05", "0.2"]),
    // Steps at a quarter and at half resolution; `balanced` has 0 and 1 000.
    ("schedule.resolution_steps", &["[0,0]", "[0,2000]"]),
    ("schedule.initial_rate_factor", &["1"]),
    ("max_gaussians", &["2000", "4000"]),
    ("sh_degree", &["0", "1"]),
    ("density.gradient_threshold", &["5e-4", "2e-3"]),
    ("ssim_weight", &["0"]),
];

/// Settings that change the scored images or their references.
const FIXED: [(&str, &str); 3] = [
    (
        "downscale",
        "changes the scored images; --grid schedule.resolution_steps=[0,2000] trains at lower resolution only",
    ),
    ("dataset", "is common to all points"),
    ("reference", "is what scores compare with"),
];

impl Grid {
    /// Axis and value of the baseline.
    pub(super) fn baseline(self) -> Option<(&'static str, &'static str)> {
        match self {
            // The paper's baseline, if the library has it.
            Self::Leaderboard if all_curves().iter().any(|name| name == "softexp") => {
                Some(("curve", "softexp"))
            }
            Self::Leaderboard | Self::Alpha | Self::Gain => Some(("curve", "linear")),
            Self::Offset => None,
            Self::Parts => Some((PARTS, PLAIN)),
            Self::Presets | Self::Changes => Some((PRESET, Preset::Balanced.name())),
        }
    }

    fn grids(self) -> Vec<Vec<SweepAxis>> {
        let curve = |name| SweepAxis::from_values("curve", &[name]);
        match self {
            Self::Leaderboard => {
                vec![vec![SweepAxis { key: "curve".to_owned(), values: all_curves() }]]
            }
            // 0.103 is the fixed offset of earlier work that the paper marks.
            Self::Offset => {
                let levels =
                    ["0", "0.02", "0.04", "0.06", "0.08", "0.103", "0.12", "0.16", "0.2", ADAPTIVE];
                vec![vec![curve("ap3"), SweepAxis::from_values(OFFSET, &levels)]]
            }
            Self::Alpha => {
                let alphas = ["0.04", "0.08", "0.12", "0.16", "0.2", "0.3"];
                vec![vec![curve("ap3"), SweepAxis::from_values("alpha", &alphas)]]
            }
            Self::Gain => {
                let gains = |c: &[&str], base: &[&str]| {
                    vec![
                        curve("ase"),
                        SweepAxis::from_values("gain", c),
                        SweepAxis::from_values("base_gain", base),
                    ]
                };
                vec![gains(&["0"], &["1", "2", "3", "4"]), gains(&["1", "2", "3", "4"], &["1"])]
            }
            Self::Parts => {
                let [a, b, c, d] = Part::LITA.map(Part::name);
                vec![vec![SweepAxis::from_values(PARTS, &[PLAIN, a, b, c, d, ALL_PARTS])]]
            }
            Self::Presets => {
                let presets = [Preset::Draft, Preset::Fast, Preset::Balanced, Preset::Best];
                vec![vec![SweepAxis::from_values(PRESET, &presets.map(Preset::name))]]
            }
            Self::Changes => {
                let base = || SweepAxis::from_values(PRESET, &[Preset::Balanced.name()]);
                let changes = CHANGES
                    .iter()
                    .map(|(key, values)| vec![base(), SweepAxis::from_values(key, values)]);
                std::iter::once(vec![base()]).chain(changes).collect()
            }
        }
    }
}

/// The points of the axes, the first varying slowest. `given` replaces axes of a named grid with the same key, and
/// adds to the others.
pub(super) fn points(given: &[SweepAxis], table: Option<Grid>) -> Result<Vec<SweepPoint>> {
    for (index, axis) in given.iter().enumerate() {
        if given[..index].iter().any(|other| other.key == axis.key) {
            return Err(Error::Usage(format!("{} is given twice; give one list", axis.key)));
        }
        if let Some((key, why)) = FIXED.iter().find(|(key, _)| *key == axis.key) {
            return Err(Error::Usage(format!("--grid {key}: it {why}")));
        }
    }
    let mut grids = table.map_or_else(|| vec![vec![]], Grid::grids);
    for grid in &mut grids {
        grid.retain(|axis| given.iter().all(|other| other.key != axis.key));
        grid.extend(given.iter().cloned());
    }
    let has = |curve: &str| {
        let mut axes = grids.iter().flatten().filter(|axis| axis.key == "curve");
        axes.any(|axis| axis.values.iter().any(|value| value == curve))
    };
    let baseline = table.and_then(Grid::baseline).filter(|(key, _)| *key == "curve");
    if let Some((_, curve)) = baseline.filter(|(_, curve)| !has(curve)) {
        // Constants of other curves do not concern the baseline.
        let of_others = ["curve", "alpha", "beta", "gain", "base_gain", OFFSET];
        let shared = given.iter().filter(|axis| !of_others.contains(&axis.key.as_str())).cloned();
        grids.push(
            std::iter::once(SweepAxis::from_values("curve", &[curve])).chain(shared).collect(),
        );
    }
    let mut points: Vec<SweepPoint> = vec![];
    for grid in &mut grids {
        grid.sort_by(|a, b| a.order().cmp(&b.order()));
        check(grid)?;
        let point = |values| SweepPoint { values };
        let product = product(grid).into_iter().map(point);
        let fresh: Vec<SweepPoint> = product.filter(|point| !points.contains(point)).collect();
        points.extend(fresh);
    }
    Ok(points)
}

fn check(grid: &[SweepAxis]) -> Result<()> {
    let has = |key: &str| grid.iter().any(|axis| axis.key == key);
    if grid.is_empty() {
        let problem = "the grid is empty; give --curves, --alpha, --grid, --seeds or --table";
        return Err(Error::Usage(problem.to_owned()));
    }
    if has(OFFSET) && (has("alpha") || has("beta")) {
        let problem =
            "--offset fixes the black level that --alpha and --beta compute; give one or the other";
        return Err(Error::Usage(problem.to_owned()));
    }
    Ok(())
}

fn product(axes: &[SweepAxis]) -> Vec<Vec<(String, String)>> {
    axes.iter().fold(vec![vec![]], |points, axis| {
        let with = |point: &Vec<(String, String)>| {
            let extended = axis.values.iter().map(|value| {
                let mut point = point.clone();
                point.push((axis.key.clone(), value.clone()));
                point
            });
            extended.collect::<Vec<_>>()
        };
        points.iter().flat_map(with).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::sweep::arguments::arguments_of;
    use crate::train::TrainConfig;
    use nightsplat_photographs::tone::ToneCurve;

    fn names(given: &[(&str, &str)], table: Option<Grid>) -> Vec<String> {
        let axes: Vec<SweepAxis> =
            given.iter().map(|(key, list)| SweepAxis::new(key, list).unwrap()).collect();
        points(&axes, table).unwrap().iter().map(SweepPoint::name).collect()
    }

    fn refused(given: &[(&str, &str)], part: &str) {
        let axes: Result<Vec<SweepAxis>> =
            given.iter().map(|(key, list)| SweepAxis::new(key, list)).collect();
        let message = axes.and_then(|axes| points(&axes, None)).unwrap_err().to_string();
        assert!(message.contains(part), "no `{part}` in: {message}");
    }

    #[test]
    fn points_are_all_combinations_in_an_order_of_their_own() {
        let expected = [
            "curve=ap3,alpha=0.1,steps=2,seed=1",
            "curve=ap3,alpha=0.1,steps=2,seed=2",
            "curve=ase,alpha=0.1,steps=2,seed=1",
            "curve=ase,alpha=0.1,steps=2,seed=2",
        ];
        let given = [("seed", "1,2"), ("steps", "2"), ("tone.curve", "ap3, ase"), ("alpha", "0.1")];
        assert_eq!(names(&given, None), expected);
    }

    #[test]
    fn a_point_is_a_list_of_arguments() {
        let axes = [("curve", "my.toml"), ("beta", "1"), ("steps", "2"), ("seed", "3")];
        let axes = axes.map(|(key, list)| SweepAxis::new(key, list).unwrap());
        let arguments = arguments_of(&points(&axes, None).unwrap()[0]).join(" ");
        assert_eq!(arguments, "--curve my.toml --set tone.beta=1 --set steps=2 --seed 3");
        let offsets = points(&[SweepAxis::new("offset", "0.1,adaptive").unwrap()], None).unwrap();
        assert_eq!(arguments_of(&offsets[0]).join(" "), "--set tone.alpha=0.1 --set tone.beta=0");
        assert!(arguments_of(&offsets[1]).is_empty());
    }

    #[test]
    fn names_are_those_of_files_and_never_alike() {
        let names = names(&[("curve", "a/b.toml,a_b.toml,ap3,é")], None);
        assert_eq!(names[1..3], ["curve=a_b.toml", "curve=ap3"]);
        assert!(names[0].starts_with("curve=a_b.toml-") && names[3].starts_with("curve=_-"));
        let long = SweepPoint { values: vec![("key".to_owned(), "x".repeat(500))] };
        assert!(long.name().len() < 200);
    }

    #[test]
    fn grids_that_make_no_sense_are_refused() {
        refused(&[], "empty");
        refused(&[("alpha", "")], "empty");
        refused(&[("alpha", "0.1,,0.2")], "empty");
        refused(&[("seed", "1,2,1")], "1 is given twice");
        refused(&[("alpha", "0.1"), ("tone.alpha", "0.2")], "alpha is given twice");
        refused(&[("alpha", "0.1"), ("offset", "0.2")], "--offset");
        refused(&[("downscale", "2,4")], "resolution_steps");
    }

    #[test]
    fn grids_with_a_name_have_their_points() {
        let leaderboard = names(&[], Some(Grid::Leaderboard));
        assert_eq!(leaderboard.len(), ToneCurve::ALL.len());
        let offset = names(&[("seed", "1")], Some(Grid::Offset));
        assert_eq!(offset.last().unwrap(), "curve=ap3,offset=adaptive,seed=1");
        let alpha = names(&[("curve", "ase"), ("alpha", "0.1")], Some(Grid::Alpha));
        assert_eq!(alpha, ["curve=ase,alpha=0.1", "curve=linear"]);
        let gain = names(&[], Some(Grid::Gain));
        assert_eq!(gain.len(), 9);
        assert!(gain.contains(&"curve=ase,gain=0,base_gain=2".to_owned()), "{gain:?}");
        let parts = names(&[("seed", "2")], Some(Grid::Parts));
        assert_eq!((parts.len(), parts[5].as_str()), (6, "parts=all,seed=2"));
        assert_eq!(names(&[], Some(Grid::Presets))[3], "preset=best");
    }

    #[test]
    fn every_change_is_a_setting_and_changes_the_base() {
        let mut base = TrainConfig::default();
        Preset::Balanced.apply(&mut base).unwrap();
        let points = points(&[], Some(Grid::Changes)).unwrap();
        assert_eq!((points.len(), points[0].name().as_str()), (15, "preset=balanced"));
        for point in &points[1..] {
            let (key, value) = point.values.last().unwrap();
            let config = base.with(&[format!("{key}={value}")]).unwrap();
            config.check().unwrap();
            assert_ne!(config, base, "{key}={value}");
        }
    }
}
