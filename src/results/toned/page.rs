//! The page of mapped photographs: all photographs dark and lit, measurements, histograms of luminance.

use std::path::Path;

use nightsplat_core::natural;
use nightsplat_core::output::write_whole;
use nightsplat_photographs::image::Image;
use nightsplat_photographs::metrics::Scores;
use nightsplat_photographs::tone::Tone;
use nightsplat_report::{
    Best, Column, Comparison, ContactSheet, Distribution, NumberTable, Picture, Report,
    distributions,
};

use super::photographs::InputPhotograph;
use super::{CurveOnSet, Mapped, Measures, ToneOutput, ToneReport, ToneRequest, without};
use crate::Result;
use crate::gpu::Gpu;
use crate::results::eval;

/// Maximum width of an image, pixels.
const PICTURE_WIDTH: u32 = 480;

/// The contents of the page, gathered while photographs are mapped.
pub(super) struct TonePage {
    curve: String,
    /// Only photographs with a reference are drawn, if there are any, so that the histograms compare.
    only_referenced: bool,
    input: Distribution,
    result: Distribution,
    compared: Vec<(CurveOnSet, Distribution)>,
    reference: Distribution,
    /// All photographs, dark and lit.
    sheet: ContactSheet,
    /// The first with every curve.
    comparison: Option<Comparison>,
    /// The number of photographs so far.
    count: usize,
}

impl TonePage {
    pub(super) fn new(
        gpu: &Gpu,
        request: &ToneRequest<'_>,
        photographs: &[InputPhotograph],
    ) -> Result<Self> {
        let compared = request.compared.iter().map(|(curve, config)| {
            let masks = (request.input, config.invert_masks);
            let set = CurveOnSet::new(gpu, config.tone.clone(), photographs, masks)?;
            Ok((set, Distribution::new(curve.clone())))
        });
        let (curve, _) = request.curve.clone();
        Ok(Self {
            only_referenced: photographs.iter().any(|listed| listed.reference.is_some()),
            input: Distribution::new("photograph"),
            result: Distribution::new(curve.clone()),
            compared: compared.collect::<Result<_>>()?,
            reference: Distribution::new("reference"),
            sheet: ContactSheet::new("The photographs, dark and lit", photographs.len()),
            comparison: None,
            count: 0,
            curve,
        })
    }

    /// Adds a photograph and its result; the first is shown large.
    pub(super) fn add(
        &mut self,
        listed: &InputPhotograph,
        mapped: &Mapped,
        scores: Option<Scores>,
    ) -> Result<()> {
        let Mapped { photograph, gaps, image, reference, .. } = mapped;
        if self.sheet.shows(self.count, "") {
            self.sheet.add(&listed.name, "", [photograph, image]);
        }
        self.count += 1;
        if self.only_referenced && reference.is_none() {
            return Ok(());
        }
        self.input.add(&without(photograph, gaps));
        self.result.add(&without(image, gaps));
        let mut pictures =
            vec![picture("photograph", None, photograph), picture(&self.curve, scores, image)];
        for (set, distribution) in &mut self.compared {
            let (_, image, _) = set.result(photograph, gaps, listed)?;
            distribution.add(&without(&image, gaps));
            let scores = reference.as_ref().map(|reference| Scores::measure(&image, reference));
            pictures.push(picture(&distribution.name, scores.transpose()?, &image));
        }
        if let Some(reference) = reference {
            self.reference.add(&without(reference, gaps));
            pictures.push(picture("reference", None, reference));
        }
        self.comparison.get_or_insert_with(|| Comparison { title: listed.name.clone(), pictures });
        Ok(())
    }

    /// Writes the page.
    pub(super) fn write(self, path: &Path, output: &ToneOutput) -> Result<()> {
        let mut drawn = vec![self.input, self.result];
        drawn.extend(self.compared.into_iter().map(|(_, distribution)| distribution));
        let mut intro = vec![format!(
            "The curve {} on {} photographs: luminance before and after.",
            self.curve,
            output.views.len()
        )];
        if self.only_referenced {
            drawn.push(self.reference);
            intro.push(
                "Histograms and the large images are of photographs with a reference.".to_owned(),
            );
        }
        intro.extend(output.with_reference.as_deref().map(eval::with_reference));
        let report = Report {
            title: format!("Tone curve {}", self.curve),
            intro,
            tables: vec![table(output)],
            charts: vec![distributions(&drawn)],
            sheets: vec![self.sheet],
            comparisons: self.comparison.into_iter().collect(),
            ..Report::default()
        };
        write_whole(path, report.html().as_bytes())
    }
}

fn picture(caption: &str, scores: Option<Scores>, image: &Image) -> Picture {
    let scores = scores.map(|Scores { psnr, ssim, .. }| format!("{psnr:.2} dB, SSIM {ssim:.3}"));
    Picture::shrunk(caption, scores.unwrap_or_default(), image, PICTURE_WIDTH)
}

/// Measurements of the photographs in the order of their names, then of the scene; without what no photograph has, and
/// without what the curve does not use.
pub(crate) fn table(output: &ToneOutput) -> NumberTable {
    let column =
        |name: &str, digits| Column { name: name.to_owned(), digits, best: Best::Unmarked };
    let measured = |Measures { mean_luminance, near_white_fraction, skewness, .. }: Measures| {
        [Some(mean_luminance), Some(skewness), Some(100.0 * near_white_fraction)]
    };
    // The black level of the curve auto does not depend on the photograph.
    let has_black_level = output.curve.has_black_level() && output.curve.curve != Tone::Auto;
    let mut views: Vec<(&str, &ToneReport)> =
        output.views.iter().map(|(name, report)| (name.as_str(), report)).collect();
    views.sort_by(|a, b| natural::compare(a.0, b.0));
    let rows = views.into_iter().chain([("scene", &output.scene)]).map(|(name, report)| {
        let ToneReport { before, delta0, after, gain, scores, .. } = report;
        let of_black_level =
            [Some(before.r), *delta0].map(|value| value.filter(|_| has_black_level));
        let mut values = vec![Some(before.p10), Some(before.p90)];
        values.extend(of_black_level);
        values.push(*gain);
        values.extend(measured(*before));
        values.extend(measured(*after));
        values.extend([scores.map(|scores| scores.psnr), scores.map(|scores| scores.ssim)]);
        (name.to_owned(), values)
    });
    let table = NumberTable {
        title: "Per photograph, and means of the scene".to_owned(),
        label: "photograph".to_owned(),
        columns: vec![
            column("p10", 4),
            column("p90", 4),
            column("r", 3),
            column("delta0", 4),
            column("gain", 1),
            column("Y", 4),
            column("skewness", 2),
            column("white %", 1),
            column("lit Y", 4),
            column("lit skewness", 2),
            column("lit white %", 1),
            column("PSNR, dB", 2),
            column("SSIM", 3),
        ],
        rows: rows.collect(),
        ..NumberTable::default()
    };
    table.without_empty_columns()
}
