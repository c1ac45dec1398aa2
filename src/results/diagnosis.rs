//! A diagnosis as a table, as lines and as a page: the plan, measurements, and photographs with their targets.

use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{ToneSettings, luminance};

use crate::results::linear_light::target_of;
use crate::results::report::{
    Best, Column, Comparison, Distribution, NumberTable, Picture, Report, TextTable, distributions,
};
use crate::train::diagnose::{
    ChannelNoise, Diagnosis, LampDiagnosis, Plan, SceneDiagnosis, TargetNoise, ViewDiagnosis,
};

/// Width of an image, pixels.
const PICTURE_WIDTH: u32 = 240;
/// Number of views with images, spread evenly.
const SHOWN: usize = 12;

/// A column of the table of photographs: name, decimals, meaning with its unit, and bad values.
type Measure = (&'static str, usize, &'static str, &'static str);

/// The columns, in the order of [`values`].
const MEASURES: [Measure; 14] = [
    ("p10", 4, "10th percentile of the encoded luminance, 0 to 1", "0: crushed shadows"),
    (
        "p90",
        4,
        "90th percentile of the encoded luminance, 0 to 1",
        "below 0.02: too dark for 8 bits",
    ),
    ("r", 2, "p10 / p90, 0 to 1", "above 0.7: fog, glare or no texture"),
    ("mean", 4, "mean encoded luminance, 0 to 1", "above 0.4: not dark"),
    (
        "cubic",
        4,
        "cubic mean of the encoded luminance, 0 to 1",
        "far above the mean: bright lamps in the dark",
    ),
    (
        "EV",
        2,
        "stops brighter than other views of the same points",
        "beyond 0.3 either way: learn exposures",
    ),
    (
        "white %",
        2,
        "values near white, 0.94 and above, %",
        "above 5: detail is lost in lamps or sky",
    ),
    ("black %", 1, "zero values, %", "above 20: detail is lost in the shadows"),
    ("codes", 0, "distinct values in use, of 256 for 8 bits", "below 20: banding in the targets"),
    (
        "luma noise",
        3,
        "standard deviation of the luminance in the target, with JPEG and quantisation noise",
        "above 0.02: visible in the targets",
    ),
    (
        "chroma noise",
        3,
        "standard deviation of the colour differences R - Y and B - Y in the target",
        "above 0.02: visible in the targets",
    ),
    ("blur", 1, "width of edges, pixels", "1.6 times the median: motion or focus"),
    ("points", 0, "points that the view sees", "below 12: its pose is doubtful"),
    (
        "overlap",
        2,
        "share of the view that other views see, 0 to 1",
        "below 0.5: holes and floaters",
    ),
];

/// The table of photographs.
pub(crate) fn table(diagnosis: &Diagnosis) -> NumberTable {
    let column = |(name, digits, ..): &Measure| Column {
        name: (*name).to_owned(),
        digits: *digits,
        best: Best::Unmarked,
    };
    let row = |view: &ViewDiagnosis| (view.name.clone(), values(view).to_vec());
    NumberTable {
        title: "Training photographs".to_owned(),
        label: "view".to_owned(),
        columns: MEASURES.iter().map(column).collect(),
        rows: diagnosis.views.iter().map(row).collect(),
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

/// The page: the plan first, then measurements and photographs.
pub(crate) fn page(dataset: &Dataset, diagnosis: &Diagnosis, plan: &Plan) -> String {
    let views: Vec<&View> = dataset.train_views().filter(|view| view.has_photograph()).collect();
    let tone = ToneSettings { full_resolution: false, ..ToneSettings::default() };
    let scene = SceneTone::measure(&tone, dataset).ok();
    let (mut dark, mut bright) = (Distribution::new("photographs"), Distribution::new("targets"));
    let stride = views.len().div_ceil(SHOWN).max(1);
    let mut comparisons = vec![];
    for view in views.iter().step_by(stride) {
        // A photograph that can no longer be read is skipped.
        let Ok(Some(image)) = view.loaded() else { continue };
        let image = image.as_ref();
        let curve = scene.as_ref().and_then(|scene| scene.inverse(view).ok());
        let target = curve.map_or_else(|| image.clone(), |curve| target_of(image, &curve));
        dark.add(&image.data);
        bright.add(&target.data);
        let [shown, target] = [image.clone(), target].map(|image| view.upright(image));
        comparisons.push(comparison(&view.name, &shown, &target));
    }
    let mut intro = vec![format!(
        "{} photographs to train on ({}), {} held out, {} points.",
        diagnosis.views.len(),
        sizes(&diagnosis.views),
        diagnosis.test_views,
        dataset.points.len()
    )];
    intro.extend(diagnosis.remarks.iter().map(|remark| format!("Note: {remark}.")));
    let decided = plan.decisions().into_iter();
    let decided = decided.map(|(part, value, why)| [format!("{part}: {value}"), why.to_owned()]);
    let meaning =
        |(name, _, meaning, bad): &Measure| [(*name).to_owned(), format!("{meaning}. Bad: {bad}.")];
    let facts = |title: &str, rows| TextTable { title: title.to_owned(), rows };
    Report {
        title: format!("Diagnosis of {}", dataset.root.display()),
        intro,
        facts: vec![
            facts("The plan", decided.collect()),
            facts("The dataset", scene_facts(&diagnosis.scene).to_vec()),
            facts("The columns of the table below", MEASURES.iter().map(meaning).collect()),
        ],
        tables: vec![table(diagnosis)],
        charts: vec![distributions(&[dark, bright])],
        comparisons,
        ..Report::default()
    }
    .html()
}

fn comparison(name: &str, image: &Image, target: &Image) -> Comparison {
    let picture = |caption: &str, image: &Image| {
        Picture::shrunk(caption, String::new(), image, PICTURE_WIDTH)
    };
    let (dark, bright) = (picture("photograph", image), picture("target", target));
    let (width, height) = (dark.image.width, dark.image.height);
    let histograms = histogram([&dark.image, &bright.image], width, height);
    let histograms = picture("luminance before (dark) and after (light)", &histograms);
    Comparison { title: name.to_owned(), pictures: vec![dark, bright, histograms] }
}

/// Histograms of luminance before (dark) and after (light).
fn histogram(of: [&Image; 2], width: u32, height: u32) -> Image {
    const SHADES: [[f32; 3]; 2] = [[0.18, 0.22, 0.34], [0.85, 0.62, 0.28]];
    let heights = of.map(|image| {
        let mut counts = vec![0.0_f64; width as usize];
        for (x, y) in (0..image.height).flat_map(|y| (0..image.width).map(move |x| (x, y))) {
            let position = luminance(image.pixel(x, y)).clamp(0.0, 1.0) * (width - 1) as f32;
            counts[position.round() as usize] += 1.0;
        }
        let peak = counts.iter().fold(1.0, |peak: f64, &count| peak.max(count));
        counts.iter().map(|count| count / peak * f64::from(height)).collect::<Vec<_>>()
    });
    Image::from_fn(width, height, |x, y| {
        let covers = |curve: usize| heights[curve][x as usize] >= f64::from(height - y);
        match (covers(0), covers(1)) {
            (true, _) => SHADES[0],
            (false, true) => SHADES[1],
            (false, false) => [0.96; 3],
        }
    })
}
