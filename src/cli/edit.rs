//! `nightsplat edit`: changes a model.

mod operations;

use std::cell::Cell;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Result;
use nightsplat_core::output::one_line;
use nightsplat_models::edit::operation::EditList;
use nightsplat_photographs::tree::check_writable;

use self::operations::Operations;
use super::{finish, opener, progress_bar, tell, tell_on_stderr, with_dataset, word};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::results::edit::{EditScore, Editor};

/// Crop, clean, transform and merge models.
///
/// Operations apply in the order of the command line; an option may be repeated. An edit list (--edits) applies before
/// them. --floaters, --max-gaussians and whatever is measured from cameras use the photographs of the run, or those of
/// --dataset; they may come after a transform. The edit of a run says the PSNR of its test views before and after, and
/// warns if more than 0.3 dB are lost.
///
/// The result has the operations in its header, with measured values as numbers. The same command gives the same
/// bytes.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct EditArgs {
    /// Run directory, or a model: PLY, SPZ or SOG
    pub model: PathBuf,
    /// Model to write or replace: .ply, .spz, .glb, .usda, .usdz or .sog
    #[arg(long, value_name = "MODEL")]
    pub out: PathBuf,
    #[command(flatten)]
    operations: Operations,
    /// Apply the edit list of this JSON file first; a list that was made for another model is refused
    #[arg(long, value_name = "FILE")]
    pub edits: Option<PathBuf>,
    /// Also write the operations as an edit list, to repeat them
    #[arg(long, value_name = "FILE")]
    pub save_edits: Option<PathBuf>,
    /// Dataset of a model, or that of the run if it moved
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat edit run --floaters --out clean.ply      without floaters
  nightsplat edit run --crop cameras --out near.ply   what is near or photographed
  nightsplat edit a.ply --crop 0,0,0,1.5 --out b.ply  within 1.5 of the origin
  nightsplat edit run --up auto --scale 0,0,0:1,0,0=0.82 --out metres.ply
  nightsplat edit run --max-gaussians 20000 --sh-degree 1 --out small.spz
  nightsplat edit a.ply --rotate y:90 --move 2,0,0 --merge b.ply --out both.ply";

/// The time between two lines of progress.
const SILENCE: Duration = Duration::from_secs(10);
/// A larger loss of PSNR is warned of, dB.
const MAX_LOSS: f64 = 0.3;

/// Applies the operations and writes the model.
pub fn run(args: &EditArgs) -> Result<()> {
    let list = args.edits.as_deref().map(EditList::load).transpose()?;
    if list.is_none() && args.operations.is_empty() {
        let problem = "no operation is given, such as --crop or --floaters; `nightsplat edit --help` lists them";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    Editor::check_output(&args.model, &args.out)?;
    args.save_edits.iter().try_for_each(|path| check_writable(path))?;
    let mut editor =
        Editor::open(&args.model, args.dataset.as_deref(), opener(args.device.as_ref()))?;
    if let (Some(list), Some(path)) = (&list, &args.edits) {
        editor.check_list(path, list)?;
    }
    let mut unscored = None;
    let listed = list.iter().flat_map(|list| &list.edits);
    for operation in listed.chain(args.operations.iter()) {
        if operation.changes_renders()
            && let Err(reason) = editor.score_before()
        {
            unscored = Some(reason);
        }
        let bar = progress_bar(0);
        let told = Cell::new(Instant::now());
        let line = editor.apply(operation, &|round, most| {
            bar.set_length(most as u64);
            bar.set_position(round as u64);
            if bar.is_hidden() && told.get().elapsed() >= SILENCE {
                tell_on_stderr(format!("floaters: round {round} of at most {most}"));
                told.set(Instant::now());
            }
        });
        bar.finish_and_clear();
        tell(one_line(&line?));
    }
    if let Some(reason) = unscored {
        tracing::warn!("the edit is not scored: {reason}");
    }
    if let Some(EditScore { before, after, against }) = editor.score()? {
        tell(format!(
            "test views against their {against}: {before:.3} dB before, {after:.3} dB after"
        ));
        if before - after > MAX_LOSS {
            tracing::warn!(
                "the edit loses {:.2} dB: views of the photographs show what it removed; leave an operation out, or \
                 make it milder",
                before - after
            );
        }
    }
    let mut wrote = editor.save(&args.out)?;
    if let Some(path) = &args.save_edits {
        editor.save_list(path)?;
        wrote += &format!(", {}", path.display());
    }
    let next = match editor.dataset_folder() {
        Some(folder) => {
            let model = with_dataset(&args.out, Some(&folder));
            format!("nightsplat export {model} --format html")
        }
        None => format!("nightsplat view {}", word(&args.out)),
    };
    finish(&wrote, &next);
    Ok(())
}
