//! A diagnosis as a table, as lines and as a page: verdict, plan, photographs with their targets, measurements.

use nightsplat_core::natural;
use nightsplat_models::linear_light::target_of;
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::ToneSettings;
use nightsplat_report::{
    Best, Column, ContactSheet, Distribution, NumberTable, Report, TextTable, distributions,
};

use crate::results::verdict;
use crate::train::plan::Plan;
use nightsplat_diagnose::{
    ChannelNoise, Diagnosis, LampDiagnosis, SceneDiagnosis, TargetNoise, ViewDiagnosis, is_blurred,
    median,
};

/// A column of the table of photographs: name, decimals, meaning with its unit, bad values in words, and whether a
/// value is bad, given the median of the column.
type Measure = (&'static str, usize, &'static str, &'static str, fn(f64, f64) -> bool);

/// The columns, in the order of [`values`].
const MEASURES: [Measure; 14] = [
    (
        "p10",
        4,
        "10th percentile of the encoded luminance, 0 to 1",
        "0: crushed shadows",
        |value, _| value == 0.0,
    ),
    (
        "p90",
        4,
        "90th percentile of the encoded luminance, 0 to 1",
        "below 0.02: too dark for 8 bits",
        |value, _| value < 0.02,
    ),
    ("r", 2, "p10 / p90, 0 to 1", "above 0.7: fog, glare or no texture", |value, _| value > 0.7),
    ("mean", 4, "mean encoded luminance, 0 to 1", "above 0.4: not dark", |value, _| value > 0.4),
    (
        "cubic",
        4,
        "cubic mean of the encoded luminance, 0 to 1",
        "twice the median: bright lamps in the dark",
        |value, median| value > 2.0 * median,
    ),
    (
        "EV",
        2,
        "stops brighter than other views of the same points",
        "beyond 0.3 either way: learn exposures",
        |value, _| value.abs() > 0.3,
    ),
    (
        "white %",
        2,
        "values near white, 0.94 and above, %",
        "above 5: detail is lost in lamps or sky",
        |value, _| value > 5.0,
    ),
    ("black %", 1, "zero values, %", "above 20: detail is lost in the shadows", |value, _| {
        value > 20.0
    }),
    (
        "codes",
        0,
        "distinct values in use, of 256 for 8 bits",
        "below 20: banding in the targets",
        |value, _| value < 20.0,
    ),
    (
        "luma noise",
        3,
        "standard deviation of the luminance in the target, with JPEG and quantisation noise",
        "above 0.02: visible in the targets",
        |value, _| value > 0.02,
    ),
    (
        "chroma noise",
        3,
        "standard deviation of the colour differences R - Y and B - Y in the target",
        "above 0.02: visible in the targets",
        |value, _| value > 0.02,
    ),
    ("blur", 1, "width of edges, pixels", "1.6 times the median: motion or focus", is_blurred),
    ("points", 0, "points that the view sees", "below 12: its pose is doubtful", |value, _| {
        value < 12.0
    }),
    (
        "overlap",
        2,
        "share of the view that other views see, 0 to 1",
        "below 0.5: holes and floaters",
        |value, _| value < 0.5,
    ),
];

/// The table of photographs, in the order of their names.
pub(crate) fn table(diagnosis: &Diagnosis) -> NumberTable {
    let mut views: Vec<&ViewDiagnosis> = diagnosis.views.iter().collect();
    views.sort_by(|a, b| natural::compare(&a.name, &b.name));
    let column = |(name, digits, ..): &Measure| Column {
        name: (*name).to_owned(),
        digits: *digits,
        best: Best::Unmarked,
    };
    let all: Vec<_> = views.iter().map(|view| values(view)).collect();
    let bad = MEASURES.iter().enumerate().flat_map(|(column, (.., is_bad))| {
        let median = median(all.iter().filter_map(|row| row[column]).collect());
        let is_marked = |row: &&usize| {
            all[**row][column].zip(median).is_some_and(|(value, median)| is_bad(value, median))
        };
        let rows: Vec<usize> = (0..all.len()).collect();
        rows.iter().filter(is_marked).map(|row| [*row, column]).collect::<Vec<_>>()
    });
    let bad = bad.collect();
    NumberTable {
        title: "Training photographs".to_owned(),
        label: "view".to_owned(),
        columns: MEASURES.iter().map(column).collect(),
        rows: views.iter().zip(&all).map(|(view, row)| (view.name.clone(), row.to_vec())).collect(),
        bad,
    }
}

/// The values of a view.
fn values(view: &ViewDiagnosis) -> [Option<f64>; 14] {
    [
        Some(view.p10),
        Some(view.p90),
        Some(view.r),
        Some(view.mean_luminance),
        Some(view.cubic_mean),
        view.exposure,
        Some(100.0 * view.near_white_fraction),
        Some(100.0 * view.zero_fraction),
        Some(view.code_values as f64),
        view.noise_in_target.map(|noise| noise.luma),
        view.noise_in_target.map(|noise| noise.chroma),
        view.blur,
        Some(view.points as f64),
        Some(view.overlap),
    ]
}

/// The size of the photographs, or the range of sizes.
pub(crate) fn sizes(views: &[ViewDiagnosis]) -> String {
    let area = |view: &&ViewDiagnosis| u64::from(view.size[0]) * u64::from(view.size[1]);
    let size = |view: Option<&ViewDiagnosis>| {
        view.map_or_else(String::new, |view| format!("{}x{}", view.size[0], view.size[1]))
    };
    let (least, most) = (size(views.iter().min_by_key(area)), size(views.iter().max_by_key(area)));
    if least == most { least } else { format!("{least} to {most}") }
}

/// Measurements of the whole set: a name and values in each row.
pub(crate) fn scene_facts(scene: &SceneDiagnosis) -> [[String; 2]; 6] {
    let sensor = match scene.noise {
        Some(ChannelNoise { gain, read }) => {
            format!("sensor: gain {gain:.2e}, read noise {read:.2e} of white, linear")
        }
        None => "sensor: not measurable, no photograph has a flat, unclipped area".to_owned(),
    };
    let noise = match scene.noise_in_target {
        Some(TargetNoise { luma, chroma }) => format!(
            "{luma:.3} luma, {chroma:.3} chroma in a target, with JPEG and quantisation noise; {sensor}"
        ),
        None => sensor,
    };
    let brightness = format!(
        "mean {:.4}, p10 {:.4}, p90 {:.4}, cubic mean {:.4}; gain {:.1}, {:.0} times too little light",
        scene.mean_luminance,
        scene.p10,
        scene.p90,
        scene.cubic_mean,
        scene.brightening,
        scene.darkening
    );
    let exposure = format!(
        "{:.2} stops spread between views, {:.1} stops uneven light within a view",
        scene.exposure_spread, scene.unevenness
    );
    let blur = scene.blur.map_or_else(|| "-".to_owned(), |blur| format!("{blur:.1} pixels"));
    let detail = format!(
        "blur {blur}, {:.0} code values, {:.2} % near white, {:.1} % black",
        scene.code_values,
        100.0 * scene.near_white_fraction,
        100.0 * scene.zero_fraction
    );
    let cameras = format!(
        "{:.0} views per point, overlap {:.2}, {} points",
        scene.views_per_point, scene.overlap, scene.points
    );
    let named = [
        ("brightness", brightness),
        ("exposure", exposure),
        ("lamp", lamp(scene)),
        ("noise", noise),
        ("detail", detail),
        ("cameras", cameras),
    ];
    named.map(|(name, figures)| [name.to_owned(), figures])
}

/// What a lamp that moves with the camera explains.
fn lamp(scene: &SceneDiagnosis) -> String {
    let Some(lamp) = &scene.lamp else {
        let why = scene.lamp_unknown.as_deref().unwrap_or("not measured");
        return format!("not measurable: {why}");
    };
    let LampDiagnosis { exponent, falloff: [first, second], ambient, d_ref, .. } = lamp;
    let found = if lamp.is_found() {
        format!(
            "moves with the camera: exponent {exponent:.1}, falloff {first:.1}, {second:.1}, ambient {ambient:.3}, \
             distance {d_ref:.2}; "
        )
    } else {
        "none that moves with the camera; ".to_owned()
    };
    format!(
        "{found}R^2 of a point's {:.2} stops between views: exposures {:.2}, lamp {:.2}, both {:.2}; {:.2} stops \
         beyond exposures, {:.2} of them by distance",
        lamp.spread,
        lamp.exposure_r_squared,
        lamp.lamp_r_squared,
        lamp.r_squared,
        lamp.stops,
        lamp.distance_stops
    )
}

/// The page: verdict and plan first, then all photographs, then measurements.
pub(crate) fn page(dataset: &Dataset, diagnosis: &Diagnosis, plan: &Plan) -> String {
    let views: Vec<&View> = dataset.train_views().filter(|view| view.has_photograph()).collect();
    let tone = ToneSettings { full_resolution: false, ..ToneSettings::default() };
    let scene = SceneTone::measure(&tone, dataset).ok();
    let (mut dark, mut bright) = (Distribution::new("photographs"), Distribution::new("targets"));
    let mut sheet = ContactSheet::new("The photographs, and what they become", views.len());
    for (index, view) in views.iter().enumerate() {
        let mark = diagnosis.odd.get(&view.name).map_or("", String::as_str);
        if !sheet.shows(index, mark) {
            continue;
        }
        // A photograph that can no longer be read is skipped.
        let Ok(Some(image)) = view.loaded() else { continue };
        let image = sheet.shrunk(&image);
        let curve = scene.as_ref().and_then(|scene| scene.inverse(view).ok());
        let target = curve.map_or_else(|| image.clone(), |curve| target_of(&image, &curve));
        dark.add(&image.data);
        bright.add(&target.data);
        let [image, target] = [image, target].map(|image| view.upright(image));
        sheet.add(&view.name, mark, [&image, &target]);
    }
    let mut intro = vec![
        verdict::of_set(diagnosis) + ".",
        format!(
            "{} photographs to train on ({}), {} held out, {} points.",
            diagnosis.views.len(),
            sizes(&diagnosis.views),
            diagnosis.test_views,
            dataset.points.len()
        ),
    ];
    intro.extend(diagnosis.remarks.iter().map(|remark| format!("Note: {remark}.")));
    let decided = plan.decisions().into_iter();
    let decided = decided.map(|(part, value, why)| [format!("{part}: {value}"), why.to_owned()]);
    let meaning = |(name, _, meaning, bad, _): &Measure| {
        [(*name).to_owned(), format!("{meaning}. Bad: {bad}.")]
    };
    let facts = |title: &str, rows| TextTable { title: title.to_owned(), rows };
    let name = dataset.root.file_name().unwrap_or(dataset.root.as_os_str());
    Report {
        title: format!("Diagnosis of {}", name.to_string_lossy()),
        intro,
        facts: vec![
            facts("The plan", decided.collect()),
            facts("The dataset", scene_facts(&diagnosis.scene).to_vec()),
            facts("The columns of the table below", MEASURES.iter().map(meaning).collect()),
        ],
        tables: vec![table(diagnosis)],
        charts: vec![distributions(&[dark, bright])],
        sheets: vec![sheet],
        ..Report::default()
    }
    .html()
}
