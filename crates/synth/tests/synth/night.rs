//! Night captures of the synthetic scenes: what a scene has at night, and what a camera does wrong there.

use nightsplat_photographs::image::{Image, linear_from_srgb};
use nightsplat_synth::{CameraFaults, Capture, DARKENING, Night, SyntheticOptions};

use crate::common::fixture;
use crate::{captured, image, light, written};

const VIEWS: usize = 9;
const WIDTH: u32 = 80;
const HEIGHT: u32 = 60;

/// The photographs and references of a set.
fn photographed(street: bool, night: Night, capture: &Capture) -> [Vec<Image>; 2] {
    let usual = if street { SyntheticOptions::street(3) } else { SyntheticOptions::default() };
    let (views, width, height, seed) = (VIEWS, WIDTH, HEIGHT, 4);
    let options = SyntheticOptions { views, width, height, seed, night, ..usual };
    let folder = captured(&options, capture);
    let image = |of, view| image(&folder, &format!("{of}/{view:03}.png"));
    ["low", "high"].map(|of| (0..VIEWS).map(|view| image(of, view)).collect())
}

/// A well lit room by a camera without noise.
fn faulty(faults: CameraFaults) -> [Vec<Image>; 2] {
    photographed(false, Night::NONE, &Capture { faults, ..Capture::clean() })
}

/// The pixels of rows, their values from 0 to 255.
fn pixels(image: &Image, rows: std::ops::Range<u32>) -> Vec<[f32; 3]> {
    let positions = rows.flat_map(|y| (0..WIDTH).map(move |x| (x, y)));
    positions.map(|(x, y)| image.pixel(x, y).map(|value| 255.0 * value)).collect()
}

/// The share of pixels whose largest value is within a range.
fn share(image: &Image, range: [f32; 2]) -> f64 {
    let within = |pixel: &[f32; 3]| {
        let most = pixel.iter().copied().fold(0.0, f32::max).round();
        range[0] <= most && most <= range[1]
    };
    let all = pixels(image, 0..HEIGHT);
    all.iter().filter(|pixel| within(pixel)).count() as f64 / all.len() as f64
}

/// The ratio of two photographs' green channels at a pixel, in linear light.
fn ratio(a: &Image, b: &Image, x: u32, y: u32) -> f64 {
    let [a, b] = [a, b].map(|image| f64::from(linear_from_srgb(image.pixel(x, y)[1])));
    a / b
}

#[test]
fn half_of_each_view_is_black_sky_with_stars_in_photographs_and_references() {
    for street in [false, true] {
        let night = Night { sky: true, ..Night::NONE };
        let [low, high] = photographed(street, night, &Capture::default());
        let mut stars = 0;
        for (view, (low, high)) in low.iter().zip(&high).enumerate() {
            let [dark, black] = [share(low, [0.0, 1.0]), share(high, [0.0, 6.0])];
            println!("{street} {view}: {dark:.2} {black:.2}");
            assert!((0.35..0.6).contains(&black) && dark > 0.85 * black, "{view}: {dark} {black}");
            stars += pixels(high, 0..8).iter().filter(|pixel| pixel[1] > 50.0).count();
        }
        assert!(stars > 20, "{stars}");
    }
}

#[test]
fn lamps_are_white_and_headlights_are_elsewhere_in_each_training_view() {
    for street in [false, true] {
        let lamp = Night { street_lamp: true, ..Night::NONE };
        let moving = Night { headlights: true, ..Night::NONE };
        let [[dark, plain], [lit, fixed], [_, moved]] = [Night::NONE, lamp, moving]
            .map(|night| photographed(street, night, &Capture::default()));
        let clipped = |set: &[Image]| {
            set.iter().filter(|image| share(image, [255.0, 255.0]) > 0.0005).count()
        };
        // The room's lamp is in front of all cameras; a street has one at every third plot.
        let count = clipped(&lit);
        assert!(if street { (2..VIEWS).contains(&count) } else { count == VIEWS }, "{count}");
        assert!(clipped(&dark) == 0 && clipped(&fixed) >= count);
        assert!((0..VIEWS).all(|view| light(&fixed[view]) > light(&plain[view])));
        let moves: Vec<bool> = (0..VIEWS).map(|view| moved[view] != plain[view]).collect();
        // Test views are without them.
        assert!(!moves[0] && !moves[8], "{moves:?}");
        assert!(moves.iter().filter(|moves| **moves).count() >= 5, "{moves:?}");
    }
}

#[test]
fn haze_takes_contrast() {
    for street in [false, true] {
        let [plain, hazy] = [false, true].map(|haze| {
            photographed(street, Night { haze, ..Night::NONE }, &Capture::clean()).map(|set| {
                let mut values: Vec<f32> =
                    set.iter().flat_map(|image| image.data.clone()).collect();
                values.sort_by(f32::total_cmp);
                [1, 19].map(|part| linear_from_srgb(values[values.len() / 20 * part]))
            })
        });
        // In photographs and references alike.
        for ([black, white], [hazy_black, hazy_white]) in plain.into_iter().zip(hazy) {
            assert!(hazy_black > 1.5 * black && hazy_white < 0.9 * white, "{plain:?} {hazy:?}");
        }
    }
}

#[test]
fn a_lens_falls_off_to_a_quarter_and_bands_have_their_amplitude() {
    let [plain, right] = faulty(CameraFaults::default());
    let [fallen, fallen_right] = faulty(CameraFaults { fall_off: true, ..Default::default() });
    let [banded, banded_right] = faulty(CameraFaults { bands: true, ..Default::default() });
    for view in 0..VIEWS {
        let corners = [(0, 0), (WIDTH - 1, 0), (0, HEIGHT - 1), (WIDTH - 1, HEIGHT - 1)];
        let corners = corners.map(|(x, y)| ratio(&fallen[view], &plain[view], x, y));
        assert!(corners.iter().all(|share| (0.23..0.29).contains(share)), "{view}: {corners:?}");
        assert!(ratio(&fallen[view], &plain[view], WIDTH / 2, HEIGHT / 2) > 0.96);
        let rows = (0..HEIGHT).map(|y| {
            let mut row: Vec<f64> =
                (0..WIDTH).map(|x| ratio(&banded[view], &plain[view], x, y)).collect();
            row.sort_by(f64::total_cmp);
            row[row.len() / 2]
        });
        let (least, most) = rows.fold((2.0f64, 0.0f64), |(a, b), row| (a.min(row), b.max(row)));
        assert!((0.63..0.68).contains(&least) && (1.31..1.37).contains(&most), "{least} {most}");
    }
    assert_ne!(banded[1].data, banded[2].data);
    assert!(fallen_right == right && banded_right == right);
}

#[test]
fn a_date_is_burnt_in_black_is_raised_and_an_intensifier_is_green() {
    let [[dated, _], [raised, right], [both, _], [green, green_right]] = [
        CameraFaults { date: true, ..Default::default() },
        CameraFaults { raised_black: true, ..Default::default() },
        CameraFaults { date: true, raised_black: true, ..Default::default() },
        CameraFaults { one_channel: true, ..Default::default() },
    ]
    .map(faulty);
    let strip = |image| pixels(image, HEIGHT - 9..HEIGHT).concat();
    let only =
        |values: [f32; 2], found: &[f32]| found.iter().all(|value| values.contains(&value.round()));
    for view in 0..VIEWS {
        let text = strip(&dated[view]);
        let white = text.iter().filter(|&&value| value == 255.0).count();
        assert!(only([0.0, 255.0], &text) && white > 300, "{view}: {white}");
        assert!(only([16.0, 235.0], &strip(&both[view])), "{view}");
        let within = |value: &f32| (15.9..235.1).contains(&(255.0 * value));
        assert!(raised[view].data.iter().all(within), "{view}");
        for image in [&green[view], &green_right[view]] {
            assert!(pixels(image, 0..HEIGHT).iter().all(|&[red, _, blue]| red + blue == 0.0));
            assert!(light(image) > 0.02);
        }
    }
    assert_ne!(strip(&dated[0]), strip(&dated[1]));
    assert!(right == faulty(CameraFaults::default())[1]);
}

#[test]
fn night_mode_lights_half_of_the_views_and_half_of_the_test_views() {
    let faults = CameraFaults { night_mode: true, ..Default::default() };
    let capture = Capture { full_well: f64::INFINITY, faults, ..Capture::default() };
    let [low, high] = photographed(false, Night::NONE, &capture);
    let factors: Vec<f64> = low.iter().zip(&high).map(|(a, b)| light(b) / light(a)).collect();
    for (view, factor) in factors.iter().enumerate() {
        let expected = if [1, 3, 5, 7, 8].contains(&view) { 1.0 } else { DARKENING };
        assert!((factor / expected - 1.0).abs() < 0.1, "{view}: {factors:?}");
    }
}

/// The committed set is older than the nights.
#[test]
fn a_plain_set_keeps_its_bits() {
    let (views, width, height) = (3, 32, 24);
    let plain = SyntheticOptions { views, width, height, seed: 5, ..Default::default() };
    let folder = written(&plain);
    for name in ["low/000.png", "low/001.png", "low/002.png", "high/000.png", "high/002.png"] {
        assert!(image(&folder, name) == image(&fixture("lom"), name), "{name}");
    }
}
