//! The levels of a set, from the values of all of its photographs together.
//!
//! - **16 bits, of which 10, 12 or 14 are used.** No value exceeds the largest code of these bits, and in half of the
//!   photographs the largest is in its last hundredth, where a sensor clips: dark photographs of the full scale end
//!   at any value. Or 99 % of every photograph is below 2 of 255, black if it were encoded: then of the numbers of
//!   bits that hold all values, that by which the median is nearest to that of dark photographs. Multiples of 257 are
//!   8 bits, and are as dark as they say.
//! - **16 bits, of which a few per cent are used, far from black**, as thermal cameras count hundredths of kelvin:
//!   the range is stretched, since its lower end is no black.
//! - **8 bits of the range of video**, 16 to 235: no value is outside, and in most photographs the smallest is
//!   exactly 16. Fog has another smallest value in every photograph.
//! - **Floats of another unit**, such as cd/m2: most values exceed 1. Their median becomes that of a dark photograph,
//!   whose brightness the tone curve chooses.
//!
//! A set has one scale. Some of its photographs are looked at, most often one, which shows that the set is as its
//! format says; while all are decoded, a value beyond the levels shows that it is after all.

use std::ops::ControlFlow;
use std::path::Path;

use rayon::prelude::*;

use super::MIDDLE_GREY;
use super::decode::PictureFile;
use super::files::is_raw;
use super::levels::{FoundLevels, Levels, SampleFormat, StoredLight};

/// Photographs that are looked at, of a set in question, and how many have to agree by more than chance.
const LOOKED_AT: usize = 8;
const NEEDED: usize = 3;
/// About how many values of a photograph are sorted for its quantiles.
const QUANTILES_OF: usize = 1 << 16;
/// The range of video in 8 bits.
const VIDEO: [f32; 2] = [16.0, 235.0];
/// Bits of sensors, of files of 16.
const SENSOR_BITS: [u32; 3] = [10, 12, 14];
/// A sensor clips in this last part of its scale.
const TOP: f32 = 0.01;
/// A photograph whose 99 % quantile is lower is almost black if it is encoded, as a part of the scale.
const ENCODED_BLACK: f32 = 2.0 / 255.0;
/// At most this part of the scale of 16 bits is a narrow range, if it lies farther from 0 than it is wide.
const NARROW: f32 = 0.05;
/// The median of a dark photograph in linear light. Four times as much costs 3 dB: dark contrasts lie where the
/// encoding bends.
const DARK: f32 = MIDDLE_GREY / 40.0;

impl Levels {
    /// The levels of a set, from some of its photographs, each with its file if that is already read; `srgb` says that
    /// they are as stored.
    pub fn of_set<'a>(
        light: Option<StoredLight>,
        photographs: impl IntoIterator<Item = (&'a Path, Option<&'a PictureFile>)>,
    ) -> Self {
        let plain = Self::as_stored(light);
        if light == Some(StoredLight::Srgb) {
            return plain;
        }
        // A sensor's file states its levels.
        let photographs = photographs.into_iter().filter(|(path, _)| !is_raw(path));
        let photographs: Vec<_> = photographs.collect();
        let step = photographs.len().div_ceil(LOOKED_AT).max(1);
        let mut looks: Vec<PhotographLevels> = vec![];
        for (path, read) in photographs.into_iter().step_by(step) {
            // What cannot be read is named when it is decoded.
            let Some(look) = PhotographLevels::of_file(path, read) else { continue };
            if looks.first().is_some_and(|first| first.format != look.format) || look.is_plain() {
                return plain;
            }
            looks.push(look);
        }
        Self { light, found: FoundLevels::of_photographs(&looks) }
    }

    /// [`Levels::of_set`], with every photograph looked at if their values are in question: for a set whose photographs
    /// are not decoded together.
    pub fn of_all(light: Option<StoredLight>, photographs: &[&Path]) -> Self {
        let levels = Self::of_set(light, photographs.iter().map(|path| (*path, None)));
        let Some(FoundLevels { black, white, are_limits: true, format }) = levels.found else {
            return levels;
        };
        let is_within = |path: &&Path| {
            let look = PhotographLevels::of_file(path, None).filter(|look| look.format == format);
            look.is_none_or(|look| look.least >= black && look.most <= white)
        };
        if photographs.par_iter().all(is_within) { levels } else { Self::as_stored(light) }
    }
}

/// The values of a photograph, in codes of its format.
#[derive(Clone, Copy, Debug)]
struct PhotographLevels {
    format: SampleFormat,
    least: f32,
    most: f32,
    /// The 0.1 %, 50 %, 99 % and 99.9 % quantiles.
    quantiles: [f32; 4],
    /// Whether every code is a multiple of 257, as 8 bits become 16.
    are_bytes: bool,
}

impl PhotographLevels {
    /// Photographs of 8 bits are read to the first value that shows that they are as their format says.
    fn of_file(path: &Path, read: Option<&PictureFile>) -> Option<Self> {
        let opened;
        let file = match read {
            Some(file) => file,
            None => {
                opened = PictureFile::open(path).ok()?;
                &opened
            }
        };
        let (mut format, mut codes) = (None, vec![]);
        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
        let mut look = |row: &[f32], of: SampleFormat, y: u32, (width, height): (u32, u32)| {
            format = Some(of);
            for &value in row {
                (least, most) = (value.min(least), value.max(most));
            }
            // Values at this distance, in the order of the planes.
            let [width, height, y] = [width, height, y].map(|side| side as usize);
            let step = (3 * width * height / QUANTILES_OF) | 1;
            for (plane, values) in row.chunks_exact(width.max(1)).enumerate() {
                let before = (plane * height + y) * width;
                codes.extend(values.iter().skip((step - before % step) % step).step_by(step));
            }
            let code = |x: f32| (x * of.largest()).round();
            let is_plain =
                of == SampleFormat::Eight && (code(least) < VIDEO[0] || code(most) > VIDEO[1]);
            if is_plain { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        file.show_as_stored(&mut look).ok()?;
        let format = format?;
        let code = |x: f32| match format {
            SampleFormat::Float => x,
            _ => (x * format.largest()).round(),
        };
        let mut codes: Vec<f32> = codes.into_iter().map(code).collect();
        codes.sort_unstable_by(f32::total_cmp);
        let last = codes.len().checked_sub(1)?;
        let quantile = |part: f64| codes[(part * last as f64) as usize];
        Some(Self {
            format,
            least: code(least),
            most: code(most),
            quantiles: [0.001, 0.5, 0.99, 0.999].map(quantile),
            are_bytes: codes.iter().all(|code| code % 257.0 == 0.0),
        })
    }

    /// Whether a set with this photograph is as its format says.
    fn is_plain(&self) -> bool {
        match self.format {
            SampleFormat::Eight => self.least < VIDEO[0] || self.most > VIDEO[1],
            SampleFormat::Sixteen => {
                let [low, _, _, high] = self.quantiles;
                self.are_bytes || self.most > largest_of(SENSOR_BITS[2]) && low <= NARROW * high
            }
            SampleFormat::Float => self.quantiles[1] <= 0.5,
        }
    }
}

fn largest_of(bits: u32) -> f32 {
    ((1_u32 << bits) - 1) as f32
}

impl FoundLevels {
    fn of_photographs(photographs: &[PhotographLevels]) -> Option<Self> {
        let format = photographs.first()?.format;
        let count = |is: &dyn Fn(&PhotographLevels) -> bool| {
            photographs.iter().filter(|one| is(one)).count()
        };
        let most = photographs.iter().fold(0.0, |most, one| one.most.max(most));
        let mut medians: Vec<f32> = photographs.iter().map(|one| one.quantiles[1]).collect();
        medians.sort_unstable_by(f32::total_cmp);
        let median = medians[medians.len() / 2];
        let has_several = photographs.len() >= NEEDED;
        let limits = |black, white| Some(Self { format, black, white, are_limits: true });
        match format {
            SampleFormat::Eight => {
                let reach_black = count(&|one| one.least < VIDEO[0] + 0.5);
                let is_video = has_several && 2 * reach_black > photographs.len();
                is_video.then(|| limits(VIDEO[0], VIDEO[1])).flatten()
            }
            SampleFormat::Sixteen => {
                let whites = SENSOR_BITS.into_iter().map(largest_of).filter(|white| most <= *white);
                let reached = whites.clone().next().filter(|white| {
                    let reach = count(&|one| one.most >= (1.0 - TOP) * white);
                    has_several && 2 * reach >= photographs.len()
                });
                let black = count(&|one| one.quantiles[2] < ENCODED_BLACK * format.largest());
                // As dark as dark photographs are.
                let off = |white: &f32| (median.max(0.5) / white / DARK).ln().abs();
                let usual = whites.min_by(|a, b| off(a).total_cmp(&off(b)));
                let white = reached.or(usual.filter(|_| black == photographs.len()));
                let low = photographs.iter().fold(f32::MAX, |low, one| one.quantiles[0].min(low));
                let high = photographs.iter().fold(0.0, |high, one| one.quantiles[3].max(high));
                let range = high - low;
                let is_narrow = range > 0.0 && range <= NARROW * format.largest() && low > range;
                match white {
                    _ if is_narrow => {
                        let (black, white) = (low.round(), high.round());
                        Some(Self { format, black, white, are_limits: false })
                    }
                    Some(white) => limits(0.0, white),
                    None => None,
                }
            }
            SampleFormat::Float => {
                let white = median / DARK;
                (median > 1.0).then_some(Self { format, black: 0.0, white, are_limits: false })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::image::ImageFile as _;
    use std::path::PathBuf;

    use ::image::{ImageBuffer, Rgb};

    use super::super::{ColourCounts, Image, linear_from_srgb};
    use super::*;

    /// Photographs of 64 x 64 in 8 or 16 bits, of codes by photograph and pixel.
    struct Set {
        paths: Vec<PathBuf>,
        _folder: tempfile::TempDir,
    }

    impl Set {
        fn new(count: u32, is_wide: bool, code: impl Fn(u32, u32) -> u32) -> Self {
            let folder = tempfile::tempdir().unwrap();
            let path = |one: u32| {
                let path = folder.path().join(format!("{one:02}.png"));
                let pixel = |x, y| code(one, 64 * y + x);
                match is_wide {
                    true => ImageBuffer::from_fn(64, 64, |x, y| Rgb([pixel(x, y) as u16; 3]))
                        .save(&path),
                    false => {
                        ImageBuffer::from_fn(64, 64, |x, y| Rgb([pixel(x, y) as u8; 3])).save(&path)
                    }
                }
                .unwrap();
                path
            };
            let paths = (0..count).map(path).collect();
            Self { paths, _folder: folder }
        }

        fn levels(&self, light: Option<StoredLight>) -> Levels {
            Levels::of_all(light, &self.paths.iter().map(PathBuf::as_path).collect::<Vec<_>>())
        }

        /// Black and white, if they are not as stored.
        fn found(&self) -> Option<[f32; 2]> {
            assert_eq!(self.levels(Some(StoredLight::Srgb)).found, None);
            self.levels(None).found.map(|found| [found.black, found.white])
        }
    }

    /// A value from 0 to below `most`, most often small.
    fn dark(one: u32, pixel: u32, most: u32) -> u32 {
        let part = f64::from((7919 * pixel + 104_729 * one) % 4096) / 4096.0;
        (f64::from(most) * part.powi(3)) as u32
    }

    #[test]
    fn sensor_values_in_16_bits_are_told_from_dark_photographs_of_the_full_scale() {
        let found = |code: &dyn Fn(u32, u32) -> u32| Set::new(9, true, code).found();
        // A sensor that clips, in most photographs; and one in the dark.
        let clipped = |bits: u32| {
            move |one, at| {
                dark(one, at, if one == 1 { 900 } else { 5 << (bits - 2) }).min((1 << bits) - 1)
            }
        };
        for (bits, white) in [(10, 1023.0), (12, 4095.0), (14, 16_383.0)] {
            assert_eq!(found(&clipped(bits)), Some([0.0, white]), "{bits} bits");
        }
        assert_eq!(found(&|one, at| dark(one, at, 40)), Some([0.0, 1023.0]));
        assert_eq!(
            found(&|one, at| dark(one, at, 150) + if at == 9 { 1500 } else { 0 }),
            Some([0.0, 4095.0])
        );
        // Dark, encoded on the full scale, with any largest value below 4095; 8 bits in 16; bright.
        assert_eq!(found(&|one, at| dark(one, at, 1800 + 250 * one)), None);
        assert_eq!(found(&|one, at| 257 * dark(one, at, 3)), None);
        assert_eq!(found(&|one, at| dark(one, at, 65_000)), None);
        // One photograph that is not of the first that are looked at has more.
        let beyond =
            Set::new(17, true, |one, at| dark(one, at, 40) + if one == 1 { 1000 } else { 0 });
        assert_eq!(beyond.found(), None);
        let some = Levels::of_set(None, beyond.paths.iter().map(|path| (path.as_path(), None)));
        let photograph = |at: usize| {
            let colours = ColourCounts::of_levels(some);
            let file = PictureFile::open(&beyond.paths[at]).unwrap();
            let (image, _) = file.decode_counted(&colours).unwrap();
            (image, colours.is_beyond())
        };
        assert!(photograph(1).1 && !photograph(2).1);
        assert!((photograph(2).0.data[0] - dark(2, 0, 40) as f32 / 1023.0).abs() < 1e-6);
    }

    #[test]
    fn a_narrow_range_is_stretched_and_one_at_black_is_not() {
        let thermal = Set::new(5, true, |one, at| 28_000 + 400 * one + (at % 400));
        let [black, white] = thermal.found().unwrap();
        assert!((28_000.0..28_010.0).contains(&black) && (29_980.0..=30_000.0).contains(&white));
        let line = thermal.levels(None).line().unwrap();
        assert!(line.contains("280") && line.contains("of 65535") && line.contains("--light srgb"));
        assert_eq!(Set::new(5, true, |_, at| 500 + at % 900).found(), None);
        // One value shows nothing, whatever its range.
        assert_eq!(Set::new(3, true, |_, _| 30_000).found(), None);
    }

    #[test]
    fn the_range_of_video_is_told_from_fog() {
        let video = |one: u32, at: u32| 16 + dark(one, at, 220);
        assert_eq!(Set::new(6, false, video).found(), Some(VIDEO));
        let fog = |one: u32, at: u32| 16 + 3 * (one % 3) + dark(one, at, 180);
        assert_eq!(Set::new(6, false, fog).found(), None);
        let whole = |one: u32, at: u32| if one == 4 { dark(one, at, 255) } else { video(one, at) };
        assert_eq!(Set::new(6, false, whole).found(), None);
    }

    #[test]
    fn floats_of_another_unit_become_those_of_a_dark_photograph_and_others_stay() {
        let folder = tempfile::tempdir().unwrap();
        let set = |unit: f32| {
            let path = |one: u32| {
                let path = folder.path().join(format!("{one}.exr"));
                let light = |x: u32, y: u32| unit * (dark(one, 64 * y + x, 1000) as f32 - 3.0);
                let image = Image::from_fn(64, 64, |x, y| [light(x, y); 3]);
                image.save_exr_as_stored(&path).unwrap();
                path
            };
            let paths: Vec<PathBuf> = (0..4).map(path).collect();
            (Levels::of_set(None, paths.iter().map(|path| (path.as_path(), None))), paths)
        };
        let (plain, _) = set(1e-4);
        assert_eq!(plain, Levels::default());
        let (levels, paths) = set(3.0);
        let colours = ColourCounts::of_levels(levels);
        let (image, _) = PictureFile::open(&paths[0]).unwrap().decode_counted(&colours).unwrap();
        let mut light: Vec<f32> = image.data.iter().map(|&x| linear_from_srgb(x)).collect();
        let black = light[0] * levels.unit();
        assert!((black + 9.0).abs() < 1e-3, "{black}: with its sign, in the unit of the files");
        light.sort_unstable_by(f32::total_cmp);
        assert!((light[light.len() / 2] / DARK - 1.0).abs() < 0.1);
    }
}
