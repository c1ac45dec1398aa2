//! White balance set by the user: a gain for each channel of the photographs, and a matrix from a colour chart.
//!
//! ```text
//! x' = encode(M g decode(x))      g: gains; M: a chart's matrix; decode, encode: sRGB transfer functions
//! ```
//!
//! The illuminant multiplies linear light, and so do the gains (von Kries), before measurements and before the tone
//! curve: after a curve, a colour cast would depend on brightness. Values beyond 0 and 1 are kept until the curve clips
//! them.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use glam::{DMat3, DVec3, Mat3, Vec3};
use nightsplat_core::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::colour_chart::{self, FIRST_GREY, LUMINANCE, homography};
use super::image::{ColourCounts, Image, Levels, linear_from_srgb, srgb_from_linear};
use crate::image::ImageFile as _;

/// The source of the white balance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum WhiteBalance {
    /// Gains of red, green and blue in linear light.
    Gains([f64; 3]),
    /// The colour temperature of the illuminant, kelvin; 6504 changes nothing.
    Kelvin(f64),
    /// A grey card or another neutral area of a photograph as stored: the view, then x, y, width and height in pixels.
    Area(String, [u32; 4]),
    /// A chart of 6 x 4 patches (ColorChecker): the view, then the corners of the chart as stored, at the dark skin,
    /// bluish green, black and white patch, x and y in pixels.
    Chart(String, [[f64; 2]; 4]),
}

/// The map of linear light: a row for each of red, green and blue of the balanced photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WhiteBalanceMatrix(pub [[f32; 3]; 3]);

/// Colour temperatures within the range of the Planckian locus's approximation and the gamut of sRGB, kelvin.
const TEMPERATURES: std::ops::RangeInclusive<f64> = 2000.0..=25_000.0;
/// The temperature of D65, for which nothing changes.
const NEUTRAL: f64 = 6504.0;
/// Plausible gains.
const GAINS: std::ops::RangeInclusive<f64> = 1e-3..=1e3;

impl WhiteBalance {
    /// The syntax of a white balance.
    #[doc(hidden)]
    pub const FORM: &'static str = "R,G,B of 0.001 to 1000, a colour temperature of 2000 to 25000 (kelvin), \
        VIEW,x,y,w,h of a neutral area in whole pixels, or VIEW,x1,y1,..,x4,y4, the corners of a colour chart";

    /// The matrix, measured in one of the named photographs of `root`, of these levels, if necessary.
    #[doc(hidden)]
    pub fn matrix<'a>(
        &self,
        root: &Path,
        photographs: impl IntoIterator<Item = (&'a str, &'a Path)>,
        levels: Levels,
    ) -> Result<WhiteBalanceMatrix> {
        let of_gains = |gains| Ok(WhiteBalanceMatrix::new(DMat3::from_diagonal(gains)));
        let view = match self {
            Self::Gains(gains) => return of_gains(DVec3::from_array(*gains)),
            Self::Kelvin(kelvin) => return of_gains(neutralising(light(*kelvin) / light(NEUTRAL))),
            Self::Area(view, _) | Self::Chart(view, _) => view,
        };
        let is_called = |(name, path): &(&str, &Path)| {
            *name == view || path.file_name().is_some_and(|file| file == view.as_str())
        };
        let (_, path) = photographs.into_iter().find(is_called).ok_or_else(|| {
            let problem = format!(
                "white balance {self}: no photograph is called `{view}`; name a view or its file"
            );
            Error::input(root, problem)
        })?;
        let photograph = Image::load_counted(path, &ColourCounts::of_levels(levels))?;
        let patches = self.light(&photograph)?;
        let gains = neutralising(self.neutral(&patches)?);
        let colours = match self {
            Self::Chart(..) => self.colours(&patches, gains)?,
            _ => DMat3::IDENTITY,
        };
        let rows = colours.transpose();
        tracing::info!(
            "white balance from view {view}: gains {gains:.3} in linear light{}",
            if colours == DMat3::IDENTITY {
                String::new()
            } else {
                format!(
                    "; red {:.2}, green {:.2}, blue {:.2} of the balanced channels, by the colours of the chart",
                    rows.x_axis, rows.y_axis, rows.z_axis
                )
            }
        );
        Ok(WhiteBalanceMatrix::new(colours * DMat3::from_diagonal(gains)))
    }

    /// The mean linear light of each patch and the number of its pixels; `None` for one that is mostly clipped.
    fn light(&self, image: &Image) -> Result<Vec<Option<(DVec3, f64)>>> {
        /// Brighter values are clipped or almost clipped.
        const CLIPPED: f32 = 0.98;
        let pixels = self.pixels();
        let is_inside = |&[x, y]: &[u32; 2]| x < image.width && y < image.height;
        if !pixels.iter().flatten().all(is_inside) {
            let (width, height) = (image.width, image.height);
            return self.refused(&format!(
                "it exceeds the photograph, which is {width}x{height} as stored"
            ));
        }
        let mean = |patch: &Vec<[u32; 2]>| {
            let colours = patch.iter().map(|&[x, y]| image.pixel(x, y));
            let usable = |colour: &[f32; 3]| colour.iter().all(|value| *value < CLIPPED);
            let light = |colour: [f32; 3]| {
                DVec3::from_array(colour.map(|value| f64::from(linear_from_srgb(value))))
            };
            let colours: Vec<DVec3> = colours.filter(usable).map(light).collect();
            let count = colours.len() as f64;
            // The rest of a partly clipped patch would be biased to its dark pixels.
            (2 * colours.len() >= patch.len())
                .then(|| (colours.into_iter().sum::<DVec3>() / count, count))
        };
        Ok(pixels.iter().map(mean).collect())
    }

    /// The mean linear light of the neutral patches.
    fn neutral(&self, patches: &[Option<(DVec3, f64)>]) -> Result<DVec3> {
        /// A lower mean is black: half an 8-bit code value.
        const BLACK: f64 = 0.5 / 255.0 / 12.92;
        let greys = match self {
            Self::Chart(..) => &patches[FIRST_GREY..],
            _ => patches,
        };
        let sums = greys.iter().flatten().map(|&(mean, count)| (mean * count, count));
        let (sum, count) =
            sums.fold((DVec3::ZERO, 0.0), |sum, next| (sum.0 + next.0, sum.1 + next.1));
        if count == 0.0 {
            return self.refused("it is clipped; choose an area that is not white");
        }
        let mean = sum / count;
        if mean.min_element() < BLACK {
            return self.refused("a channel of it is black; choose a brighter area");
        }
        Ok(mean)
    }

    /// The matrix of the colours of a chart.
    fn colours(&self, patches: &[Option<(DVec3, f64)>], gains: DVec3) -> Result<DMat3> {
        let light: Vec<_> = patches.iter().map(|patch| patch.map(|(mean, _)| mean)).collect();
        let greys = light[FIRST_GREY..].iter().flatten().map(|light| light.dot(LUMINANCE));
        if !greys.is_sorted_by(|brighter, darker| brighter >= darker) {
            return self.refused(
                "its greys do not darken from white to black; give the corners at dark skin, bluish green, black and \
                 white, in pixels as stored",
            );
        }
        let matrix = colour_chart::matrix(&light, gains);
        if matrix.is_none() {
            tracing::warn!("white balance {self}: most patches are clipped: gains alone");
        }
        Ok(matrix.unwrap_or(DMat3::IDENTITY))
    }

    fn refused<T>(&self, problem: &str) -> Result<T> {
        Err(Error::Usage(format!("white balance {self}: {problem}")))
    }

    /// The pixels of each patch, column and row; they may be outside the photograph.
    fn pixels(&self) -> Vec<Vec<[u32; 2]>> {
        match self {
            Self::Gains(_) | Self::Kelvin(_) => vec![],
            Self::Area(_, [x, y, width, height]) => {
                let column = |x: u32| (*y..y.saturating_add(*height)).map(move |y| [x, y]);
                vec![(*x..x.saturating_add(*width)).flat_map(column).collect()]
            }
            Self::Chart(_, corners) => colour_chart::patches(*corners),
        }
    }
}

/// The linear sRGB of a black body (Kang et al. 2002), with luminance 1.
fn light(kelvin: f64) -> DVec3 {
    let t = 1e3 / kelvin;
    let x = if kelvin <= 4000.0 {
        ((-0.266_123_9 * t - 0.234_358_9) * t + 0.877_695_6) * t + 0.179_910
    } else {
        ((-3.025_846_9 * t + 2.107_037_9) * t + 0.222_634_7) * t + 0.240_390
    };
    let y = if kelvin <= 2222.0 {
        ((-1.106_381_4 * x - 1.348_110_2) * x + 2.185_558_32) * x - 0.202_196_83
    } else if kelvin <= 4000.0 {
        ((-0.954_947_6 * x - 1.374_185_93) * x + 2.091_370_15) * x - 0.167_488_67
    } else {
        ((3.081_758_0 * x - 5.873_386_7) * x + 3.751_129_97) * x - 0.370_014_83
    };
    // IEC 61966-2-1.
    let from_xyz = DMat3::from_cols(
        DVec3::new(3.2406, -0.9689, 0.0557),
        DVec3::new(-1.5372, 1.8758, -0.2040),
        DVec3::new(-0.4986, 0.0415, 1.0570),
    );
    from_xyz * DVec3::new(x / y, 1.0, (1.0 - x - y) / y)
}

/// The gains that make a colour grey and keep its luminance.
fn neutralising(linear: DVec3) -> DVec3 {
    linear.dot(LUMINANCE) / linear
}

impl WhiteBalanceMatrix {
    fn new(matrix: DMat3) -> Self {
        let rows = matrix.transpose().as_mat3();
        Self([rows.x_axis, rows.y_axis, rows.z_axis].map(|row| row.to_array()))
    }

    /// Applies the matrix to a photograph.
    pub fn apply(self, image: &mut Image) {
        /// Values per task of a thread.
        const VALUES: usize = 1 << 14;
        let pixels = image.pixel_count();
        if pixels == 0 {
            return;
        }
        let Self([red, green, blue]) = self;
        let gains = [red[0], green[1], blue[2]];
        if self == Self::new(DMat3::from_diagonal(Vec3::from_array(gains).as_dvec3())) {
            for (plane, gain) in image.data.chunks_exact_mut(pixels).zip(gains) {
                if gain == 1.0 {
                    continue;
                }
                let balance =
                    |value: &mut f32| *value = srgb_from_linear(gain * linear_from_srgb(*value));
                plane.par_chunks_mut(VALUES).for_each(|values| values.iter_mut().for_each(balance));
            }
            return;
        }
        let (reds, rest) = image.data.split_at_mut(pixels);
        let (greens, blues) = rest.split_at_mut(pixels);
        let map = Mat3::from_cols(red.into(), green.into(), blue.into()).transpose();
        let chunks = |plane| <[f32]>::par_chunks_mut(plane, VALUES);
        (chunks(reds), chunks(greens), chunks(blues)).into_par_iter().for_each(
            |(reds, greens, blues)| {
                for ((red, green), blue) in reds.iter_mut().zip(greens).zip(blues) {
                    let light = Vec3::from_array([*red, *green, *blue].map(linear_from_srgb));
                    [*red, *green, *blue] = (map * light).to_array().map(srgb_from_linear);
                }
            },
        );
    }
}

impl FromStr for WhiteBalance {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        parsed(text).ok_or_else(|| {
            let (key, value) = ("white_balance".to_owned(), text.to_owned());
            Error::Setting { key, value, rule: Self::FORM.to_owned() }
        })
    }
}

fn parsed(text: &str) -> Option<WhiteBalance> {
    let fields: Vec<&str> = text.split(',').map(str::trim).collect();
    let numbers: Option<Vec<f64>> = fields.iter().map(|field| field.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[kelvin]) => {
            return TEMPERATURES.contains(&kelvin).then_some(WhiteBalance::Kelvin(kelvin));
        }
        Some(&[red, green, blue]) => {
            let gains = [red, green, blue];
            let are_plausible = gains.iter().all(|gain| GAINS.contains(gain));
            return are_plausible.then_some(WhiteBalance::Gains(gains));
        }
        _ => {}
    }
    // A view's name may contain commas, or be a number.
    let numbers_after_view = |count: usize| {
        let (view, rest) = fields.split_at_checked(fields.len().checked_sub(count)?)?;
        let numbers: Option<Vec<f64>> = rest.iter().map(|field| field.parse().ok()).collect();
        (!view.concat().is_empty()).then_some((view.join(","), numbers?))
    };
    if let Some((view, numbers)) = numbers_after_view(8) {
        let [a, b, c, d] = *numbers.as_chunks::<2>().0 else { return None };
        let is_chart = homography([a, b, c, d]).is_finite();
        return is_chart.then_some(WhiteBalance::Chart(view, [a, b, c, d]));
    }
    let (view, numbers) = numbers_after_view(4)?;
    // No photograph is larger; areas are listed pixel by pixel.
    let is_whole = |number: &f64| (0.0..=65_536.0).contains(number) && number.fract() == 0.0;
    let [x, y, width, height] = *numbers else { return None };
    let is_area = numbers.iter().all(is_whole) && width > 0.0 && height > 0.0;
    is_area.then(|| WhiteBalance::Area(view, [x, y, width, height].map(|number| number as u32)))
}

impl fmt::Display for WhiteBalance {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let listed =
            |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
        match self {
            Self::Gains(gains) => out.write_str(&listed(gains)),
            Self::Kelvin(kelvin) => write!(out, "{kelvin}"),
            Self::Area(view, [x, y, width, height]) => {
                write!(out, "{view},{x},{y},{width},{height}")
            }
            Self::Chart(view, corners) => write!(out, "{view},{}", listed(corners.as_flattened())),
        }
    }
}

impl TryFrom<String> for WhiteBalance {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<WhiteBalance> for String {
    fn from(balance: WhiteBalance) -> Self {
        balance.to_string()
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    /// A photograph of a reflectance under a light, in linear light.
    fn lit(light: [f32; 3], reflectance: impl Fn(u32, u32) -> f32) -> Image {
        Image::from_fn(60, 40, |x, y| {
            light.map(|light| srgb_from_linear(light * reflectance(x, y)))
        })
    }

    fn saved(image: &Image) -> (PathBuf, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("v1.png");
        image.save_png16(&path).unwrap();
        (path, folder)
    }

    fn matrix(text: &str, image: &Image) -> Result<WhiteBalanceMatrix> {
        let (path, _folder) = saved(image);
        let balance: WhiteBalance = text.parse().unwrap();
        balance.matrix(Path::new("photos"), [("v1", path.as_path())], Levels::default())
    }

    /// Ratio of the largest to the smallest channel of a pixel in linear light.
    fn cast(image: &Image, x: u32, y: u32) -> f32 {
        let colour = image.pixel(x, y).map(linear_from_srgb);
        colour.iter().copied().fold(0.0, f32::max) / colour.iter().copied().fold(1.0, f32::min)
    }

    #[test]
    fn a_grey_card_makes_every_grey_neutral_and_keeps_its_luminance() {
        let mut image = lit([0.06, 0.03, 0.015], |x, y| 0.1 + 0.8 * ((x + y) as f32 / 98.0));
        matrix("v1,20,10,4,4", &image).unwrap().apply(&mut image);
        for (x, y) in [(0, 0), (30, 20), (59, 39)] {
            assert!(cast(&image, x, y) < 1.002, "{:?}", image.pixel(x, y));
        }
        let weights = [0.2126, 0.7152, 0.0722];
        let before: f32 =
            [0.06, 0.03, 0.015].iter().zip(weights).map(|(light, weight)| light * weight).sum();
        let grey = linear_from_srgb(image.pixel(59, 39)[0]);
        assert!((grey / (0.9 * before) - 1.0).abs() < 2e-3, "{grey} {before}");
    }

    #[test]
    fn a_chart_in_perspective_makes_its_greys_neutral_and_a_mirrored_one_is_refused() {
        // Only the greys of the chart are neutral under the light.
        let corners = [[10.0, 5.0], [50.0, 8.0], [46.0, 32.0], [14.0, 35.0]];
        let map = homography(corners).inverse();
        let light = [0.3, 0.2, 0.1];
        let mut image = Image::from_fn(60, 40, |x, y| {
            let position = map * DVec3::new(f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0);
            let [u, v] = [position.x / position.z, position.y / position.z];
            let is_grey = (0.75..1.0).contains(&v) && (0.0..1.0).contains(&u);
            let grey = [0.9, 0.6, 0.36, 0.2, 0.09, 0.03][((6.0 * u) as usize).min(5)];
            light.map(|light: f32| srgb_from_linear(if is_grey { light * grey } else { 0.5 }))
        });
        let listed: Vec<String> = corners.as_flattened().iter().map(f64::to_string).collect();
        matrix(&format!("v1,{}", listed.join(",")), &image).unwrap().apply(&mut image);
        for patch in 0..6 {
            let centre =
                homography(corners) * DVec3::new((f64::from(patch) + 0.5) / 6.0, 3.5 / 4.0, 1.0);
            let [x, y] = [centre.x, centre.y].map(|at| (at / centre.z) as u32);
            assert!(cast(&image, x, y) < 1.01, "{patch}: {:?}", image.pixel(x, y));
        }

        let mirrored = [1, 0, 3, 2].map(|corner| corners[corner]);
        let listed: Vec<String> = mirrored.as_flattened().iter().map(f64::to_string).collect();
        let message = matrix(&format!("v1,{}", listed.join(",")), &image).unwrap_err().to_string();
        assert!(
            message.contains("greys do not darken") && message.lines().count() == 1,
            "{message}"
        );
    }

    #[test]
    fn a_matrix_mixes_channels_of_linear_light_below_black_too() {
        let mut image = lit([0.06, 0.03, 0.015], |x, y| (x + y) as f32 / 98.0 - 0.1);
        let before = image.clone();
        let rows = [[1.5, -0.5, 0.0], [0.1, 0.8, 0.1], [-0.2, 0.0, 1.2]];
        WhiteBalanceMatrix(rows).apply(&mut image);
        for (x, y) in [(0, 0), (30, 20), (59, 39)] {
            let [before, after] =
                [&before, &image].map(|image| image.pixel(x, y).map(linear_from_srgb));
            for (row, after) in rows.iter().zip(after) {
                let mixed: f32 = row.iter().zip(before).map(|(weight, light)| weight * light).sum();
                assert!((mixed - after).abs() < 1e-6, "{mixed} {after}");
            }
        }
    }

    #[test]
    fn gains_neutralise_the_light_of_a_temperature() {
        let of = |kelvin: f64| {
            let balance = WhiteBalance::Kelvin(kelvin);
            let rows = balance.matrix(Path::new(""), [], Levels::default()).unwrap().0;
            [rows[0][0], rows[1][1], rows[2][2]]
        };
        assert!(of(6504.0).iter().all(|gain| (gain - 1.0).abs() < 1e-3), "{:?}", of(6504.0));
        // Illuminant A, 2856 K: x = 0.44757, y = 0.40745, relative to D65.
        let [red, green, blue] = of(2856.0);
        let (x, y) = (0.447_57, 0.407_45);
        let xyz = [x / y, 1.0, (1.0 - x - y) / y];
        let linear = [
            3.2406 * xyz[0] - 1.5372 - 0.4986 * xyz[2],
            -0.9689 * xyz[0] + 1.8758 + 0.0415 * xyz[2],
            0.0557 * xyz[0] - 0.2040 + 1.0570 * xyz[2],
        ];
        let expected = [linear[1] / linear[0], linear[1] / linear[2]];
        for (found, expected) in [red / green, blue / green].into_iter().zip(expected) {
            // D65 is not on the Planckian locus.
            assert!((found / expected - 1.0).abs() < 0.08, "{found} {expected}");
        }
        assert!(of(10_000.0)[0] > 1.0 && of(10_000.0)[2] < 1.0);
    }

    #[test]
    fn gains_of_one_keep_every_bit() {
        let image = lit([0.06, 0.03, 0.015], |x, _| x as f32 / 60.0);
        let mut balanced = image.clone();
        WhiteBalanceMatrix::new(DMat3::IDENTITY).apply(&mut balanced);
        assert_eq!(balanced, image);
        WhiteBalanceMatrix::new(DMat3::from_diagonal(DVec3::new(1.0, 1.0, 2.0)))
            .apply(&mut balanced);
        assert_eq!(balanced.data[..2 * 2400], image.data[..2 * 2400]);
    }

    #[test]
    fn a_written_white_balance_is_read_back() {
        let all = "1.5,1,0.8 5200 v1,1,2,30,40 a,b,1,2,3,4 007,1,2,3,4 v1,1,2,30.5,2,31,40,0,39";
        for text in all.split(' ') {
            let balance: WhiteBalance = text.parse().unwrap();
            assert_eq!(balance.to_string(), text);
        }
    }

    #[test]
    fn an_invalid_white_balance_is_refused_in_a_line() {
        let all = " 1,2 0,1,1 -1,1,1 NaN,1,1 inf,1,1 1500 40000 1e5,1,1 v1,1,2,0,4 v1,-1,2,3,4 v1,1.5,2,3,4 \
                   v1,1,1,1,1,1,1,1,1 ,1,2,3,4 warm";
        for text in all.split(' ') {
            let message = text.parse::<WhiteBalance>().unwrap_err().to_string();
            assert!(
                message.starts_with("white_balance is ") && message.lines().count() == 1,
                "{text}: {message}"
            );
        }
        let image = lit([1.0, 0.5, 0.0], |x, _| if x < 30 { 0.0 } else { 2.0 });
        for (text, part) in [
            ("v2,1,2,3,4", "no photograph is called `v2`"),
            ("v1,58,2,3,4", "exceeds the photograph, which is 60x40"),
            ("v1,1,65536,3,4", "exceeds the photograph"),
            ("v1,-5,0,40,0,40,30,-5,30", "exceeds the photograph"),
            ("v1,1,2,3,4", "is black"),
            ("v1,40,2,3,4", "is clipped"),
        ] {
            let message = matrix(text, &image).unwrap_err().to_string();
            assert!(message.contains(part) && message.lines().count() == 1, "{text}: {message}");
        }
    }
}
