//! `nightsplat ablate`: what each part of the model buys on a scene, and what it costs.

use std::borrow::Cow;
use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;

use super::comparison::{self, Run};
use super::progress;
use super::signals;
use super::table;
use super::train::{TrainOptions, held_unless};
use crate::Error;
use crate::base::output::write_whole;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::image::Image;
use crate::results::eval::{self, Yardstick};
use crate::results::report::{Report, plot};
use crate::results::run::{HeldRun, Session};
use crate::train::{Part, TrainConfig};

/// Train colour alone, each part of LITA-GS alone beside it, and all of them: same seed, same steps.
///
/// Leaves DIR/index.html, a page with the scores, the seconds, the peak memory and the renders side by side, the same table
/// as DIR/table.md, and a run directory for each model. A part that the dataset has nothing for, such as depth without
/// depth maps, is left out.
#[derive(Clone, Debug, clap::Args)]
pub struct AblateArgs {
    /// The dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model in sparse/
    pub dataset: PathBuf,
    /// The folder to write to
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace the runs that DIR already holds
    #[arg(long)]
    pub overwrite: bool,
    /// Go on with the runs that DIR holds, behind the same command that was stopped
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// A model of the comparison: its folder, its name on the page, and its parts.
struct Model {
    folder: String,
    title: String,
    config: TrainConfig,
}

/// Trains every model and writes the page.
///
/// # Errors
/// A setting picks parts or is not usable, the dataset is not, a run is there already, or a file cannot be written.
pub fn run(args: &AblateArgs) -> Result<()> {
    if args.options.picks_parts() {
        let problem = "ablate trains every part by itself; leave out --model and --parts (lita's L1 alone is --ssim-weight 0)";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    let mut config = args.options.config(&args.dataset, None)?;
    // Whether there are depth maps is for the dataset to say.
    config.model.depth = true;
    let gpu = Gpu::new(&config.device.parse::<DeviceChoice>()?)?;
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    config.leave_out_what_is_missing(&dataset);
    let models = models(&config);
    for Model { folder, .. } in &models {
        let taken = args.out.join(folder);
        if taken.join("config.toml").exists() && !args.overwrite && !args.resume {
            let problem =
                "already holds a run; pass --resume to go on or --overwrite to replace it";
            return Err(Error::output(taken, problem).into());
        }
    }
    let (requests, mut runs) = (signals::requests()?, vec![]);
    for (i, Model { folder, title, config }) in models.iter().enumerate() {
        tracing::info!("{} of {}: {title}", i + 1, models.len());
        let out = args.out.join(folder);
        let held = if args.resume { HeldRun::Resume } else { held_unless(args.overwrite) };
        let session = Session { held, requests: requests.clone(), ..Session::default() };
        let trained = progress::train_in(&gpu, config, &dataset, &out, &session)?;
        runs.push(Run::new(title.clone(), trained, &dataset)?);
    }
    let dark = eval::score(&dataset, |view| {
        // A test view without its dark photograph shows nothing.
        let black = || Image::filled(view.camera.width, view.camera.height, [0.0; 3]);
        Ok(view.loaded()?.map_or_else(black, Cow::into_owned).into())
    })?;
    let table = comparison::score_table("model", &dark, &runs);
    let epoch = dataset.train_views().count();
    let mut page = Report {
        title: format!("What each part buys: {}", dataset.root.display()),
        intro: vec![format!(
            "{} steps each with seed {}, on {}. R_0 is the render of the Gaussians' colours; a model with a denoiser is \
             scored behind it.",
            config.steps,
            config.seed,
            gpu.properties().name
        )],
        plots: vec![plot("step", "loss", &comparison::loss_series(&runs, epoch))],
        comparisons: comparison::of_views(&dataset, &dark, &runs)?,
        tables: vec![table.clone()],
        ..Report::default()
    };
    let known = config.tone.knows_references().map(|known| eval::with_reference(&known));
    let against = Yardstick::kind(&config.tone, &dataset).label();
    let against = against.map(|label| format!("The test views are scored {label}."));
    let notes: Vec<String> = known.into_iter().chain(against).collect();
    page.intro.extend(notes.clone());
    let index = args.out.join("index.html");
    write_whole(&index, page.html().as_bytes())?;
    write_whole(
        &args.out.join("table.md"),
        (table.markdown() + &notes.iter().map(|line| format!("\n{line}\n")).collect::<String>())
            .as_bytes(),
    )?;
    let mut out = std::io::stdout().lock();
    write!(out, "{}\n{}\n", table::of(&table), index.display())?;
    for line in notes {
        writeln!(out, "{line}")?;
    }
    Ok(())
}

/// Colour alone, each part alone, all of them.
fn models(config: &TrainConfig) -> Vec<Model> {
    let usable: Vec<Part> =
        Part::ALL.into_iter().filter(|&part| part != Part::Depth || config.model.depth).collect();
    let model = |folder: &str, title: String, parts: &[Part]| {
        let mut config = config.clone();
        config.model.set_parts(parts);
        Model { folder: folder.to_owned(), title, config }
    };
    let mut models = vec![model("plain", "plain".to_owned(), &[])];
    models.extend(
        usable.iter().map(|part| model(part.name(), format!("+ {}", part.name()), &[*part])),
    );
    models.push(model("lita", "all parts".to_owned(), &usable));
    models
}
