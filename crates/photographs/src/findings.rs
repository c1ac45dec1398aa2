//! What is odd about the brightness of a set of photographs, a sentence each with its figure and a remedy: `diagnose`,
//! the plan of `train` and `tone apply` print them. They follow from measurements that every curve needs.

use super::tone::{
    EMPTY_CHANNEL, Exposure, LuminanceHistogram, MAX_GAIN, MeasuredPhotograph, NEAR_WHITE, is_black,
};

/// The share of pixels that a curve may bring near white.
const MAX_NEAR_WHITE: f64 = 0.04;
/// The darkest of the pixels, apart from this share, are black: at most this value, or this part of the mean.
const DARKEST: f64 = 1e-4;
const MAX_BLACK: [f64; 2] = [5.0 / 255.0, 0.2];
/// The smallest range of the values, apart from a thousandth at either end.
const MIN_RANGE: f64 = 0.05;
/// The share of pixels that are black or near white beyond which there is nothing between.
const MAX_EXTREME: f64 = 0.97;
/// The saturation and the blue, as a part of green, below which the colours of dark photographs are likely those of the
/// camera rather than of the scene: chair of LOM has 0.30 and 0.88, and its targets then err by 3.9 dB in colour.
const MAX_PALE: f64 = 0.33;
const MAX_BLUE: f64 = 0.89;
/// From this gain on, photographs are dark.
const MIN_DARK_GAIN: f64 = 2.0;
/// Below this luminance a pixel is black.
const BLACK: f64 = 2.0 / 255.0;

/// The findings about photographs. `exposure` is that of their targets if it is automatic, `near_white` the share of
/// pixels that the curve brings near white.
pub fn findings(
    photographs: &[MeasuredPhotograph],
    exposure: Option<&Exposure>,
    near_white: f64,
) -> Vec<String> {
    let not_black = photographs.iter().filter(|one| !is_black(&one.luminance));
    let lit: Vec<&MeasuredPhotograph> = not_black.collect();
    let mut all = LuminanceHistogram::default();
    lit.iter().for_each(|one| all.add(&one.luminance));
    if lit.is_empty() {
        return vec![];
    }
    let sentences = [
        narrow_range(&all).or_else(|| raised_black(&all)),
        extremes(&all),
        empty_channels(&lit),
        exposure.and_then(|exposure| lost_blue(&lit, &all, exposure)),
        exposure.and_then(|exposure| lit_and_dark(exposure.lit, lit.len())),
        exposure.and_then(|_| gain_at_its_limit(&lit)),
        too_near_white(near_white),
    ];
    sentences.into_iter().flatten().collect()
}

/// The finding about the share of pixels that a curve brings near white.
pub fn too_near_white(share: f64) -> Option<String> {
    (share > MAX_NEAR_WHITE).then(|| {
        format!(
            "the curve brings {:.0} % of the pixels near white ({NEAR_WHITE} and above), where lamps and sky lose \
             their detail: `--brightness 0.3` keeps it",
            100.0 * share
        )
    })
}

/// The share of pixels that an automatic curve brings near white, by its formula for grey; the mean of photographs.
pub fn brought_near_white(photographs: &[MeasuredPhotograph], exposure: &Exposure) -> f64 {
    let weight = exposure.weight();
    let share = |MeasuredPhotograph { luminance, camera, .. }: &MeasuredPhotograph| {
        if exposure.is_lit(luminance) {
            return 0.0;
        }
        let gain = exposure.gain_of(luminance, camera.as_ref());
        let target = |y: f64| (1.0 - weight) * y + weight * exposure.ends.soft(y, gain);
        luminance.mean_of(|y| f64::from(u8::from(y < NEAR_WHITE && target(y) >= NEAR_WHITE)))
    };
    photographs.iter().map(share).sum::<f64>() / photographs.len().max(1) as f64
}

fn narrow_range(all: &LuminanceHistogram) -> Option<String> {
    let [low, high] = [0.001, 0.999].map(|fraction| all.quantile(fraction));
    let remedy = match low > 0.5 * high {
        true => "stretch them, black to 0 and white to 1, as 16 bits",
        false => "expose longer, or keep more bits (RAW, 16 bits)",
    };
    (high - low < MIN_RANGE).then(|| {
        format!(
            "the photographs use {:.1} % of the scale, {low:.3} to {high:.3}: {remedy}",
            100.0 * (high - low)
        )
    })
}

fn raised_black(all: &LuminanceHistogram) -> Option<String> {
    let (black, mean) = (all.quantile(DARKEST), all.mean());
    let [least, part] = MAX_BLACK;
    (black > least && black > part * mean).then(|| {
        format!(
            "black is raised: no photograph is darker than {:.0} of 255, {:.0} % of the mean; subtract it, or save \
             frames of a clip with their full range",
            255.0 * black,
            100.0 * black / mean
        )
    })
}

fn extremes(all: &LuminanceHistogram) -> Option<String> {
    let share = all.mean_of(|y| f64::from(u8::from(!(BLACK..NEAR_WHITE).contains(&y))));
    (share >= MAX_EXTREME).then(|| {
        format!(
            "{:.1} % of the pixels are black or near white, lamps and night: no curve finds anything between; expose \
             longer",
            100.0 * share
        )
    })
}

fn empty_channels(lit: &[&MeasuredPhotograph]) -> Option<String> {
    const NAMES: [&str; 3] = ["red", "green", "blue"];
    let means = channel_means(lit);
    let largest = means.into_iter().fold(0.0, f64::max);
    let (empty, used): (Vec<_>, Vec<_>) =
        (0..3).partition(|&channel| means[channel] < EMPTY_CHANNEL * largest);
    let named = |channels: &[usize]| {
        channels.iter().map(|&channel| NAMES[channel]).collect::<Vec<_>>().join(" and ")
    };
    (!empty.is_empty()).then(|| {
        format!(
            "the photographs are empty in {} (mean {:.4}; {} has {largest:.4}): the automatic curve meters {}; save \
             grey photographs if colour means nothing",
            named(&empty),
            empty.iter().map(|&channel| means[channel]).fold(0.0, f64::max),
            named(&used),
            named(&used)
        )
    })
}

fn channel_means(lit: &[&MeasuredPhotograph]) -> [f64; 3] {
    let mean = |channel: usize| {
        let means = lit.iter().map(|one| f64::from(one.statistics.channel_means[channel]));
        means.sum::<f64>() / lit.len() as f64
    };
    [0, 1, 2].map(mean)
}

/// The curve scales all channels alike, and cameras lose blue first.
fn lost_blue(
    lit: &[&MeasuredPhotograph],
    all: &LuminanceHistogram,
    exposure: &Exposure,
) -> Option<String> {
    let (saturation, [_, green, blue]) = (all.saturation(), channel_means(lit));
    let is_pale = (EMPTY_CHANNEL..MAX_PALE).contains(&saturation) && blue < MAX_BLUE * green;
    let is_dark = exposure.lit == 0 && exposure.gain > MIN_DARK_GAIN;
    (is_pale && is_dark && blue > EMPTY_CHANNEL * green).then(|| {
        format!(
            "colours are pale and lack blue (saturation {saturation:.2}, blue {:.2} of green), which the automatic \
             curve keeps: a photograph in normal light (`tone fit --profile`) or a colour chart (`--white-balance`) \
             shows the true ones",
            blue / green
        )
    })
}

fn lit_and_dark(lit: usize, all: usize) -> Option<String> {
    (lit > 0).then(|| {
        format!(
            "{lit} of {all} photographs are in normal light and {} are dark: the dark ones are brightened to them; \
             `exclude` leaves photographs out",
            all - lit
        )
    })
}

fn gain_at_its_limit(lit: &[&MeasuredPhotograph]) -> Option<String> {
    let needs_more = |one: &&&MeasuredPhotograph| {
        Exposure::measure([&one.luminance], None).is_some_and(|found| found.gain > 0.999 * MAX_GAIN)
    };
    let limited: Vec<_> = lit.iter().filter(needs_more).collect();
    let means = limited.iter().map(|one| one.luminance.mean());
    (!limited.is_empty()).then(|| {
        format!(
            "the automatic gain is at its limit of {MAX_GAIN} for {} of {} photographs (mean luminance {:.4}), whose \
             targets stay dark: expose longer; linear light or 12 bits in a file of 16 look as dark",
            limited.len(),
            lit.len(),
            means.sum::<f64>() / limited.len() as f64
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tone::soft;

    /// Photographs of 1000 grey pixels of these values, each value with its number of pixels.
    fn photograph(values: &[(f32, usize)]) -> MeasuredPhotograph {
        coloured(values, [1.0; 3])
    }

    fn coloured(values: &[(f32, usize)], [r, g, b]: [f32; 3]) -> MeasuredPhotograph {
        let grey = || values.iter().flat_map(|&(value, count)| std::iter::repeat_n(value, count));
        let planes = [r, g, b].into_iter().flat_map(|part| grey().map(move |value| part * value));
        MeasuredPhotograph::measure(&planes.collect::<Vec<_>>())
    }

    fn ramp(from: f32, to: f32) -> MeasuredPhotograph {
        let value = |index: usize| (from + (to - from) * index as f32 / 999.0, 1);
        photograph(&(0..1000).map(value).collect::<Vec<_>>())
    }

    fn found(photographs: &[MeasuredPhotograph]) -> String {
        let exposure = Exposure::measure(photographs.iter().map(|one| &one.luminance), None);
        findings(photographs, exposure.as_ref(), 0.0).join("\n")
    }

    #[test]
    fn nothing_is_said_of_dark_or_lit_photographs() {
        for (from, to) in [(0.0, 0.2), (0.004, 0.1), (0.0, 1.0), (0.03, 0.9)] {
            assert_eq!(found(&vec![ramp(from, to); 4]), "", "{from} to {to}");
        }
        assert_eq!(findings(&[], None, 0.0), [""; 0]);
    }

    #[test]
    fn a_raised_black_and_a_narrow_range_are_found() {
        let text = found(&[ramp(16.0 / 255.0, 0.3), ramp(17.0 / 255.0, 0.2)]);
        assert!(
            text.starts_with("black is raised: no photograph is darker than 16 of 255"),
            "{text}"
        );
        assert_eq!(found(&[ramp(16.0 / 255.0, 0.3), ramp(0.0, 0.3)]), "");
        let text = found(&vec![ramp(0.427, 0.458); 3]);
        assert!(text.contains("3.1 % of the scale, 0.427 to 0.458: stretch"), "{text}");
        let text = found(&[ramp(0.0, 0.03)]);
        assert!(text.contains("expose longer") && !text.contains("stretch"), "{text}");
    }

    #[test]
    fn empty_channels_are_found() {
        let values: Vec<(f32, usize)> = (0..1000).map(|index| (index as f32 / 5e3, 1)).collect();
        let text = found(&[coloured(&values, [0.01, 1.0, 0.0])]);
        assert!(text.starts_with("the photographs are empty in red and blue"), "{text}");
        assert_eq!(found(&[coloured(&values, [0.3, 1.0, 0.1])]), "");
    }

    #[test]
    fn pale_colours_without_blue_are_found_in_dark_photographs() {
        let of = |colour, brightest: f32| {
            let values: Vec<(f32, usize)> =
                (0..1000).map(|index| (index as f32 * brightest / 1e3, 1)).collect();
            found(&[coloured(&values, colour)])
        };
        let text = of([1.0, 0.95, 0.75], 0.2);
        assert!(
            text.starts_with("colours are pale and lack blue (saturation 0.25, blue 0.79"),
            "{text}"
        );
        for (colour, brightest) in [
            ([1.0, 0.95, 0.9], 0.2),
            ([1.0, 0.95, 0.75], 1.0),
            ([1.0, 0.8, 0.4], 0.2),
            ([1.0, 1.0, 1.0], 0.2),
        ] {
            assert_eq!(of(colour, brightest), "", "{colour:?} up to {brightest}");
        }
    }

    #[test]
    fn a_mixture_of_dark_and_lit_photographs_is_found() {
        let mixed = |dark: usize, lit: usize| {
            found(&[vec![ramp(0.0, 0.1); dark], vec![ramp(0.0, 1.0); lit]].concat())
        };
        assert!(mixed(9, 7).starts_with("7 of 16 photographs are in normal light and 9 are dark"));
        assert_eq!(mixed(15, 1), "", "one may be a flash");
    }

    #[test]
    fn a_gain_at_its_limit_and_lamps_alone_are_found() {
        let text = found(&[ramp(0.0, 0.001), photograph(&[(0.002, 900), (0.01, 100)])]);
        assert!(text.contains("at its limit of 128 for 1 of 1"), "{text}");
        let text = found(&[photograph(&[(0.0, 980), (0.3, 5), (1.0, 15)])]);
        assert!(text.contains("99.5 % of the pixels are black or near white"), "{text}");
    }

    #[test]
    fn pixels_that_the_curve_brings_near_white_are_counted() {
        let exposure =
            |brightness| Exposure::measure([&ramp(0.0, 0.5).luminance], Some(brightness)).unwrap();
        let all = [ramp(0.0, 0.5), photograph(&[(1.0, 1000)])];
        let share = brought_near_white(&all[..1], &exposure(0.75));
        let white = (0..1000).filter(|&index| {
            soft(0.5 * f64::from(index) / 999.0, exposure(0.75).gain) >= NEAR_WHITE
        });
        assert!((share - white.count() as f64 / 1e3).abs() < 0.02 && share > 0.05, "{share}");
        let both = brought_near_white(&all, &exposure(0.75));
        assert!((both - share / 2.0).abs() < 1e-9, "white already");
        let text = findings(&all, None, share).join("");
        assert!(text.contains("near white") && text.contains("`--brightness 0.3`"), "{text}");
        assert_eq!(findings(&all, None, 0.03), [""; 0]);
    }
}
