//! The page of `diagnose`: photographs dark and lifted with their histograms, the plan, every figure.

use super::{COLUMNS, DIGITS, scene_facts, sizes, values};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::photographs::tone::{Exposure, LuminanceHistogram, luminance, soft};
use crate::results::report::{
    Best, Column, Comparison, Distribution, Facts, Picture, Report, Table, distributions,
};
use crate::train::diagnose::{Diagnosis, Plan};

/// The width of a picture, pixels.
const PICTURE_WIDTH: u32 = 240;
/// So many views have pictures, spread evenly.
const SHOWN: usize = 12;

pub(super) fn html(dataset: &Dataset, diagnosis: &Diagnosis, plan: &Plan) -> String {
    let views: Vec<&View> = dataset.train_views().filter(|view| view.has_photograph()).collect();
    let exposure = exposure(&views);
    let (mut dark, mut tone_mapped) =
        (Distribution::new("photographs"), Distribution::new("tone-mapped"));
    let stride = views.len().div_ceil(SHOWN).max(1);
    let mut rows = vec![];
    for view in views.iter().step_by(stride) {
        // One that can no longer be read has no picture.
        let Ok(Some(image)) = view.loaded() else { continue };
        let image = image.as_ref();
        let target =
            exposure.as_ref().map_or_else(|| image.clone(), |found| brightening(image, found));
        dark.add(&image.data);
        tone_mapped.add(&target.data);
        rows.push(comparison(&view.name, image, &target));
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
    let measured = scene_facts(&diagnosis.scene).into_iter();
    let measured = measured.map(|(name, figures)| [name.to_owned(), figures]);
    Report {
        title: format!("Diagnosis of {}", dataset.root.display()),
        intro,
        facts: vec![
            Facts { title: "The plan".to_owned(), rows: decided.collect() },
            Facts { title: "The set".to_owned(), rows: measured.collect() },
        ],
        tables: vec![table(diagnosis)],
        plots: vec![distributions(&[dark, tone_mapped])],
        comparisons: rows,
    }
    .html()
}

fn exposure(views: &[&View]) -> Option<Exposure> {
    let histograms: Vec<LuminanceHistogram> = views
        .iter()
        .filter_map(|view| Some(LuminanceHistogram::of(&view.loaded().ok()??.data)))
        .collect();
    Exposure::of(&histograms, None)
}

/// About what `--curve auto` makes of a photograph.
fn brightening(image: &Image, exposure: &Exposure) -> Image {
    let gain = exposure.gain_of(&LuminanceHistogram::of(&image.data), None);
    let weight = exposure.weight();
    let value = |&x: &f32| {
        let x = f64::from(x);
        (weight * soft(x, gain) + (1.0 - weight) * x) as f32
    };
    Image { data: image.data.iter().map(value).collect(), ..*image }
}

fn comparison(name: &str, image: &Image, target: &Image) -> Comparison {
    let picture = |caption: &str, image: Image| Picture {
        caption: caption.to_owned(),
        scores: String::new(),
        image,
    };
    let width = image.width.min(PICTURE_WIDTH);
    let height =
        (u64::from(image.height) * u64::from(width) / u64::from(image.width.max(1))) as u32;
    let [dark, tone_mapped] = [image, target].map(|image| image.resized(width, height));
    let histograms = histogram([&dark, &tone_mapped], width, height);
    Comparison {
        title: name.to_owned(),
        pictures: vec![
            picture("photograph", dark),
            picture("tone-mapped", tone_mapped),
            picture("luminance: dark before, light after", histograms),
        ],
    }
}

/// How often each luminance occurs before (dark) and after (light), from black on the left to white on the right.
fn histogram(of: [&Image; 2], width: u32, height: u32) -> Image {
    const SHADES: [[f32; 3]; 2] = [[0.18, 0.22, 0.34], [0.85, 0.62, 0.28]];
    let heights = of.map(|image| {
        let mut counts = vec![0.0_f64; width as usize];
        for (x, y) in (0..image.height).flat_map(|y| (0..image.width).map(move |x| (x, y))) {
            let place = luminance(image.pixel(x, y)).clamp(0.0, 1.0) * (width - 1) as f32;
            counts[place.round() as usize] += 1.0;
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

fn table(diagnosis: &Diagnosis) -> Table {
    let columns = COLUMNS.iter().skip(1).zip(DIGITS).map(|(name, digits)| Column {
        name: (*name).to_owned(),
        digits,
        best: Best::Unmarked,
    });
    Table {
        title: "Every training photograph".to_owned(),
        label: COLUMNS[0].to_owned(),
        columns: columns.collect(),
        rows: diagnosis
            .views
            .iter()
            .map(|view| (view.name.clone(), values(view).to_vec()))
            .collect(),
    }
}
