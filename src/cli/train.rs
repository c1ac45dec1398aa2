//! `nightsplat train`: dark photographs in, a run directory out.

mod facts;

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;

use self::facts::Facts;
use super::diagnose;
use super::progress::{ProgressForm, Reporter, summary};
use super::signals;
use crate::base::output::printable;
use crate::gpu::{DeviceChoice, Gpu};
use crate::networks::Precision;
use crate::photographs::dataset::Dataset;
use crate::photographs::tone::{CurveChoice, GainChoice, Profile, ToneCurve, ToneSettings};
use crate::results::eval;
use crate::results::run::{self, HeldRun, RunDirectory, Session, Trained};
use crate::splats::densify::DensityControl;
use crate::train::diagnose::{Diagnosis, Plan};
use crate::train::{Background, CacheSize, Learning, ModelName, Part, Preset, TrainConfig};

/// Train a 3D Gaussian Splatting model from dark photographs.
///
/// Each photograph is lifted by a tone curve into the pseudo-GT that supervises training; normal-light reference images,
/// where the dataset has them, are only ever used for scores. What the model has is decided by looking at the photographs
/// first (`nightsplat diagnose`), and said; any option wins over that. With --config, or a preset that states it all
/// (paper, or a benchmark's), nothing is decided.
///
/// SIGINT and SIGTERM save and stop, with exit code 130 or 143, and a second one ends the process at once; SIGUSR1 saves and
/// goes on. --resume goes on from there to the same bits; where the run is done it does nothing and succeeds.
#[derive(Clone, Debug, clap::Args)]
pub struct TrainArgs {
    /// The dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model in sparse/, as `nightsplat pose` makes one
    pub dataset: PathBuf,
    /// The run directory to write: config.toml, model.ply, the networks, train.csv, evals.csv, a checkpoint, metrics.json
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    /// Replace the run that RUN already holds
    #[arg(long)]
    pub overwrite: bool,
    /// Go on from the checkpoint in RUN, or begin where there is none; the model gets the same bits as in one go. Give the options that the run began with; --steps may be more, --max-gaussians less, and what is logged another
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    /// The plan that `nightsplat diagnose --plan` wrote, in place of a diagnosis now; none: no plan, the defaults
    #[arg(long, value_name = "FILE|none")]
    pub plan: Option<PathBuf>,
    /// How to say what the run does [default: a bar on a terminal, else plain]
    #[arg(long, value_enum, value_name = "FORM")]
    pub progress: Option<ProgressForm>,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// The options of a run; each wins over the configuration file.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, Default, clap::Args)]
pub(crate) struct TrainOptions {
    /// The tone curve: a name that `nightsplat curves` lists, or a .toml, .csv or .cube file [default: {tone.curve}]
    #[arg(long, value_name = "NAME|FILE")]
    curve: Option<CurveChoice>,
    /// A camera profile that `nightsplat fit --profile` made, in place of a curve; results are labelled: they know its references
    #[arg(long, value_name = "FILE", conflicts_with_all = ["curve", "gain", "brightness", "colour", "theta"])]
    profile: Option<PathBuf>,
    /// c: how much a brighter photograph raises the curve's gain, or auto: the gain that the photographs ask for, as the curve auto has it [default: {tone.gain_c of ase} for ase, {tone.gain_c of ap3} for ap3, else {tone.gain_c of linear}]
    #[arg(long, value_name = "C|auto")]
    gain: Option<GainChoice>,
    /// The mean luminance of the targets, 0.1 to 0.9, where the gain is automatic [default: found between 0.44 and 0.54]
    #[arg(long, value_name = "T")]
    brightness: Option<f64>,
    /// lambda: how much of the curve auto keeps the ratios of the channels, 0 to 1 [default: one third]
    #[arg(long, value_name = "L")]
    colour: Option<f64>,
    /// The mean that the linear curve aims at [default: {tone.theta}]
    #[arg(long, value_name = "T")]
    theta: Option<f64>,
    /// Training steps, one view each [default: {steps}]
    #[arg(long, value_name = "N")]
    pub(super) steps: Option<u64>,
    /// Shrink the photographs by this factor [default: {downscale}]
    #[arg(long, value_name = "F")]
    downscale: Option<f64>,
    /// Shrink photographs whose longest side is still larger to so many pixels; 0 or none: take them as they are. Brightness is measured, and the curve applied, at their own size [default: {max_resolution}]
    #[arg(long, value_name = "N|none", value_parser = max_resolution)]
    max_resolution: Option<u32>,
    /// Train on photographs of more than so many pixels patch by patch; steps then take less memory, and more of them see each photograph once [default: as many as the device can bind]
    #[arg(long, value_name = "N")]
    patch_pixels: Option<u64>,
    /// Memory for photographs, such as 4G, on the device and decoded on the host; the rest waits on disk, which takes time and changes no bit [default: a quarter of the memory of each]
    #[arg(long, value_name = "SIZE")]
    cache: Option<CacheSize>,
    /// The most that buffers may take on the device, such as 4G: growth stops in time, and what exceeds it all the same ends the run, saved, with exit code 4 [default: all that there is]
    #[arg(long, value_name = "SIZE")]
    max_vram: Option<CacheSize>,
    /// The most that the process is to take on the host, as far as that can be foreseen: growth stops in time [default: all that there is]
    #[arg(long, value_name = "SIZE")]
    max_ram: Option<CacheSize>,
    /// Hold out every Nth view by name, whatever split the dataset has; 0: none, train on all [default: the dataset's split, else every 8th]
    #[arg(long, value_name = "N")]
    test_every: Option<usize>,
    /// Everything random follows from it; the same seed gives the same bits [default: {seed}]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Highest degree of the spherical harmonics, 0 to 3 [default: {sh_degree}]
    #[arg(long, value_name = "D")]
    sh_degree: Option<u32>,
    /// Weight of 1 - SSIM beside L1, 0 to 1 [default: {ssim_weight}]
    #[arg(long, value_name = "W")]
    ssim_weight: Option<f64>,
    /// Never grow beyond this many Gaussians [default: {max_gaussians}]
    #[arg(long, value_name = "N")]
    max_gaussians: Option<usize>,
    /// What comes of a Gaussian that multiplies: conserving, two halves that cover what it covered, or paper, LITA-GS's [default: {density.control}]
    #[arg(long, value_name = "NAME")]
    density: Option<DensityControl>,
    /// black, or random: another colour every step [default: {background}]
    #[arg(long)]
    background: Option<Background>,
    /// on: learn gain and bias of each channel of each training view, where photographs are not equally bright; off [default: {exposure.learn}]
    #[arg(long, value_name = "on|off")]
    exposure: Option<Learning>,
    /// Learn exposures from where this table has them: name,ev or name,gain_r,gain_g,gain_b,bias_r,bias_g,bias_b [default: exposures.csv of the dataset]
    #[arg(long, value_name = "FILE")]
    exposures: Option<PathBuf>,
    /// Begin with the Gaussians of a PLY, of a run or of another program, in the dataset's world, in place of the dataset's points
    #[arg(long, value_name = "MODEL.ply")]
    init: Option<PathBuf>,
    /// A folder of reference images by name, for scores only
    #[arg(long, value_name = "DIR")]
    reference: Option<PathBuf>,
    /// Masks (masks/NAME.png or masks/NAME.jpg.png of the dataset) hide what is white, not what is black
    #[arg(long)]
    invert_masks: bool,
    /// Undistort the photographs of a fisheye to a pinhole's, cropped to 60 degrees off its axis, in place of training on
    /// the fisheye as it is; those of other distorted lenses are always undistorted
    #[arg(long)]
    undistort: bool,
    #[command(flatten)]
    model: ModelOptions,
    /// Nothing nearer to a camera is seen, in units of the scene's extent: of how far the cameras stand from their middle [default: {near}]
    #[arg(long, value_name = "N")]
    near: Option<f64>,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// A TOML file with any of the settings of a run's config.toml
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Score the test views every N steps as well as at the end: a line, and a row of evals.csv
    #[arg(long, value_name = "N")]
    eval_every: Option<u64>,
    /// Leave RUN/tensorboard: losses, rates, Gaussians, scores, and a test view, for `tensorboard --logdir RUN`
    #[arg(long)]
    tensorboard: bool,
    /// Write what --resume goes on from, and the model, every N steps; 0: never [default: {checkpoint_every}]
    #[arg(long, value_name = "N")]
    checkpoint_every: Option<u64>,
    /// Write it whenever the last is so many minutes old, too; 0: never [default: {checkpoint_minutes}]
    #[arg(long, value_name = "MINUTES")]
    checkpoint_minutes: Option<f64>,
    /// Save and stop after so many minutes, with exit code 75; --resume goes on; 0: train to the end [default: {max_minutes}]
    #[arg(long, value_name = "MINUTES")]
    max_minutes: Option<f64>,
    /// Log a checksum of every plane of the parameters to hashes.csv every N steps; 0: never [default: {hash_every}]
    #[arg(long, value_name = "N")]
    hash_every: Option<u64>,
    /// Compare every pass of every Nth step with its CPU reference, and warn of what differs; 0: never [default: {check.every}]
    #[arg(long, value_name = "N")]
    check_every: Option<u64>,
    /// Stop where a checked step differs
    #[arg(long)]
    check_stops: bool,
    /// Any other setting by its place in config.toml, such as tone.alpha=0.1; may be repeated, wins over all else
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// The options that say what the model has beside colour.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Model")]
pub(crate) struct ModelOptions {
    /// plain: colour alone, as 3DGS; lita: every part of LITA-GS and L1 alone on R_0, which with a preset of the paper's is its model, else each begins as the identity [default: plain]
    #[arg(long)]
    model: Option<ModelName>,
    /// Exactly these parts, parted by commas: denoiser, tonemapper, structure, depth
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    parts: Option<Vec<Part>>,
    /// draft, fast, balanced (the default) or best: time for quality; paper: the paper's curve and length; or the constants that the paper and its code state for a benchmark: lom, realx3d or mip360-varying; other options win
    #[arg(long, value_name = "NAME")]
    preset: Option<Preset>,
    /// Train the networks on a random crop of at most N x N pixels a step; 0: on the whole view [default: {model.denoiser_crop}]
    #[arg(long, value_name = "N")]
    denoiser_crop: Option<u32>,
    /// Feature maps of the denoiser [default: {model.network.channels}]
    #[arg(long, value_name = "N")]
    denoiser_channels: Option<u32>,
    /// Stages of the denoiser [default: {model.network.stages}]
    #[arg(long, value_name = "N")]
    denoiser_stages: Option<u32>,
    /// Repeats of the inner convolution in a stage [default: {model.network.repeats}]
    #[arg(long, value_name = "N")]
    denoiser_repeats: Option<u32>,
    /// single, or half: 16-bit factors in the inner convolution where the device has matrices of them [default: {model.network.precision}]
    #[arg(long, value_name = "P")]
    denoiser_precision: Option<Precision>,
    /// A folder of depth maps, `NAME.*` or `depth_NAME.*`, larger is farther [default: `depth/` or `depth_maps/` of the dataset]
    #[arg(long, value_name = "DIR")]
    depth: Option<PathBuf>,
    /// The depth maps hold disparity: larger is nearer
    #[arg(long)]
    depth_is_disparity: bool,
    /// Colours are the bare SH sum of LITA-GS instead of max(SH + 0.5, 0) [default: {model.raw_colors}]
    #[arg(long, value_name = "BOOL")]
    raw_colors: Option<bool>,
}

impl ModelOptions {
    fn apply(&self, config: &mut TrainConfig) -> crate::Result<()> {
        match self.model {
            Some(ModelName::Plain) => config.model.set_parts(&[]),
            Some(ModelName::Lita) => {
                config.model.set_parts(&Part::ALL);
                config.ssim_weight = 0.0;
            }
            None => {}
        }
        if let Some(preset) = self.preset {
            preset.apply(config)?;
        }
        if let Some(parts) = &self.parts {
            config.model.set_parts(parts);
        }
        let model = &mut config.model;
        set(&mut model.denoiser_crop, &self.denoiser_crop);
        set(&mut model.network.channels, &self.denoiser_channels);
        set(&mut model.network.stages, &self.denoiser_stages);
        set(&mut model.network.repeats, &self.denoiser_repeats);
        set(&mut model.network.precision, &self.denoiser_precision);
        set(&mut model.raw_colors, &self.raw_colors);
        if self.depth.is_some() {
            model.depth_folder.clone_from(&self.depth);
        }
        model.depth_is_disparity |= self.depth_is_disparity;
        Ok(())
    }
}

/// Takes over what the command line says.
fn set<T: Clone>(value: &mut T, option: &Option<T>) {
    if let Some(option) = option {
        value.clone_from(option);
    }
}

impl TrainOptions {
    /// Whether the command line says which parts the model has.
    pub(crate) fn picks_parts(&self) -> bool {
        self.model.model.is_some() || self.model.parts.is_some()
    }

    /// A line for each option that says something of what `config` has not.
    fn idle(&self, config: &TrainConfig) -> Vec<String> {
        let (model, networks) = (&self.model, [Part::Denoiser, Part::Tonemapper]);
        let options: [(&str, bool, &[Part]); 7] = [
            ("denoiser-crop", model.denoiser_crop.is_some(), &networks),
            ("denoiser-channels", model.denoiser_channels.is_some(), &[Part::Denoiser]),
            ("denoiser-stages", model.denoiser_stages.is_some(), &[Part::Denoiser]),
            ("denoiser-repeats", model.denoiser_repeats.is_some(), &[Part::Denoiser]),
            ("denoiser-precision", model.denoiser_precision.is_some(), &[Part::Denoiser]),
            ("depth", model.depth.is_some(), &[Part::Depth]),
            ("depth-is-disparity", model.depth_is_disparity, &[Part::Depth]),
        ];
        let is_idle = |parts: &[Part]| !parts.iter().any(|&part| config.model.has(part));
        let idle = options.into_iter().filter(|(_, is_given, parts)| *is_given && is_idle(parts));
        let line = |(option, _, parts): (&str, bool, &[Part])| {
            let names: Vec<&str> = parts.iter().map(|part| part.name()).collect();
            format!(
                "--{option} has no effect, as the model has no {}; --parts {} switches it on",
                names.join(" and no "),
                names[0]
            )
        };
        let mut lines: Vec<String> = idle.map(line).collect();
        if self.check_stops && config.check.every == 0 {
            lines.push("--check-stops has no effect, as no step is checked; --check-every N says which are".to_owned());
        }
        let stop = &config.stop;
        let gains = [("growth_gain", stop.growth_gain), ("degree_gain", stop.degree_gain)];
        let idle = gains.into_iter().filter(|(_, gain)| stop.views == 0 && *gain > 0.0);
        lines.extend(idle.map(|(gain, _)| {
            format!("stop.{gain} has no effect, as no views are held out; --set stop.views=N keeps N of them from training")
        }));
        lines
    }

    /// Whether a diagnosis of the photographs is to decide what no option says.
    pub(super) fn wants_a_plan(&self) -> bool {
        self.config.is_none() && self.model.preset.is_none_or(Preset::is_planned)
    }

    /// Whether the command line says how photographs are lifted.
    fn names_a_curve(&self) -> bool {
        let numbers = [self.brightness, self.colour, self.theta];
        self.curve.is_some()
            || self.profile.is_some()
            || self.gain.is_some()
            || numbers.iter().any(Option::is_some)
    }

    /// The configuration without a plan: defaults, then the file, then preset and model, then the other options.
    pub(crate) fn config(&self, dataset: PathBuf) -> crate::Result<TrainConfig> {
        self.config_over(dataset, None, None)
    }

    /// The same for a run that is planned, whose preset is balanced where none is named; behind that, what the plan says.
    pub(super) fn planned_config(
        &self,
        dataset: PathBuf,
        plan: Option<&Plan>,
    ) -> crate::Result<TrainConfig> {
        self.config_over(dataset, Some(Preset::Balanced), plan)
    }

    fn config_over(
        &self,
        dataset: PathBuf,
        preset: Option<Preset>,
        plan: Option<&Plan>,
    ) -> crate::Result<TrainConfig> {
        let mut config = TrainConfig::default();
        if let Some(file) = &self.config {
            config = TrainConfig::load(file)?;
        } else if let Some(preset) = preset {
            preset.apply(&mut config)?;
        }
        config.dataset = dataset;
        match &self.curve {
            Some(CurveChoice::Named(curve)) => config.tone = config.tone.with_curve(*curve),
            Some(file) => config.tone = file.settings()?,
            None => {}
        }
        if let Some(file) = &self.profile {
            config.tone = ToneSettings::of_profile(Profile::load(file)?);
        }
        self.model.apply(&mut config)?;
        if let Some(plan) = plan {
            let given = config.clone();
            plan.apply(&mut config);
            // What is named is no question any more; the options below win by coming later.
            if self.names_a_curve() {
                config.tone = given.tone;
            }
            if self.picks_parts() {
                config.model = given.model;
            }
            if config.model.tonemapper {
                // The two exclude each other, and a plan never asks for both.
                config.exposure = given.exposure;
            }
        }
        if self.curve == Some(ToneCurve::Auto.into()) {
            // Benchmarks put the paper's curve in place of the default one; here it is named.
            config.tone = config.tone.with_curve(ToneCurve::Auto);
        }
        if let Some(gain) = self.gain {
            config.tone = config.tone.with_gain(gain);
        }
        config.tone.brightness = self.brightness.or(config.tone.brightness);
        set(&mut config.tone.colour, &self.colour);
        set(&mut config.tone.theta, &self.theta);
        if let Some(steps) = self.steps {
            // Whoever says how long a run is to be wants neither less nor views kept from it.
            (config.steps, config.stop.views) = (steps, 0);
        }
        set(&mut config.downscale, &self.downscale);
        set(&mut config.max_resolution, &self.max_resolution);
        config.patch_pixels = self.patch_pixels.or(config.patch_pixels);
        config.cache = self.cache.or(config.cache);
        config.max_vram = self.max_vram.or(config.max_vram);
        config.max_ram = self.max_ram.or(config.max_ram);
        config.test_every = self.test_every.or(config.test_every);
        config.tensorboard |= self.tensorboard;
        set(&mut config.seed, &self.seed);
        set(&mut config.sh_degree, &self.sh_degree);
        set(&mut config.ssim_weight, &self.ssim_weight);
        set(&mut config.max_gaussians, &self.max_gaussians);
        set(&mut config.density.control, &self.density);
        set(&mut config.background, &self.background);
        set(&mut config.near, &self.near);
        set(&mut config.device, &self.device);
        set(&mut config.eval_every, &self.eval_every);
        set(&mut config.checkpoint_every, &self.checkpoint_every);
        set(&mut config.checkpoint_minutes, &self.checkpoint_minutes);
        set(&mut config.max_minutes, &self.max_minutes);
        set(&mut config.hash_every, &self.hash_every);
        set(&mut config.check.every, &self.check_every);
        config.check.stops |= self.check_stops;
        config.invert_masks |= self.invert_masks;
        config.undistort |= self.undistort;
        if self.exposures.is_some() {
            (config.exposure.learn, config.exposure.start) = (Learning::On, self.exposures.clone());
        }
        set(&mut config.exposure.learn, &self.exposure);
        if self.init.is_some() {
            config.init.clone_from(&self.init);
        }
        if self.reference.is_some() {
            config.reference.clone_from(&self.reference);
        }
        let config = config.with(&self.set)?;
        config.check()?;
        Ok(config)
    }
}

/// Trains, scores and writes the run directory.
///
/// # Errors
/// Whatever keeps the run from its end, in one line.
pub fn run(args: &TrainArgs) -> Result<()> {
    let config = args.options.config(args.dataset.clone())?;
    match args.resume {
        true => RunDirectory::check_resumed(&args.out)?,
        false => RunDirectory::check(&args.out, args.overwrite)?,
    }
    let gpu = Gpu::new(&config.device.parse::<DeviceChoice>()?)?;
    let Planned { config, plan, dataset } = planned(args, config, &gpu)?;
    for line in args.options.idle(&config) {
        tracing::warn!("{line}");
    }
    let finished = if args.resume { run::done_steps(&args.out, &config, &dataset)? } else { None };
    if let Some(steps) = finished {
        let done = format!("{} is done: {steps} steps", args.out.display());
        return Ok(writeln!(std::io::stdout(), "{}", printable(&done))?);
    }
    let form = args.progress.unwrap_or_else(ProgressForm::of_terminal);
    let is_text = form != ProgressForm::Json;
    let mut out = std::io::stdout();
    let facts = Facts::of(&gpu, &config, plan.as_ref(), &dataset);
    if is_text {
        write!(
            out,
            "{}{}",
            facts.text(),
            plan.as_ref().map(diagnose::decisions).unwrap_or_default()
        )?;
    }
    let held = if args.resume { HeldRun::Resume } else { held_unless(args.overwrite) };
    let mut progress = Reporter::new(form).with_facts(serde_json::json!(facts));
    let session = Session { plan: plan.as_ref(), held, requests: signals::requests()? };
    let Trained { trainer, ended, scored, spent, .. } =
        run::train_in(&gpu, &config, &dataset, &args.out, &session, |event| {
            progress.observe(event);
        })?;
    if !is_text {
        return Ok(());
    }
    let gaussians = trainer.gaussian_count();
    writeln!(out, "{ended}")?;
    if let Some(line) = summary(&scored) {
        writeln!(out, "{line}")?;
    }
    if let Some(known) = config.tone.knows_references() {
        writeln!(out, "{}", eval::with_reference(&known))?;
    }
    if let Some(label) = eval::label(&scored) {
        writeln!(out, "the scores are {label}")?;
    }
    writeln!(
        out,
        "{} steps, {gaussians} Gaussians, {:.0} s -> {}",
        trainer.steps_done(),
        spent.seconds,
        args.out.display()
    )?;
    Ok(())
}

/// What a run begins with.
struct Planned {
    config: TrainConfig,
    plan: Option<Plan>,
    /// Without the views that the plan leaves out.
    dataset: Dataset,
}

/// Loads the dataset and plans the run, where no option says everything. A run that goes on keeps to its plan.
fn planned(args: &TrainArgs, config: TrainConfig, gpu: &Gpu) -> crate::Result<Planned> {
    let is_resumed = args.resume && args.out.join("config.toml").is_file();
    let given = args.plan.clone().filter(|path| path != Path::new("none"));
    let file = given.or_else(|| run::plan_of(&args.out).filter(|_| is_resumed));
    let diagnoses = args.plan.is_none() && !is_resumed && args.options.wants_a_plan();
    if file.is_none() && !diagnoses {
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        return Ok(Planned { config, plan: None, dataset });
    }
    let config = args.options.planned_config(config.dataset, None)?;
    let config = if is_resumed { as_begun(args, config)? } else { config };
    let options = diagnose::load_options(&config);
    let mut dataset = Dataset::load(&config.dataset, &options)?;
    let plan = match file {
        Some(file) => Plan::load(&file, &dataset)?,
        None => {
            let diagnosis = Diagnosis::of(&dataset, &options)?;
            for remark in &diagnosis.remarks {
                tracing::warn!("{remark}");
            }
            Plan::new(&diagnosis, &config, gpu.properties().memory)
        }
    };
    dataset.leave_out(&plan.left_out);
    let config = args.options.planned_config(config.dataset, Some(&plan))?;
    let config = if is_resumed { as_begun(args, config)? } else { config };
    Ok(Planned { config, plan: Some(plan), dataset })
}

/// A run that is resumed with a number of steps keeps the views that it began with: those held out stay so.
fn as_begun(args: &TrainArgs, mut config: TrainConfig) -> crate::Result<TrainConfig> {
    if args.options.steps.is_some() {
        config.stop.views = run::load_config(&args.out)?.stop.views;
    }
    Ok(config)
}

/// What `--max-resolution` says.
pub(super) fn max_resolution(text: &str) -> Result<u32, String> {
    match text {
        "none" => Ok(0),
        _ => text.parse().map_err(|_| "a number of pixels, or none".to_owned()),
    }
}

/// What `--overwrite` says.
pub(crate) fn held_unless(overwrite: bool) -> HeldRun {
    if overwrite { HeldRun::Replace } else { HeldRun::Refuse }
}
