//! What to type instead of names that this program does not have: former commands, and options of other trainers.

use clap::error::{ContextKind, ContextValue};

/// Former commands and their replacements.
const COMMANDS: [(&str, &str); 4] = [
    ("ablate", "sweep DATASET --out DIR --table parts"),
    ("tradeoff", "sweep DATASET --out DIR --table presets"),
    ("curves", "tone list"),
    ("fit", "tone fit"),
];

/// Options of other trainers, and former ones, with their replacements.
const OPTIONS: [(&str, &str); 13] = [
    (
        "-s -d -i --source_path --source-path --data --data_dir --data-dir --input",
        "DATASET, the first argument without an option",
    ),
    (
        "-m -o --model_path --model-path --output --output_dir --output-dir --output-path --result_dir --result-dir",
        "--out DIR",
    ),
    (
        "-r --resolution --data_factor --data-factor --downscale-factor",
        "--downscale F or --max-resolution N",
    ),
    (
        "--max_steps --max-steps --max-num-iterations --num-iterations --total-steps --iters",
        "--steps N",
    ),
    ("--test_iterations --test-iterations --eval_steps --eval-steps", "--eval-every N"),
    ("--save_iterations --save-iterations --checkpoint_iterations", "--checkpoint-every N"),
    ("--start_checkpoint --load-checkpoint --load-dir", "--resume"),
    ("--cap_max --cap-max --max_cap --max-cap --max-splats", "--max-gaussians N"),
    ("-w --white_background --background-color", "--background black|random"),
    ("--lambda_dssim --ssim_lambda --ssim-lambda", "--ssim-weight W"),
    ("--format --export-format", "`nightsplat export RUN --format FORMAT` after training"),
    ("--growth", "`cargo run --release --example growth`"),
    ("--stress", "`cargo test --release --test cli stress`"),
];

/// The message for a command line with a name of another program or of an earlier version.
pub fn hint(error: &clap::Error) -> Option<String> {
    let given = |kind| match error.get(kind) {
        Some(ContextValue::String(name)) => Some(name.as_str()),
        _ => None,
    };
    if let Some(name) = given(ContextKind::InvalidSubcommand) {
        let (old, new) = COMMANDS.iter().find(|(old, _)| *old == name)?;
        return Some(format!("`nightsplat {old}` is now `nightsplat {new}`"));
    }
    let name = given(ContextKind::InvalidArg)?;
    let (_, ours) = OPTIONS.iter().find(|(names, _)| names.split(' ').any(|own| own == name))?;
    Some(format!("there is no `{name}` here; use {ours}"))
}
