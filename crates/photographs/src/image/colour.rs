//! Converts the colours of a file to sRGB.
//!
//! ```text
//! sRGB = encode(M decode(stored))      decode: a curve per channel; M: from linear light of the file's primaries to
//! sRGB's
//! ```
//!
//! If a profile has a matrix and tables, the matrix is used; a profile of tables alone cannot be used. Colours that are
//! sRGB to within one 8-bit code value keep their bits. Converted values are rounded to multiples of 1/65535, which is
//! fine enough under any tone curve and exact in 16 bits.

mod counters;
mod metadata;
#[cfg(test)]
mod tests;

use std::sync::OnceLock;

use glam::{DMat3, DVec3};
use moxcms::{
    CicpColorPrimaries, CicpProfile, ColorProfile, DataColorSpace, MatrixCoefficients, ProfileText,
    ToneReprCurve, TransferCharacteristics,
};
use rayon::prelude::*;

pub(super) use self::metadata::Chromaticities;
use self::metadata::{MAX_BYTES, Statement, statements};
use super::{Image, linear_from_srgb, srgb_from_linear};
pub use counters::ColourCounts;

/// The result of a conversion.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Conversion {
    /// The original colour space, and the fraction of pixels outside sRGB; `None` if the values are sRGB as stored, or
    /// assumed to be.
    pub from: Option<(String, f64)>,
    /// Metadata that cannot be used, in words.
    pub unknown: Option<String>,
}

/// How much two matrices between linear colours may differ by the rounding of files.
const ROUNDING: f64 = 2e-3;
/// Quantisation levels of converted values.
const LEVELS: f32 = 65_535.0;

/// Converts a decoded image to sRGB by the metadata of its file.
pub(super) fn convert(image: &mut Image, bytes: &[u8]) -> Conversion {
    let converter = Converter::of_file(bytes);
    let count = image.pixel_count();
    let (red, rest) = image.data.split_at_mut(count);
    let (green, blue) = rest.split_at_mut(count);
    let [red, green, blue] = [red, green, blue].map(|plane| plane.par_chunks_mut(1 << 14));
    let parts = red.zip(green).zip(blue);
    let outside = parts.map(|((red, green), blue)| converter.apply([red, green, blue])).sum();
    converter.conversion(outside, count)
}

/// Converts parts of an image to sRGB.
pub(super) struct Converter {
    /// The colour space, if it is not sRGB, with the linear light of every value of an 8- or 16-bit file by channel.
    space: Option<(ColourSpace, [Vec<f32>; 3])>,
    unknown: Option<String>,
}

impl Converter {
    /// By the metadata of a file.
    pub(super) fn of_file(bytes: &[u8]) -> Self {
        let mut unknown = None;
        for statement in statements(bytes) {
            match ColourSpace::from_statement(&statement) {
                Ok(space) => {
                    let space = space.map(|space| {
                        let tables = space.tables();
                        (space, tables)
                    });
                    return Self { space, unknown };
                }
                Err(problem) => unknown = unknown.or(Some(problem)),
            }
        }
        Self { space: None, unknown }
    }

    /// Converts pixels and clamps them; returns how many are outside sRGB.
    pub(super) fn apply(&self, planes: [&mut [f32]; 3]) -> usize {
        self.space.as_ref().map_or(0, |(space, tables)| space.apply(tables, planes))
    }

    /// What was done to an image of `pixels` pixels.
    pub(super) fn conversion(self, outside: usize, pixels: usize) -> Conversion {
        let part = outside as f64 / pixels.max(1) as f64;
        Conversion { from: self.space.map(|(space, _)| (space.name, part)), unknown: self.unknown }
    }
}

/// Converts linear light of other primaries to those of sRGB. Negative values are kept: those of noise at black, and of
/// colours outside sRGB.
pub(super) fn convert_linear(image: &mut Image, chromaticities: Chromaticities) -> Conversion {
    /// A code value of 8 bits near black.
    const MARGIN: f64 = 1.0 / 255.0 / 12.92;
    let Some(matrix) = to_srgb(chromaticities) else {
        let unknown = Some("invalid chromaticities".to_owned());
        return Conversion { from: None, unknown };
    };
    if matrix.abs_diff_eq(DMat3::IDENTITY, ROUNDING) {
        return Conversion::default();
    }
    let count = image.pixel_count();
    let mut outside = 0;
    for at in 0..count {
        let stored =
            DVec3::from_array([0, 1, 2].map(|plane| f64::from(image.data[plane * count + at])));
        if !stored.is_finite() {
            continue;
        }
        let linear = matrix * stored;
        outside += usize::from(linear.min_element() < -MARGIN);
        for (plane, value) in linear.to_array().into_iter().enumerate() {
            image.data[plane * count + at] = value as f32;
        }
    }
    let name = known_name(matrix).unwrap_or("other primaries").to_owned();
    Conversion { from: Some((name, outside as f64 / count.max(1) as f64)), unknown: None }
}

/// The matrix from linear light of these primaries to that of sRGB; `None` if the chromaticities are invalid.
fn to_srgb(chromaticities: Chromaticities) -> Option<DMat3> {
    from_d50(to_d50(chromaticities))
}

/// The matrix to linear sRGB from colorants in XYZ at D50, as in a profile.
fn from_d50(colorants: DMat3) -> Option<DMat3> {
    const D65: [f64; 2] = [0.3127, 0.3290];
    const SRGB: Chromaticities = [D65, [0.64, 0.33], [0.30, 0.60], [0.15, 0.06]];
    let result = to_d50(SRGB).inverse() * colorants;
    (result.is_finite() && result.determinant().abs() > 1e-6).then_some(result)
}

/// XYZ at D50 of linear red, green and blue, adapted by Bradford's matrix (ICC.1:2022, annex E).
fn to_d50([white, red, green, blue]: Chromaticities) -> DMat3 {
    const BRADFORD: DMat3 = DMat3::from_cols(
        DVec3::new(0.8951, -0.7502, 0.0389),
        DVec3::new(0.2664, 1.7135, -0.0685),
        DVec3::new(-0.1614, 0.0367, 1.0296),
    );
    const D50: DVec3 = DVec3::new(0.9642, 1.0, 0.8249);
    let xyz = |[x, y]: [f64; 2]| DVec3::new(x / y, 1.0, (1.0 - x - y) / y);
    let primaries = DMat3::from_cols(xyz(red), xyz(green), xyz(blue));
    let luminances = primaries.inverse() * xyz(white);
    let adaptation = (BRADFORD * D50) / (BRADFORD * xyz(white));
    let adapted = BRADFORD.inverse() * DMat3::from_diagonal(adaptation) * BRADFORD;
    adapted * primaries * DMat3::from_diagonal(luminances)
}

/// The colorants of a profile.
fn colorants(profile: &ColorProfile) -> DMat3 {
    DMat3::from_cols_array_2d(&profile.colorant_matrix().v).transpose()
}

type Curve = Box<dyn Fn(f32) -> f32 + Send + Sync>;

/// A colour space that is converted to sRGB.
struct ColourSpace {
    name: String,
    /// From each channel to linear light.
    curves: [Curve; 3],
    /// From there to the linear light of sRGB.
    matrix: DMat3,
}

impl ColourSpace {
    /// `None` for sRGB.
    fn from_statement(statement: &Statement) -> Result<Option<Self>, String> {
        let space = match statement {
            Statement::Srgb => return Ok(None),
            Statement::AdobeRgb => Self::of_profile(&ColorProfile::new_adobe_rgb()),
            Statement::Profile(bytes) if bytes.len() as u64 > MAX_BYTES => {
                Err(format!("an ICC profile of more than {} MB", MAX_BYTES >> 20))
            }
            Statement::Profile(bytes) => {
                let profile = ColorProfile::new_from_slice(bytes);
                Self::of_profile(&profile.map_err(|_| "a damaged ICC profile".to_owned())?)
            }
            &Statement::CodePoints(points) => Self::of_code_points(points),
            &Statement::Primaries { chromaticities, exponent } => {
                Self::of_primaries(chromaticities, exponent)
            }
            Statement::Unknown(problem) => Err(problem.clone()),
        };
        space.map(|space| (!space.is_srgb()).then_some(space))
    }

    fn of_profile(profile: &ColorProfile) -> Result<Self, String> {
        let name =
            description(profile).unwrap_or_else(|| "an ICC profile without a name".to_owned());
        let unusable = |why: &str| format!("the ICC profile {name} ({why})");
        let curve = |curve: &Option<ToneReprCurve>| {
            let evaluator = curve.as_ref()?.make_linear_evaluator().ok()?;
            Some(Box::new(move |value: f32| evaluator.evaluate_value(value)) as Curve)
        };
        let curves = |curves: [&Option<ToneReprCurve>; 3]| {
            let [red, green, blue] = curves.map(curve);
            Some([red?, green?, blue?])
        };
        let risen = |curves: [Curve; 3]| match curves.iter().all(rises) {
            true => Ok(curves),
            false => Err(unusable("its curve does not rise from 0 to 1")),
        };
        match profile.color_space {
            DataColorSpace::Gray => {
                let curves = curves([&profile.gray_trc; 3]).ok_or_else(|| unusable("no curve"))?;
                let curves = risen(curves)?;
                Ok(Self { name, curves, matrix: DMat3::IDENTITY })
            }
            DataColorSpace::Rgb => {
                let matrix =
                    profile.is_matrix_shaper().then(|| from_d50(colorants(profile))).flatten();
                let curves = curves([&profile.red_trc, &profile.green_trc, &profile.blue_trc]);
                let (matrix, curves) =
                    matrix.zip(curves).ok_or_else(|| unusable("no matrix and curves"))?;
                let curves = risen(curves)?;
                // If the primaries are sRGB's and the curve is another, their name says nothing.
                let standard = known_name(matrix).filter(|standard| *standard != "sRGB");
                Ok(Self { name: standard.map_or(name, str::to_owned), curves, matrix })
            }
            other => Err(unusable(&format!("for {other:?}, not for RGB"))),
        }
    }

    fn of_code_points(points: [u8; 4]) -> Result<Self, String> {
        let unusable = |why: &str| format!("the code points {points:?} of a cICP chunk ({why})");
        let [primaries, transfer, matrix, range] = points;
        if matrix != 0 || range != 1 {
            return Err(unusable("no RGB of full range"));
        }
        let color_primaries = CicpColorPrimaries::try_from(primaries).ok();
        let transfer = TransferCharacteristics::try_from(transfer).ok();
        let (Some(color_primaries), Some(transfer)) = (color_primaries, transfer) else {
            return Err(unusable("reserved"));
        };
        let is_srgb_curve = match transfer {
            TransferCharacteristics::Smpte2084 | TransferCharacteristics::Hlg => {
                return Err(unusable("high dynamic range"));
            }
            TransferCharacteristics::Reserved | TransferCharacteristics::Unspecified => {
                return Err(unusable("no transfer function"));
            }
            // Video is graded on a display, and players show it as if it were sRGB.
            TransferCharacteristics::Bt709
            | TransferCharacteristics::Bt601
            | TransferCharacteristics::Bt202010bit
            | TransferCharacteristics::Bt202012bit
            | TransferCharacteristics::Srgb => true,
            _ => false,
        };
        let matrix_coefficients = MatrixCoefficients::Identity;
        let profile = CicpProfile {
            color_primaries,
            transfer_characteristics: transfer,
            matrix_coefficients,
            full_range: true,
        };
        let matrix = from_d50(colorants(&ColorProfile::new_from_cicp(profile)));
        let matrix = matrix.ok_or_else(|| unusable("unknown primaries"))?;
        let curve = |_| match is_srgb_curve {
            true => srgb_curve(),
            false => Box::new(move |value: f32| transfer.linearize(f64::from(value)) as f32),
        };
        let standard = known_name(matrix).filter(|standard| *standard != "sRGB");
        let name = standard.map_or_else(|| format!("code points {points:?}"), str::to_owned);
        Ok(Self { name, curves: std::array::from_fn(curve), matrix })
    }

    fn of_primaries(
        chromaticities: Option<Chromaticities>,
        exponent: Option<f64>,
    ) -> Result<Self, String> {
        let matrix = match chromaticities {
            Some(chromaticities) => to_srgb(chromaticities).ok_or("invalid chromaticities")?,
            None => DMat3::IDENTITY,
        };
        let standard = known_name(matrix);
        // Without a chunk of its own, the curve of sRGB and Display P3 is written as 1/2.2; ffmpeg writes that of
        // video, which is shown as sRGB, as 1/1.961.
        let is_srgb_curve = |exponent: &f64| {
            let is_near = |of: f64, by: f64| (exponent - of).abs() < by;
            is_near(1.961, 0.005)
                || is_near(2.2, 0.03) && [Some("sRGB"), Some("Display P3")].contains(&standard)
        };
        let exponent = exponent.filter(|exponent| !is_srgb_curve(exponent));
        let curve = |_| match exponent {
            Some(exponent) => {
                Box::new(move |value: f32| value.max(0.0).powf(exponent as f32)) as Curve
            }
            None => srgb_curve(),
        };
        let primaries = standard.unwrap_or("other primaries");
        let name = match exponent {
            Some(exponent) if standard != Some("Adobe RGB") => {
                format!("{primaries} at gamma {exponent:.2}")
            }
            _ => primaries.to_owned(),
        };
        Ok(Self { name, curves: std::array::from_fn(curve), matrix })
    }

    /// Whether its primaries equal sRGB's up to rounding, and no grey changes by more than an 8-bit code value.
    fn is_srgb(&self) -> bool {
        let moves = |code: u8| {
            let grey = f32::from(code) / 255.0;
            let converted = self.encoded(self.curves.each_ref().map(|curve| curve(grey)));
            converted.iter().any(|value| (value - grey).abs() > 1.0 / 255.0)
        };
        self.matrix.abs_diff_eq(DMat3::IDENTITY, ROUNDING) && !(0..=255).any(moves)
    }

    /// The sRGB encoding of linear light in this space, unclamped.
    fn encoded(&self, linear: [f32; 3]) -> [f32; 3] {
        let linear = self.matrix * DVec3::from_array(linear.map(f64::from));
        linear.to_array().map(|value| srgb_from_linear(value as f32))
    }

    /// The linear light of every value of an 8- or 16-bit file, by channel.
    fn tables(&self) -> [Vec<f32>; 3] {
        let levels = || (0..=LEVELS as u32).map(|level| level as f32 / LEVELS);
        self.curves.each_ref().map(|curve| levels().map(curve).collect())
    }

    /// Converts pixels and clamps them; returns how many are outside sRGB.
    fn apply(&self, tables: &[Vec<f32>; 3], [red, green, blue]: [&mut [f32]; 3]) -> usize {
        /// A value farther beyond 0 or 1 is not due to rounding.
        const MARGIN: f32 = 1.0 / 255.0;
        // Written so that a NaN is outside.
        let is_held = |value: &f32| (-MARGIN..=1.0 + MARGIN).contains(value);
        let mut outside = 0;
        for ((red, green), blue) in red.iter_mut().zip(green).zip(blue) {
            let mut pixel = [red, green, blue];
            let linear =
                |channel: usize| tables[channel][(*pixel[channel] * LEVELS).round() as usize];
            let converted = self.encoded([linear(0), linear(1), linear(2)]);
            outside += usize::from(!converted.iter().all(is_held));
            for (value, converted) in pixel.iter_mut().zip(converted) {
                let inside = if converted > 0.0 { converted.min(1.0) } else { 0.0 };
                **value = (inside * LEVELS).round() / LEVELS;
            }
        }
        outside
    }
}

/// Whether a curve rises from black to white, up to the offset of a display's black.
fn rises(curve: &Curve) -> bool {
    const OFFSET: f32 = 0.1;
    let levels: Vec<f32> = (0..=255).map(|level| curve(level as f32 / 255.0)).collect();
    let is_rising = levels.windows(2).all(|pair| pair[1] >= pair[0] - 1.0 / 255.0);
    is_rising && levels[0] <= OFFSET && levels[255] >= 1.0 - OFFSET
}

fn srgb_curve() -> Curve {
    Box::new(linear_from_srgb)
}

/// The description of a profile, in quotes.
fn description(profile: &ColorProfile) -> Option<String> {
    const MOST: usize = 60;
    let text = match profile.description.as_ref()? {
        ProfileText::PlainString(text) => text,
        ProfileText::Localizable(texts) => &texts.first()?.value,
        ProfileText::Description(text) => &text.ascii_string,
    };
    let text: String =
        text.chars().filter(|character| !character.is_control()).take(MOST).collect();
    let text = text.trim();
    (!text.is_empty()).then(|| format!("\"{text}\""))
}

/// The name of the colour space with these primaries, from the matrix to linear sRGB.
fn known_name(matrix: DMat3) -> Option<&'static str> {
    static KNOWN: OnceLock<[(&str, Option<DMat3>); 5]> = OnceLock::new();
    let spaces = KNOWN.get_or_init(|| {
        let profiles = [
            ("sRGB", ColorProfile::new_srgb()),
            ("Display P3", ColorProfile::new_display_p3()),
            ("Adobe RGB", ColorProfile::new_adobe_rgb()),
            ("ProPhoto RGB", ColorProfile::new_pro_photo_rgb()),
            ("Rec. 2020", ColorProfile::new_bt2020()),
        ];
        profiles.map(|(name, profile)| (name, from_d50(colorants(&profile))))
    });
    let is_near = |primaries: Option<DMat3>| {
        primaries.is_some_and(|primaries| primaries.abs_diff_eq(matrix, 0.01))
    };
    spaces.iter().find(|(_, primaries)| is_near(*primaries)).map(|(name, _)| *name)
}
