//! Holes that black hides: a dark object in a dark room needs no Gaussians over a black background.

use nightsplat::results::eval::{
    self, MAX_RESIDUAL_TRANSMITTANCE, Metric, ModelRenderer, ResidualTransmittance,
};
use nightsplat::train::{Background, Part};
use nightsplat_photographs::dataset::View;
use nightsplat_photographs::image::Mask;
use nightsplat_synth::Night;

use crate::common::command::{json, unwrapped};
use crate::common::paths;
use crate::common::prelude::*;
use crate::common::train::train;

fn set() -> SyntheticOptions {
    small_set(12, [64, 48], 1)
}

/// A room lit by one lamp: everything outside its light, including objects in front of walls, is black and has no
/// points.
fn dark_room() -> Folder {
    /// Pixels whose channel mean is below this become black.
    const DARK: f32 = 0.5;
    let folder = captured(&set(), &Capture::clean());
    for part in ["low", "high"] {
        for path in paths(&folder.join(part)) {
            let image = Image::load(&path).unwrap();
            let shown = |x, y| {
                let pixel = image.pixel(x, y);
                if pixel.iter().sum::<f32>() < 3.0 * DARK { [0.0; 3] } else { pixel }
            };
            Image::from_fn(image.width, image.height, shown).save_png8(&path).unwrap();
        }
    }
    let dataset = load(&folder);
    let (camera, image) = (dataset.views[1].camera, dataset.views[1].image.as_ref().unwrap());
    rewrite_points(&folder, |position| {
        let pixel = camera.sees(position).map(|pixel| pixel.as_uvec2());
        pixel.is_some_and(|pixel| image.pixel(pixel.x, pixel.y) != [0.0; 3])
    });
    folder
}

/// Makes the points of the COLMAP model black and removes those for which `keeps` is false.
fn rewrite_points(folder: &Path, keeps: impl Fn(DVec3) -> bool) {
    let file = folder.join("colmap_sparse/0/points3D.txt");
    let mut text = String::new();
    for line in fs::read_to_string(&file).unwrap().lines().filter(|line| !line.starts_with('#')) {
        // Number, position, colour, error, track.
        let mut fields: Vec<&str> = line.split(' ').collect();
        let position: [f64; 3] = std::array::from_fn(|axis| fields[1 + axis].parse().unwrap());
        if keeps(position.into()) {
            fields[4..7].fill("0");
            text += &(fields.join(" ") + "\n");
        }
    }
    fs::write(file, text).unwrap();
}

fn load(folder: &Path) -> Dataset {
    Dataset::load(folder, &TrainConfig::bare().load_options()).unwrap()
}

/// The configuration for a dark room: no curve brightens its black.
fn config(background: Background) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::None);
    TrainConfig { steps: 200, background, tone, ..TrainConfig::bare() }
}

/// The mean residual transmittances of the test views, and the warning about them.
fn residuals(background: Background, dataset: &Dataset) -> (Vec<f64>, Option<String>) {
    let config = config(background);
    let mut trainer = Trainer::new(&gpu(), config.clone(), dataset).unwrap();
    advance(&mut trainer, config.steps);
    let scored = eval::score(dataset, |view| trainer.render(&view.camera)).unwrap();
    let scores = scored.scores.iter();
    let means = scores.filter(|score| score.metric == Metric::ResidualTransmittance);
    let means = means.map(|score| (score.view.as_str(), score.value));
    let warning = eval::hole_warning(means.clone(), background);
    (means.map(|(_, mean)| mean).collect(), warning)
}

#[test]
fn a_dark_room_has_reported_holes_over_black_and_none_over_random_colours() {
    let folder = dark_room();
    let dataset = load(&folder);
    let (hollow, warning) = residuals(Background::Black, &dataset);
    assert!(hollow.iter().all(|&mean| mean > 1.5 * MAX_RESIDUAL_TRANSMITTANCE), "{hollow:?}");
    let warning = warning.unwrap();
    assert!(warning.contains("in 2 of 2 views") && warning.contains("--background random"));
    let (whole, warning) = residuals(Background::Random, &dataset);
    assert!(whole.iter().all(|&mean| mean < 0.2 * MAX_RESIDUAL_TRANSMITTANCE), "{whole:?}");
    assert_eq!(warning, None);
}

#[test]
fn a_black_point_cloud_trains_as_well_as_a_grey_one() {
    let folder = written(&set());
    let config = TrainConfig { steps: 30, ..TrainConfig::bare() };
    let grey = train(&config, &load(&folder)).1;
    rewrite_points(&folder, |_| true);
    let black = train(&config, &load(&folder)).1;
    assert!(black.count > 100 && black.parameters == grey.parameters, "{}", black.count);
}

#[test]
fn masked_pixels_are_not_holes() {
    let folder = dark_room();
    let dataset = load(&folder);
    let mut trainer = Trainer::new(&gpu(), config(Background::Black), &dataset).unwrap();
    let view = dataset.test_views().next().unwrap();
    let rendered = trainer.render(&view.camera).unwrap();
    let open = rendered.transmittances.as_ref().unwrap();
    let (empty, covered): (Vec<usize>, Vec<usize>) =
        (0..open.len()).partition(|&pixel| open[pixel] > 0.5);
    assert!(!empty.is_empty() && !covered.is_empty());
    let masked = |hidden: &[usize]| {
        let mask = Mask::hiding(&rendered.colors, hidden);
        ResidualTransmittance::measure(&rendered, &View { mask, ..view.clone() })
    };
    assert!(masked(&[]).unwrap().q99 > 0.9, "{:?}", masked(&[]));
    assert!(masked(&empty).unwrap().q99 <= 0.5 && masked(&covered).unwrap().mean > 0.5);
    assert_eq!(masked(&[empty, covered].concat()), None);
    // An image that was not rendered from Gaussians has none.
    assert_eq!(ResidualTransmittance::measure(&rendered.colors.clone().into(), view), None);
}

#[test]
fn a_denoiser_and_patches_do_not_change_the_transmittances() {
    let dataset = crate::common::train::dataset(8, [64, 48]);
    let mut config = TrainConfig { patch_pixels: Some(1000), ..TrainConfig::bare() };
    config.model.set_parts(&[Part::Denoiser]);
    let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
    let view = dataset.test_views().next().unwrap();
    let rendered = trainer.render(&view.camera).unwrap();
    assert!(rendered.denoised.is_some());
    let (model, plain) = (trainer.model().unwrap(), TrainConfig::bare());
    let mut model_renderer = ModelRenderer::new(&gpu(), &model, &plain, None).unwrap();
    let whole = model_renderer.render(view).unwrap();
    let [in_parts, whole] =
        [rendered, whole].map(|rendered_image| rendered_image.transmittances.unwrap());
    assert_eq!(in_parts.len(), 64 * 48);
    let far = in_parts.iter().zip(&whole).filter(|(part, whole)| (*part - *whole).abs() > 1e-3);
    assert!(far.count() < 10 && whole.iter().any(|&open| open < 0.5));
}

#[test]
fn holes_are_reported_by_train_eval_and_diagnose() {
    let folder = dark_room();
    let short = "--curve none --steps 60 --background black --progress none";
    let (_, warned) = folder.run(&format!("train @ --out @run {short}"), 0);
    let warning =
        |text: &str| text.lines().filter(|line| line.contains("of the background")).count();
    assert!(warning(&warned) == 1 && warned.contains("--background random"), "{warned}");
    let (scored, warned) = folder.run("eval @run --json", 0);
    assert_eq!(warning(&warned), 1, "{warned}");
    let residual_transmittance = &json(scored)["residual_transmittance"];
    let trained = folder.json("run/metrics.json");
    assert_eq!(*residual_transmittance, trained["residual_transmittance"]);
    let of = |what: &Value| [&what["mean"], &what["q99"]].map(|value| value.as_f64().unwrap());
    let [mean, q99] = of(&residual_transmittance["mean"]);
    assert!(mean > MAX_RESIDUAL_TRANSMITTANCE && q99 > mean, "{residual_transmittance}");
    assert_eq!(residual_transmittance["views"].as_object().unwrap().len(), 2);
    let parts = ["residual transmittance", "99 %", &format!("{mean:.4}"), &format!("{q99:.4}")];
    says(&folder.succeed("eval @run"), &parts);

    // If no view is held out, training views are measured.
    let (_, warned) = folder.run(&format!("train @ --out @all --test-every 0 {short}"), 0);
    assert!(warning(&warned) == 1 && warned.contains("of 6 views"), "{warned}");

    let message = unwrapped(&folder.succeed("diagnose @ --run @run"));
    assert!(message.contains("note: view ") && warning(&message) == 1, "{message}");
    let diagnosed = json(folder.succeed("diagnose @ --run @run --json"));
    let views = diagnosed["residual_transmittance"].as_object().unwrap();
    assert_eq!(views.len(), set().views);
    assert_eq!(of(&views["000"]), of(&residual_transmittance["views"]["000"]));
    assert!(!folder.succeed("diagnose @ --json").contains("residual_transmittance"));
}

#[test]
fn a_black_sky_is_left_open_and_is_no_hole() {
    let night = Night { sky: true, ..Night::NONE };
    let folder = written(&SyntheticOptions { night, ..set() });
    for (more, background) in [
        ("--background random", "random"),
        ("--curve ase", "random"),
        ("--brightness 0.4", "random"),
        ("--curve auto", "black"),
        ("", "black"),
    ] {
        let train = "train @ --out @run --steps 60 --progress none --overwrite";
        let (_, warned) = folder.run(&format!("{train} {more}"), 0);
        says(&folder.text("run/config.toml"), &[&format!("background = \"{background}\"")]);
        // After a few steps, colours still show through.
        assert_eq!(warned.contains("of the background"), background == "random", "{warned}");
    }
    let open = &folder.json("run/metrics.json")["residual_transmittance"]["mean"]["mean"];
    assert!(open.as_f64().unwrap() > 3.0 * MAX_RESIDUAL_TRANSMITTANCE, "{open}");
    let (_, warned) = folder.run("eval @run", 0);
    assert!(!warned.contains("of the background"), "{warned}");
    let message = unwrapped(&folder.succeed("diagnose @ --run @run"));
    says(&message, &["% of a photograph is black: sky that stays open", "shows through the model"]);
    assert!(!message.contains("note: view "), "{message}");
}
