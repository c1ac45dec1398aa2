//! The parts of LITA-GS: each alone and all together, trained, saved, and rendered.

use nightsplat::loss::Term;
use nightsplat::splats::model::Model;
use nightsplat::train::{Part, Rendered, StepReport};
use nightsplat_models::attributes::{ATTRIBUTES, Attribute, AttributeSpec};
use nightsplat_photographs::dataset::NormalMap;

use crate::common::command::{Folder, json, says};
use crate::common::prelude::*;
use crate::common::train::train;

fn config(parts: &[Part]) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config = TrainConfig { steps: 40, sh_degree: 0, tone, ..TrainConfig::bare() };
    config.schedule.densify_after = 10;
    config.schedule.densify_interval = 15;
    set_small_parts(&mut config, parts);
    config.model.rates.denoiser = 1e-2;
    config.model.rates.tonemapper = 1e-2;
    config.schedule.initial_rates[Attribute::Features] = 5e-2;
    config
}

fn load(folder: &Path, config: &TrainConfig) -> Dataset {
    Dataset::load(folder, &config.load_options()).unwrap()
}

/// The set without depth maps, made once.
fn plain_set(config: &TrainConfig) -> Dataset {
    static SET: OnceLock<Folder> = OnceLock::new();
    load(SET.get_or_init(|| folder(false)), config)
}

/// The set with depth maps, made once.
fn deep_set(config: &TrainConfig) -> Dataset {
    static SET: OnceLock<Folder> = OnceLock::new();
    load(SET.get_or_init(|| folder(true)), config)
}

/// Six views of 40 x 30 pixels, with depth maps if requested.
fn make_set(set: &Path, with_depth: bool) {
    if with_depth {
        return crate::common::train::write_with_depth(set);
    }
    nightsplat_synth::write(set, &small_set(6, [40, 30], 1)).unwrap();
}

fn folder(with_depth: bool) -> Folder {
    let folder = Folder::empty();
    make_set(&folder, with_depth);
    folder
}

/// The mean of a term over the first and over the last epoch.
fn fall(reports: &[StepReport], term: Term) -> [f64; 2] {
    let mean = |reports: &[StepReport]| {
        reports.iter().map(|report| report.term(term)).sum::<f64>() / reports.len() as f64
    };
    [mean(&reports[..5]), mean(&reports[reports.len() - 5..])]
}

#[test]
fn each_part_alone_has_its_channels_and_its_terms_fall() {
    for (part, channels, terms) in [
        (Part::Structure, 4, &[Term::STRUCTURE][..]),
        (Part::Depth, 4, &[Term::DEPTH, Term::DEPTH_LOCAL]),
        (Part::Tonemapper, 6, &[Term::LOW_L1]),
        (Part::Denoiser, 3, &[Term::DENOISING]),
    ] {
        let config = config(&[part]);
        let (reports, gaussians) = train(&config, &deep_set(&config));
        assert_eq!(gaussians.shape.features.channels(), channels);
        for &term in terms {
            let [begin, end] = fall(&reports, term);
            assert!(end < begin, "{}: {term:?} went from {begin} to {end}", part.name());
        }
        let [begin, end] = fall(&reports, Term::L1);
        assert!(end < begin, "{}: L1 went from {begin} to {end}", part.name());
    }
}

/// The paper's configuration, except for the size and the learning rate of the networks.
fn paper(parts: &[Part]) -> TrainConfig {
    let mut config = config(parts);
    let (network, rates) = (config.model.network, config.model.rates);
    config.model.follow_paper();
    config.model.rates = rates;
    config.model.network = DenoiserSettings { variant: NetworkVariant::Paper, ..network };
    config
}

#[test]
fn the_paper_s_denoiser_has_a_noise_map_and_its_terms_fall() {
    let config = paper(&[Part::Denoiser]);
    let (reports, gaussians) = train(&config, &plain_set(&config));
    assert_eq!(gaussians.shape.features.channels(), 6);
    for term in [Term::DENOISING, Term::L1] {
        let [begin, end] = fall(&reports, term);
        assert!(end < begin, "{term:?} went from {begin} to {end}");
    }
}

/// A model's render of the first test view before training.
fn first_render(config: &TrainConfig, dataset: &Dataset) -> Rendered {
    // Tiles of another size sum in another order.
    let config = TrainConfig { tile: Some([8, 8].into()), ..config.clone() };
    let camera = dataset.test_views().next().unwrap().camera;
    Trainer::new(&gpu(), config, dataset).unwrap().render(&camera).unwrap()
}

#[test]
fn with_every_part_of_the_paper_a_model_starts_as_the_plain_one_bit_for_bit() {
    let dataset = deep_set(&config(&Part::LITA));
    let plain = first_render(&config(&[]), &dataset).colors;
    for parts in Part::LITA.iter().map(std::slice::from_ref).chain([&Part::LITA[..]]) {
        let begun = first_render(&config(parts), &dataset);
        assert!(begun.colors == plain && *begun.output() == plain, "{parts:?}");
    }
    let of_paper = first_render(&paper(&Part::LITA), &dataset);
    assert!(of_paper.colors == plain && *of_paper.output() != plain);
}

#[test]
fn a_denoiser_that_learns_does_not_change_any_gaussian() {
    let plain = config(&[]);
    let dataset = plain_set(&plain);
    let expected = train(&plain, &dataset).1;
    for crop in [0, 12] {
        let mut config = config(&[Part::Denoiser]);
        config.model.denoiser_crop = crop;
        let (reports, gaussians) = train(&config, &dataset);
        assert_eq!(gaussians, expected, "crop {crop}");
        assert!(reports.iter().all(|report| report.terms.len() == 4));
    }
}

/// The tonemapper starts with the illumination of the dark photographs, so its loss starts small.
#[test]
fn the_illumination_is_initialised_from_the_photographs_and_their_targets() {
    let first = |config: &TrainConfig| {
        let config = TrainConfig { steps: 1, ..config.clone() };
        train(&config, &plain_set(&config)).0[0].term(Term::LOW_L1)
    };
    let parts = [Part::Tonemapper];
    let (of_targets, of_paper) = (first(&config(&parts)), first(&paper(&parts)));
    assert!(of_targets < of_paper, "{of_targets}, and {of_paper} in the paper");
}

#[test]
fn the_whole_model_gives_the_same_bits_every_time_on_crops_too() {
    let mut config = TrainConfig { steps: 20, ..paper(&Part::ALL) };
    config.model.denoiser_crop = 12;
    let dataset = deep_set(&config);
    let (reports, gaussians) = train(&config, &dataset);
    assert_eq!(gaussians.shape.features.channels(), 11);
    assert!(reports.iter().all(|report| report.loss.is_finite() && report.terms.len() == 9));
    let (again, same) = train(&config, &dataset);
    assert_eq!(gaussians, same);
    assert!(reports.iter().zip(again).all(|(a, b)| a.terms == b.terms));
}

/// A crop that covers the view is the view: the estimate becomes the mean itself.
#[test]
fn a_crop_of_the_whole_view_changes_nothing() {
    let parts = [Part::Denoiser, Part::Tonemapper];
    let whole = TrainConfig { steps: 6, ..config(&parts) };
    let mut cropped = whole.clone();
    cropped.model.denoiser_crop = 40;
    let dataset = plain_set(&whole);
    assert_eq!(train(&whole, &dataset).1, train(&cropped, &dataset).1);
}

/// The terms are means over pixels, so crops are unbiased estimates of the whole view. Nothing is learned: each step is
/// compared with the same step with the same weights.
#[test]
fn crops_estimate_the_losses_of_the_whole_view() {
    const NO_RATE: f64 = 1e-12;
    let losses = |crop: u32| -> Vec<f64> {
        let mut config = TrainConfig { steps: 48, ..config(&[Part::Tonemapper]) };
        config.schedule.densify_after = config.steps;
        for AttributeSpec { attribute, .. } in &ATTRIBUTES {
            config.schedule.initial_rates[*attribute] = NO_RATE;
        }
        config.schedule.final_means_rate = NO_RATE;
        config.model.rates.tonemapper = NO_RATE;
        config.model.denoiser_crop = crop;
        let (reports, _) = train(&config, &plain_set(&config));
        reports.iter().map(|report| report.term(Term::LOW_L1)).collect()
    };
    let (cropped, whole) = (losses(16), losses(0));
    let differences: Vec<f64> = cropped.iter().zip(&whole).map(|(a, b)| a - b).collect();
    let count = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / count;
    let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (count - 1.0);
    let error = (variance / count).sqrt();
    assert!(mean.abs() < 4.0 * error, "off by {mean}, four standard errors are {}", 4.0 * error);
}

#[test]
fn depth_maps_are_found_resized_negated_and_left_out_if_they_are_constant() {
    let folder = folder(true);
    let mut config = config(&[Part::Depth]);
    let dataset = load(&folder, &config);
    let views: Vec<_> = dataset.train_views().collect();
    assert!(dataset.test_views().all(|view| view.depth.is_none()));
    let depth = views[0].depth.as_ref().unwrap();
    assert_eq!(depth.len(), 40 * 30);
    assert!(depth[0] > depth[39 + 40 * 29], "larger is farther");

    config.model.depth_is_disparity = true;
    let negated = load(&folder, &config);
    let negated = negated.train_views().next().unwrap().depth.clone().unwrap();
    assert!(depth.iter().zip(&negated).all(|(a, b)| *a == -b));
    config.model.depth_is_disparity = false;

    let name = &views[0].name;
    let constant = Image::filled(40, 30, [0.5; 3]);
    constant.save_png8(folder.join(format!("depth/depth_{name}.png"))).unwrap();
    let dataset = load(&folder, &config);
    let with_depth = dataset.train_views().filter(|view| view.depth.is_some()).count();
    assert_eq!(with_depth, views.len() - 1);
    // Training works: the view without depth omits the term.
    let (reports, _) = train(&TrainConfig { steps: 10, ..config.clone() }, &dataset);
    for report in &reports {
        assert_eq!((report.term(Term::DEPTH) == 0.0), report.view == *name, "{report:?}");
    }

    config.model.depth_folder = Some(folder.join("nowhere"));
    let error = Dataset::load(&folder, &config.load_options()).unwrap_err().to_string();
    says(&error, &["nowhere", "depth"]);
}

/// Maps of half the size, as estimators return them, in OpenGL's axes; one of another shape, one without normals.
#[test]
fn normal_maps_are_found_and_turned_and_bad_ones_are_left_out() {
    let folder = folder(false);
    let config = TrainConfig { steps: 12, ..config(&[Part::Normals]) };
    let names: Vec<String> =
        load(&folder, &config).train_views().map(|view| view.name.clone()).collect();
    let maps = folder.join("normals");
    fs::create_dir(&maps).unwrap();
    let normal = Vec3::new(0.6, 0.0, 0.8);
    for (i, name) in names.iter().enumerate() {
        let (width, height, value) = match i {
            0 => (20, 40, [0.8, 0.5, 0.9]),
            1 => (20, 15, [0.5; 3]),
            _ => (20, 15, (0.5 * normal + 0.5).to_array()),
        };
        let map = Image::filled(width, height, value);
        map.save_png16(maps.join(format!("normal_{name}.png"))).unwrap();
    }
    let dataset = load(&folder, &config);
    let of = |name: &String| {
        dataset.train_views().find(|view| view.name == *name).unwrap().normals.clone()
    };
    assert!(of(&names[0]).is_none() && of(&names[1]).is_none());
    let expected = NormalMap::new(1, 1, [Vec3::new(0.6, 0.0, -0.8)]).packed()[0];
    let found = of(&names[2]).unwrap();
    assert_eq!(found.packed().len(), 40 * 30);
    assert!(found.packed().iter().all(|&bits| bits == expected), "{:x}", found.packed()[0]);
    assert!(dataset.test_views().all(|view| view.normals.is_none()));

    let (reports, gaussians) = train(&config, &dataset);
    assert_eq!(gaussians.shape.features.channels(), 3, "no feature is added");
    for report in &reports {
        let is_left_out = names[..2].contains(&report.view);
        assert_eq!(report.term(Term::NORMALS) == 0.0, is_left_out, "{report:?}");
    }
    let (_, again) = train(&config, &dataset);
    assert_eq!(again.parameters, gaussians.parameters, "the same bits");

    fs::remove_dir_all(&maps).unwrap();
    let (plain, _) = train(&config, &load(&folder, &config));
    assert!(plain.iter().all(|report| report.term(Term::NORMALS) == 0.0));
}

#[test]
fn without_depth_maps_there_is_no_depth_part() {
    let config = TrainConfig { steps: 2, ..config(&[Part::Depth, Part::Structure]) };
    let (reports, gaussians) = train(&config, &plain_set(&config));
    assert_eq!(gaussians.shape.features.channels(), 4);
    assert_eq!(reports[0].terms.len(), 3);
}

#[test]
fn raw_colors_train_and_are_saved_as_viewers_show_them() {
    let folder = folder(false);
    let mut config = TrainConfig { steps: 20, ..config(&[]) };
    config.model.raw_colors = true;
    let (reports, gaussians) = train(&config, &load(&folder, &config));
    let [begin, end] = fall(&reports, Term::L1);
    assert!(end < begin, "L1 went from {begin} to {end}");
    let before = gaussians.dc()[0].x;
    let model = Model { raw_colors: true, ..Model::from(gaussians) };
    let path = folder.join("raw.ply");
    model.save(&path).unwrap();
    let shown = Gaussians::open(&path).unwrap().dc()[0].x;
    assert!((shown - (before - 0.5 / 0.282_094_8)).abs() < 1e-5);
    let back = Model::load(&path).unwrap();
    assert!(back.raw_colors && back.render_settings().raw_colors);
    assert!((back.gaussians.dc()[0].x - before).abs() < 1e-6);
}

// ---------------------------------------------------------------------------
// The command line

const SMALL: &str =
    "--steps 12 --sh-degree 0 --denoiser-channels 4 --denoiser-stages 1 --denoiser-repeats 2";

/// A folder with the set in `set`.
fn with_set(with_depth: bool) -> Folder {
    let folder = Folder::empty();
    make_set(&folder.path("set"), with_depth);
    folder
}

#[test]
fn a_run_with_networks_is_saved_scored_and_rendered_layer_by_layer() {
    let folder = with_set(true);
    let paper = "--preset lom --model lita --denoiser-crop 16";
    folder.succeed(&format!("train @set --out @run {paper} {SMALL}"));
    let columns = "step,view,loss,l1,ssim,low_l1,low_ssim,structure,depth,depth_local,denoising,\
                   total_variation,gaussians,milliseconds";
    assert_eq!(folder.text("run/train.csv").lines().next().unwrap(), columns);
    let trained = folder.json("run/metrics.json");
    assert!(trained["mean"]["r0"]["psnr"].as_f64().unwrap() > 0.0, "{trained}");
    let scored = json(folder.succeed("eval @run --json"));
    assert_eq!(scored["views"], trained["views"], "the saved networks are those that were trained");

    for (layer, format) in [
        ("rgb", "png"),
        ("denoised", "png"),
        ("depth", "png"),
        ("normal", "png"),
        ("depth-feature", "png"),
        ("structure", "exr"),
        ("illumination", "png"),
        ("noise", "exr"),
    ] {
        let options = format!("--split test --out @{layer} --layer {layer} --format {format}");
        folder.succeed(&format!("render @run {options}"));
        let file = fs::read_dir(folder.path(layer)).unwrap().next().unwrap().unwrap().path();
        assert_eq!(Image::size_of(file).unwrap(), (40, 30), "{layer}");
    }

    // Networks of another configuration.
    let config = folder.text("run/config.toml");
    folder.write("run/config.toml", config.replace("channels = 4", "channels = 5"));
    folder.refused("eval @run", 3, &["networks.safetensors", "\"channels\":4"]);
}

#[test]
fn a_missing_layer_is_named_with_the_available_ones() {
    let folder = with_set(false);
    folder.succeed(&format!("train @set --out @run --parts structure {SMALL}"));
    let parts = ["no denoised", "it has rgb, depth, normal", "transmittance, structure"];
    folder.refused("render @run --split test --out @out --layer denoised", 2, &parts);

    let config = "run/config.toml";
    let with_denoiser = folder.text(config).replace("denoiser = false", "denoiser = true");
    folder.write(config, &with_denoiser);
    folder.refused("eval @run", 3, &["networks.safetensors"]);
    folder.write(config, with_denoiser.replace("variant = \"identity\"", "variant = \"paper\""));
    folder.refused("eval @run", 2, &["no noise, which the denoiser requires"]);
}

/// Without depth maps there is no depth channel, so the other channels are at other positions than the configuration
/// implies.
#[test]
fn a_model_configured_with_unavailable_depth_scores_the_same_when_reloaded() {
    let folder = with_set(false);
    folder.succeed(&format!("train @set --out @run --model lita {SMALL}"));
    let trained = &folder.json("run/metrics.json")["mean"];
    assert!(trained["r0"]["psnr"].is_f64());
    assert_eq!(*trained, json(folder.succeed("eval @run --json"))["mean"]);
}

#[test]
fn a_sweep_of_parts_trains_every_model_and_leaves_pages() {
    let folder = with_set(true);
    let table = folder.succeed(&format!("sweep @set --out @parts --table parts {SMALL}"));
    for name in ["plain", "denoiser", "tonemapper", "structure", "depth", "all"] {
        assert!(folder.path(&format!("parts/parts={name}/metrics.json")).is_file(), "{name}");
        assert!(table.contains(name), "{table}");
    }
    says(&table, &["PSNR, dB of R_0", "gain"]);
    says(&folder.text("parts/index.html"), &["differences to parts plain", "data:image/png"]);
    says(&folder.text("parts/costs.html"), &["device, MiB", "Gaussians"]);
}

#[test]
fn a_sweep_of_parts_leaves_out_depth_if_the_dataset_has_none() {
    let lines = with_set(false).succeed("sweep @set --out @parts --table parts --dry-run");
    assert!(lines.lines().count() == 5 && !lines.contains("parts=depth"), "{lines}");
}

#[test]
fn a_preset_sets_the_paper_s_values_and_options_override_it() {
    let folder = Folder::empty();
    make_set(&folder.path("shrub"), false);
    folder.succeed(&format!("train @shrub --out @run --preset lom --model plain {SMALL}"));
    let lines =
        ["steps = 12", "ssim_weight = 0.4", "seed = 10", "means_rate_steps = 20000", "stages = 1"];
    says(&folder.text("run/config.toml"), &lines);
}
