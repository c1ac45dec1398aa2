//! What to type instead of the options of other trainers, and of a path that does not exist.

use clap::error::{ContextKind, ContextValue, ErrorKind};

/// Options of other trainers, with their replacements.
const OPTIONS: [(&str, &str); 11] = [
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
];

/// The message for a command line with an option of another trainer, or with a word that is neither command nor path.
pub fn hint(error: &clap::Error) -> Option<String> {
    let is_like_none = error.get(ContextKind::SuggestedSubcommand).is_none();
    if let (ErrorKind::InvalidSubcommand, true, Some(ContextValue::String(word))) =
        (error.kind(), is_like_none, error.get(ContextKind::InvalidSubcommand))
    {
        return Some(format!("there is no command, folder or file `{word}`"));
    }
    let Some(ContextValue::String(name)) = error.get(ContextKind::InvalidArg) else { return None };
    let (_, ours) =
        OPTIONS.iter().find(|(names, _)| names.split(' ').any(|option| option == name))?;
    Some(format!("there is no `{name}` here; use {ours}"))
}
