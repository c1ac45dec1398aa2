//! Night captures of the synthetic scenes: what a scene has at night, and what a camera does wrong there.

use nightsplat::photographs::dataset::synthetic::{
    self, CameraFaults, Capture, DARKENING, Night, SyntheticOptions,
};
use nightsplat::photographs::image::{Image, linear_from_srgb};

use crate::common::command::{refused, run};
use crate::common::fixture;

const VIEWS: usize = 9;
const SIZE: [u32; 2] = [80, 60];

/// The photographs and references of a set of [`VIEWS`].
struct Set {
    low: Vec<Image>,
    high: Vec<Image>,
}

fn photographed(options: &SyntheticOptions, capture: &Capture) -> Set {
    let folder = tempfile::tempdir().unwrap();
    synthetic::write_captured(folder.path(), options, capture).unwrap();
    let [low, high] = ["low", "high"].map(|of| {
        let image = |view| folder.path().join(format!("{of}/{view:03}.png"));
        (0..VIEWS).map(|view| Image::load(image(view)).unwrap()).collect()
    });
    Set { low, high }
}

fn options(street: bool, night: Night) -> SyntheticOptions {
    let set = if street { SyntheticOptions::street(3) } else { SyntheticOptions::default() };
    SyntheticOptions { views: VIEWS, width: SIZE[0], height: SIZE[1], seed: 4, night, ..set }
}

/// A room by a camera without noise.
fn faulty(faults: CameraFaults) -> Set {
    photographed(&options(false, Night::NONE), &Capture { faults, ..Capture::clean() })
}

/// The share of pixels whose brightest channel is within a range, of 255.
fn share(image: &Image, range: std::ops::RangeInclusive<f32>) -> f64 {
    let pixels = (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| (x, y)));
    let brightest = pixels.map(|(x, y)| image.pixel(x, y).into_iter().fold(0.0, f32::max));
    let within = brightest.filter(|value| range.contains(&(255.0 * value).round())).count();
    within as f64 / image.pixel_count() as f64
}

fn light(image: &Image) -> f64 {
    let values = image.data.iter().map(|&value| f64::from(linear_from_srgb(value)));
    values.sum::<f64>() / image.data.len() as f64
}

/// The ratio in linear light of two photographs' green channels, by row and column.
fn ratio(a: &Image, b: &Image, x: u32, y: u32) -> f64 {
    let [a, b] = [a, b].map(|image| f64::from(linear_from_srgb(image.pixel(x, y)[1])));
    a / b
}

#[test]
fn half_of_each_view_is_black_sky_with_stars_in_photographs_and_references() {
    for street in [false, true] {
        let set =
            photographed(&options(street, Night { sky: true, ..Night::NONE }), &Capture::default());
        for (view, (low, high)) in set.low.iter().zip(&set.high).enumerate() {
            let [dark, lit] = [share(low, 0.0..=1.0), share(high, 0.0..=6.0)];
            println!("{street} {view}: {dark:.2} {lit:.2}");
            assert!((0.33..0.62).contains(&lit) && dark > 0.9 * lit, "{view}: {dark}, {lit}");
            let upper: Vec<f32> = (0..SIZE[0]).flat_map(|x| high.pixel(x, 3)).collect();
            let sky = upper.iter().filter(|&&value| value < 6.5 / 255.0).count();
            assert!(sky > upper.len() * 6 / 10, "{view}: {sky} of {}", upper.len());
        }
        let stars: f64 = set
            .high
            .iter()
            .map(|high| {
                let top = (0..6).flat_map(|y| (0..SIZE[0]).map(move |x| (x, y)));
                top.filter(|&(x, y)| high.pixel(x, y)[1] > 0.2).count() as f64
            })
            .sum();
        assert!(stars > 20.0, "{stars}");
    }
}

#[test]
fn lamps_are_white_with_a_glow_and_headlights_are_elsewhere_in_each_training_view() {
    let lamps = Night { street_lamp: true, ..Night::NONE };
    let moving = Night { headlights: true, ..Night::NONE };
    for street in [false, true] {
        let [plain, fixed, moved] = [Night::NONE, lamps, moving]
            .map(|night| photographed(&options(street, night), &Capture::clean()));
        let dark = photographed(&options(street, lamps), &Capture::default()).low;
        let clipped = dark.iter().filter(|image| share(image, 255.0..=255.0) > 0.0005).count();
        // The room's hangs in front of all views; a street has one every three plots.
        assert!(if street { (2..VIEWS).contains(&clipped) } else { clipped == VIEWS }, "{clipped}");
        for view in 0..VIEWS {
            let [plain, fixed, moved] = [&plain, &fixed, &moved].map(|set| &set.high[view]);
            assert!(light(fixed) >= light(plain), "{view}");
            // Every eighth view is a test view.
            assert_eq!(moved.data == plain.data, view % 8 == 0, "{view}");
        }
    }
}

#[test]
fn haze_takes_contrast_and_adds_light() {
    let haze = Night { haze: true, ..Night::NONE };
    for street in [false, true] {
        let [plain, hazy] = [Night::NONE, haze]
            .map(|night| photographed(&options(street, night), &Capture::clean()).high);
        for (plain, hazy) in plain.iter().zip(&hazy) {
            let [clear, veiled] = [plain, hazy].map(|image| {
                let mut values: Vec<f32> =
                    image.data.iter().map(|&value| linear_from_srgb(value)).collect();
                values.sort_by(f32::total_cmp);
                [values[values.len() / 20], values[values.len() * 19 / 20]]
            });
            assert!(
                veiled[0] > 1.5 * clear[0] && veiled[1] < 0.9 * clear[1],
                "{clear:?} {veiled:?}"
            );
        }
    }
}

#[test]
fn a_lens_falls_off_to_a_quarter_and_bands_have_their_amplitude() {
    let plain = faulty(CameraFaults::default());
    let fall_off = faulty(CameraFaults { fall_off: true, ..Default::default() });
    let bands = faulty(CameraFaults { bands: true, ..Default::default() });
    let [right, bottom] = SIZE.map(|side| side - 1);
    for view in 0..VIEWS {
        let [plain, fallen, banded] = [&plain, &fall_off, &bands].map(|set| &set.low[view]);
        for (x, y) in [(0, 0), (right, 0), (0, bottom), (right, bottom)] {
            let corner = ratio(fallen, plain, x, y);
            assert!((0.22..0.31).contains(&corner), "{view}: {corner}");
        }
        assert!(ratio(fallen, plain, SIZE[0] / 2, SIZE[1] / 2) > 0.96);
        let rows = (0..SIZE[1]).map(|y| {
            let mut row: Vec<f64> = (0..SIZE[0]).map(|x| ratio(banded, plain, x, y)).collect();
            row.sort_by(f64::total_cmp);
            row[row.len() / 2]
        });
        let rows: Vec<f64> = rows.collect();
        let [least, most] = [f64::min, f64::max].map(|of| rows.iter().copied().reduce(of).unwrap());
        assert!((0.62..0.69).contains(&least) && (1.3..1.38).contains(&most), "{least} {most}");
    }
    assert_ne!(bands.low[1].data, bands.low[2].data);
    assert!(fall_off.high == plain.high && bands.high == plain.high);
}

#[test]
fn a_date_is_burnt_in_black_is_raised_and_an_intensifier_is_green() {
    let plain = faulty(CameraFaults::default());
    let date = faulty(CameraFaults { date: true, ..Default::default() });
    let raised = faulty(CameraFaults { raised_black: true, ..Default::default() });
    let both = faulty(CameraFaults { raised_black: true, date: true, ..Default::default() });
    let green = faulty(CameraFaults { one_channel: true, ..Default::default() });
    let strip = |image: &Image| -> Vec<f32> {
        (SIZE[1] - 9..SIZE[1])
            .flat_map(|y| (0..SIZE[0]).map(move |x| (x, y)))
            .flat_map(|(x, y)| image.pixel(x, y))
            .collect()
    };
    let values = |range: [f32; 2], set: &[f32]| {
        set.iter().all(|value| range.contains(&(255.0 * value).round()))
    };
    for view in 0..VIEWS {
        let white = strip(&date.low[view]).iter().filter(|&&value| value == 1.0).count();
        assert!(values([0.0, 255.0], &strip(&date.low[view])) && white > 300, "{view}: {white}");
        assert!(values([16.0, 235.0], &strip(&both.low[view])), "{view}");
        let (ends, x) = (
            raised.low[view].data.iter().fold([1.0f32, 0.0], |[a, b], &v| [a.min(v), b.max(v)]),
            255.0,
        );
        assert!(ends[0] * x >= 15.9 && ends[1] * x <= 235.1, "{ends:?}");
        let pixels = green.low[view].pixel_count();
        for image in [&green.low[view], &green.high[view]] {
            assert!(
                image.data[..pixels]
                    .iter()
                    .chain(&image.data[2 * pixels..])
                    .all(|&value| value == 0.0)
            );
            assert!(image.data[pixels..2 * pixels].iter().sum::<f32>() > 0.2 * pixels as f32);
        }
    }
    assert_ne!(strip(&date.low[0]), strip(&date.low[1]));
    assert!(date.high == plain.high && raised.high == plain.high);
}

#[test]
fn night_mode_lights_half_of_the_views_and_brackets_are_two_stops_apart() {
    let dark = Capture { full_well: f64::INFINITY, ..Capture::default() };
    let faults = CameraFaults { night_mode: true, ..Default::default() };
    let mixed = photographed(&options(false, Night::NONE), &Capture { faults, ..dark.clone() });
    let factor = |set: &Set, view: usize| light(&set.high[view]) / light(&set.low[view]);
    let lit: Vec<usize> = (0..VIEWS).filter(|&view| factor(&mixed, view) < 1.01).collect();
    assert_eq!(lit, [1, 3, 5, 7, 8]);
    assert!((0..VIEWS).all(|view| lit.contains(&view) || factor(&mixed, view) > 0.9 * DARKENING));
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let size = "--views 3 --width 80 --height 60";
    run(&format!("synth {} {size} --brackets", at("two")), 0);
    run(&format!("synth {} {size} --brackets=1 --bands --sky --headlights", at("one")), 0);
    run(&format!("synth {} {size} --brackets=1 --bands --sky --headlights", at("same")), 0);
    let photograph =
        |view| Image::load(folder.path().join(format!("two/low/{view:03}.png"))).unwrap();
    let lights = [0, 1, 2].map(|view| light(&photograph(view)));
    for pair in lights.windows(2) {
        assert!((3.5..4.5).contains(&(pair[1] / pair[0])), "{lights:?}");
    }
    for file in ["low/001.png", "high/001.png", "colmap_sparse/0/points3D.txt"] {
        let [two, one, same] = ["two", "one", "same"]
            .map(|set| std::fs::read(folder.path().join(set).join(file)).unwrap());
        assert!(one == same && one != two, "{file}");
    }
    refused(&format!("synth {} --brackets=nan", at("none")), 2, &["-10 to 10"]);
    refused(&format!("synth {} --lamp --sky", at("none")), 2, &["leave out --lamp"]);
}

/// The committed set was written before there were nights.
#[test]
fn a_plain_set_keeps_its_bits() {
    let folder = tempfile::tempdir().unwrap();
    let plain = SyntheticOptions { views: 3, width: 32, height: 24, seed: 5, ..Default::default() };
    synthetic::write(folder.path(), &plain).unwrap();
    for name in ["low/000.png", "low/001.png", "low/002.png", "high/000.png", "high/002.png"] {
        let [now, before] = [folder.path().to_owned(), fixture("lom")]
            .map(|set| Image::load(set.join(name)).unwrap());
        assert!(now == before, "{name}");
    }
}
