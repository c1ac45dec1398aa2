//! Curves from files: TOML settings, CSV and .cube tables, and errors in them.

use std::fs;
use std::path::PathBuf;

use nightsplat_core::Error;
use nightsplat_photographs::tone::{CurveChoice, Family, Table, Tone, ToneCurve, ToneSettings};

/// A curve read from a file with this name and text.
fn load(name: &str, text: &str) -> Result<ToneSettings, Error> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().parse::<CurveChoice>().unwrap().settings()
}

#[test]
fn a_family_with_its_own_constants_is_read_from_toml() {
    let settings = load("my.toml", "curve = \"gamma\"\n[constants]\na = 0.9\nb = 0.4\n").unwrap();
    assert_eq!(
        (settings.curve, settings.constants.as_slice()),
        (ToneCurve::Gamma.into(), &[0.9, 0.4][..])
    );
    assert_eq!([settings.alpha, settings.gain_c], [0.0, 0.0]);
    let cubic = "curve = \"cubic\"\nalpha = 0.1\nconstants = { a = 0.1, b = -0.5, c = 1, d = 0.0 }";
    let settings = load("c.toml", cubic).unwrap();
    assert_eq!(settings.curve, ToneCurve::FittedCubic);
    assert_eq!(settings.constants, [0.1, -0.5, 1.0, 0.0]);
    assert_eq!(settings.alpha, 0.1);
    let plain = load("p.toml", "curve = \"hybrid\"").unwrap();
    assert_eq!(plain, ToneSettings::new(ToneCurve::Hybrid));
}

fn table_of(settings: ToneSettings) -> Table {
    let Tone::Table(table) = settings.curve else { panic!("{}", settings.curve) };
    table
}

#[test]
fn tables_are_read_from_csv_and_cube() {
    let settings = load("a.csv", "# made by hand\nt,y\n0,0\n0.5, 0.4\n1;0.8\n\n2,1\n").unwrap();
    let table = table_of(settings);
    assert_eq!((table.is_of_stored, table.x.as_slice()), (false, &[0.0, 0.5, 1.0, 2.0][..]));
    assert_eq!(table.y, [[0.0, 0.4, 0.8, 1.0]]);
    let of_x = table_of(load("b.csv", "x,r,g,b\n0,0,0,0\n1,1,0.5,0.2\n").unwrap());
    assert_eq!((of_x.is_of_stored, of_x.y.len()), (true, 3));
    let cube = "TITLE \"brighter\"\nLUT_1D_SIZE 3\nDOMAIN_MIN 0 0 0\nDOMAIN_MAX 2 2 2\n0 0 0\n0.5 0.6 0.7\n1 1 1\n";
    let settings = load("c.cube", cube).unwrap();
    let table = table_of(settings);
    assert_eq!((table.is_of_stored, table.x.as_slice()), (true, &[0.0, 1.0, 2.0][..]));
    assert_eq!(table.y[2], [0.0, 0.7, 1.0]);
    let inside =
        cube.replace("MIN 0 0 0", "MIN 0.2 0.2 0.2").replace("MAX 2 2 2", "MAX 0.6 0.6 0.6");
    let x = Table::from_cube(&inside).unwrap().x;
    assert!(x.iter().zip([0.2, 0.4, 0.6]).all(|(x, at)| (x - at).abs() < 1e-12), "{x:?}");
}

#[test]
fn the_problem_of_a_file_is_named() {
    let wrong = [
        ("a.toml", "curve = \"gama\"", "unknown curve `gama`"),
        ("a.toml", "curve = \"gamma\"\nconstants = { a = 1.0 }", "needs the constant `b`"),
        (
            "a.toml",
            "curve = \"gamma\"\nconstants = { a = 1.0, b = 1.0, q = 1.0 }",
            "no constant `q`",
        ),
        ("a.toml", "curve = \"gamma\"\nconstants = { a = inf, b = 1.0 }", "constant a of `gamma`"),
        (
            "a.toml",
            "curve = \"reinhard\"\nconstants = { a = 1.0, b = -0.5 }",
            "undefined at t = 0.5",
        ),
        ("a.toml", "gain_c = 1.0", "names no curve"),
        ("a.toml", "curve = \"ap3\"\ngain = 1.0", "unknown field `gain`"),
        ("a.toml", "curve = \"table\"", "needs a file of values"),
        ("a.toml", "curve = ", "is not a tone curve"),
        ("a.csv", "0,0\n0.5,0.2\n0.4,0.3\n", "line 3: the first column must ascend"),
        ("a.csv", "0,0\n0,1\n", "must ascend"),
        ("a.csv", "0,0\n1,nan\n", "line 2: `nan` is not a number"),
        ("a.csv", "0,0\n", "at least two"),
        ("a.csv", "", "at least two"),
        ("a.csv", "luma,y\n0,0\n", "`luma`"),
        ("a.csv", "0,0,1\n1,1,1\n", "line 1: 2 values"),
        ("a.cube", "LUT_3D_SIZE 2\n0 0 0\n", "3D"),
        ("a.cube", "LUT_1D_SIZE 3\n0 0 0\n1 1 1\n", "LUT_1D_SIZE is 3 but there are 2"),
    ];
    for (name, text, part) in wrong {
        let error = load(name, text).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(part) && message.contains(name), "{message}");
        assert!(!message.contains('\n'), "{message}");
        assert_eq!(error.exit_code(), 3, "{message}");
    }
    let absent = CurveChoice::File(PathBuf::from("absent.toml")).settings().unwrap_err();
    assert!(absent.to_string().contains("absent.toml"));
    for name in ["gama", "table", ""] {
        assert!(matches!(name.parse::<CurveChoice>(), Err(Error::Usage(_))), "{name}");
    }
}

#[test]
fn another_curve_has_its_own_constants_and_the_same_curve_keeps_them() {
    let mine = ToneSettings { gain_c: 2.0, theta: 0.4, ..ToneSettings::new(ToneCurve::Ap3) };
    assert_eq!(mine.with_curve(ToneCurve::Ap3), mine);
    let ase = mine.with_curve(ToneCurve::Ase);
    assert_eq!([ase.gain_c, ase.theta, ase.alpha], [3.0, 0.4, 0.12]);
    let gamma = mine.with_curve(ToneCurve::Gamma);
    assert_eq!(gamma.constants, Family::find("gamma").unwrap().defaults());
}

#[test]
fn a_rounded_curve_is_short_and_the_same_for_the_kernels() {
    let long = ToneSettings {
        gain_c: 1.234_567_890_123e-250,
        alpha: 0.1 + 0.2,
        constants: vec![1.0 / 3.0, -2.0 / 7.0, 1e-7, 3.0],
        ..ToneSettings::new(ToneCurve::FittedCubic)
    };
    let short = long.clone().rounded();
    assert_eq!((short.gain_c, short.alpha), (0.0, 0.3));
    for (long, short) in long.constants.iter().zip(&short.constants) {
        assert_eq!((*long as f32).to_bits(), (*short as f32).to_bits());
        assert!(short.to_string().len() <= 12, "{short}");
    }
    assert_eq!(short.clone().rounded(), short);
}

/// Between knots 0.1 and 0.4 the slopes are weighted harmonic means of the secants 3, 2/3 and 1/6: 1.2203390 and 2/7.
#[test]
fn between_its_knots_a_table_is_the_monotone_cubic() {
    let table = |y: [f64; 4]| Table {
        is_of_stored: false,
        x: vec![0.0, 0.1, 0.4, 1.0],
        y: vec![y.to_vec()],
    };
    let is_near =
        |actual: f64, expected: f64| assert!((actual - expected).abs() < 1e-8, "{actual}");
    is_near(table([0.0, 0.3, 0.5, 0.6]).value(0.25, 0), 0.435_048_426_150);
    for x in [0.03, 0.2, 0.25, 0.9] {
        is_near(table([0.0, 0.1, 0.4, 1.0]).value(x, 0), x);
    }
    // Flat at a peak, and half way between two flat knots half way up.
    is_near(table([0.0, 0.6, 0.4, 0.5]).value(0.25, 0), 0.5);
}

#[test]
fn a_table_goes_through_its_knots_and_rises_where_they_do() {
    let y =
        vec![vec![0.0, 0.3, 0.5, 0.5, 0.8, 1.0], vec![0.1; 6], vec![1.0, 0.9, 0.3, 0.2, 0.1, 0.0]];
    let table = Table { is_of_stored: false, x: vec![0.0, 0.1, 0.5, 0.6, 1.0, 2.5], y };
    for channel in 0..3 {
        for (x, y) in table.x.iter().zip(&table.y[channel]) {
            assert!((table.value(*x, channel) - y).abs() < 1e-12);
        }
    }
    let values: Vec<f64> = (0..=2600).map(|i| table.value(f64::from(i) / 1000.0, 0)).collect();
    assert!(values.windows(2).all(|pair| pair[1] >= pair[0] - 1e-12), "it overshoots");
    assert_eq!(table.value(9.0, 0), 1.0);
    assert_eq!(table.value(f64::NAN, 0), 0.0);
}
