//! The camera of the dark photographs: its exposure, its noise and its faults.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use nightsplat_core::camera::Camera;
use nightsplat_core::random::Stream;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::Image;

use super::{DARKENING, TEST_EVERY, photograph};

/// Electrons of a pixel at the reference's white.
const FULL_WELL: f64 = 9000.0;

/// Standard deviation of the read noise, electrons.
const READ_NOISE: f64 = 2.0;

/// The streams of random numbers of the seed: of the noise, and of the phases of bands.
const NOISE_STREAM: u64 = 1;
const BAND_STREAM: u64 = 3;

/// Faults of a camera at night. They change the photographs; of the references, only `one_channel` does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct CameraFaults {
    /// The lens gives the corners a quarter of the light of the middle
    #[cfg_attr(feature = "clap", arg(long))]
    pub fall_off: bool,
    /// Bands of rows with a third more or less light, elsewhere in each photograph: a rolling shutter under lamps on
    /// alternating current
    #[cfg_attr(feature = "clap", arg(long))]
    pub bands: bool,
    /// Date and time along the lower edge, white on black
    #[cfg_attr(feature = "clap", arg(long))]
    pub date: bool,
    /// Every second photograph is in normal light, as by the night mode of a phone
    #[cfg_attr(feature = "clap", arg(long))]
    pub night_mode: bool,
    /// Black is 16 of 255, and white 235, as in video
    #[cfg_attr(feature = "clap", arg(long))]
    pub raised_black: bool,
    /// An image intensifier: luminance in the green channel, and nothing in the others, also in the references
    #[cfg_attr(feature = "clap", arg(long))]
    pub one_channel: bool,
}

/// The exposure, noise and faults of the dark photographs of a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// How much darker they are than the references, in linear light.
    pub darkening: f64,
    /// Electrons of a pixel at the reference's white: shot noise has the variance of signal / this.
    pub full_well: f64,
    /// Standard deviation of the read noise, electrons.
    pub read_noise: f64,
    /// Extra stops of the views, cyclically, from the first on.
    pub stops: Vec<f64>,
    /// What the camera does beside that.
    pub faults: CameraFaults,
}

/// A small sensor, far too short an exposure.
impl Default for Capture {
    fn default() -> Self {
        Self {
            darkening: DARKENING,
            full_well: FULL_WELL,
            read_noise: READ_NOISE,
            stops: vec![0.0],
            faults: CameraFaults::default(),
        }
    }
}

impl Capture {
    /// Well lit, and without noise.
    #[doc(hidden)]
    pub fn clean() -> Self {
        Self { darkening: 1.0, full_well: f64::INFINITY, read_noise: 0.0, ..Self::default() }
    }

    pub(super) fn check(&self) -> Result<()> {
        let is_exposed = |stops: &f64| (-10.0..=10.0).contains(stops);
        let refused = || Error::Usage("exposures are -10 to 10 stops; ask for these".to_owned());
        self.stops.iter().all(is_exposed).then_some(()).ok_or_else(refused)
    }

    /// How much darker a view's photograph is than its reference. Night mode alternates, with a step at every test
    /// view, so that half of those are dark, too.
    fn darkening_of_view(&self, view: usize) -> f64 {
        let stops = self.stops.get(view % self.stops.len().max(1)).copied();
        let is_lit = self.faults.night_mode && (view + view / TEST_EVERY) % 2 == 1;
        (if is_lit { 1.0 } else { self.darkening }) / stops.unwrap_or(0.0).exp2()
    }

    /// The photograph of a view, from linear radiance in row-major order.
    pub(super) fn photograph(
        &self,
        radiance: &[DVec3],
        camera: &Camera,
        view: usize,
        seed: u64,
    ) -> Image {
        let &Self { full_well, read_noise, faults, .. } = self;
        let darkening = self.darkening_of_view(view);
        let noise = Stream::new(seed, NOISE_STREAM << 32 | view as u64);
        let phase = Stream::new(seed, BAND_STREAM << 32).uniform(view as u64);
        let mut taken = photograph(camera, |pixel, channel| {
            let light = faults.light_at(pixel, camera, phase) * radiance[pixel][channel];
            if full_well.is_infinite() || faults.one_channel && channel != 1 {
                return light / darkening;
            }
            let electrons = full_well * light / darkening;
            // Shot noise is Poisson; at tens of electrons, the normal distribution of equal variance is close.
            let deviation = (electrons + read_noise * read_noise).sqrt();
            (electrons + deviation * noise.normal(3 * pixel as u64 + channel as u64)) / full_well
        });
        if faults.date {
            let date = format!("2026-11-01 22:{:02}:{:02}", view / 60 % 60, view % 60);
            burn_in(&mut taken, &date);
        }
        if faults.raised_black {
            taken.data.iter_mut().for_each(|value| *value = (16.0 + 219.0 * *value) / 255.0);
        }
        taken
    }
}

impl CameraFaults {
    /// The light of the channels that there are.
    pub(super) fn channels(self, light: Vec<DVec3>) -> Vec<DVec3> {
        const LUMINANCE: DVec3 = DVec3::new(0.2126, 0.7152, 0.0722);
        match self.one_channel {
            true => light.into_iter().map(|light| DVec3::Y * LUMINANCE.dot(light)).collect(),
            false => light,
        }
    }

    /// The factor on the light of a pixel by lens and shutter; the phase of the bands in periods.
    fn light_at(self, pixel: usize, camera: &Camera, phase: f64) -> f64 {
        /// Periods of the bands in a photograph, and their amplitude.
        const BANDS: f64 = 2.5;
        const AMPLITUDE: f64 = 0.35;
        let size = DVec2::new(camera.width.into(), camera.height.into());
        let (row, column) = (pixel / camera.width as usize, pixel % camera.width as usize);
        let position = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        let mut factor = 1.0;
        if self.fall_off {
            // 1 in the middle, 1/4 in the corners.
            let radius = (2.0 * position - size) / size.length();
            factor /= (1.0 + radius.length_squared()).powi(2);
        }
        if self.bands {
            factor *= 1.0 + AMPLITUDE * (TAU * (BANDS * position.y / size.y + phase)).sin();
        }
        factor
    }
}

/// Writes a line of digits along the lower edge, white on black.
fn burn_in(image: &mut Image, text: &str) {
    let (width, height) = (image.width as usize, image.height as usize);
    // A glyph is 5 rows of 3 dots, with a dot to the next one; the strip is 9 dots high.
    let dot = (height / 70).max(1);
    let top = height - 9 * dot;
    let is_white = |x: usize, y: usize| {
        let (column, row) = ((x / dot).checked_sub(2)?, ((y - top) / dot).checked_sub(2)?);
        let glyph = glyph(*text.as_bytes().get(column / 4)?);
        (row < 5 && column % 4 < 3).then(|| glyph >> (3 * (4 - row) + 2 - column % 4) & 1)
    };
    for (index, value) in image.data.iter_mut().enumerate() {
        let (x, y) = (index % width, index / width % height);
        if y >= top {
            *value = is_white(x, y).map_or(0.0, f32::from);
        }
    }
}

/// The dots of a digit or a mark: an octal digit for each row.
fn glyph(letter: u8) -> u16 {
    const DIGITS: [u16; 10] =
        [0o75557, 0o26227, 0o71747, 0o71717, 0o55711, 0o74717, 0o74757, 0o71111, 0o75757, 0o75717];
    match letter {
        b'-' => 0o00700,
        b':' => 0o02020,
        _ => letter.checked_sub(b'0').map_or(0, |digit| DIGITS[usize::from(digit) % 10]),
    }
}
