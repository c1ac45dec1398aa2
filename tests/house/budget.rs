//! How large the tree may be. Without a limit it only grows: a change removes as much as it adds, or raises a number
//! here, and its commit says what for.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use crate::architecture::{ROOT, paths};

/// Lines that are not blank (code, comments, unit tests) of a folder, and what it is for. A folder of `src` includes
/// the file of its name beside it.
const BUDGET: &[(&str, usize, &str)] = &[
    (
        "src/base",
        1242,
        "Errors, files, tables, hashes, settings and random numbers; what planted links decide.",
    ),
    ("src/blocks", 1379, "Scenes that outgrow a device, in parts."),
    ("src/camera", 2138, "Cameras, their models, patches and paths."),
    ("src/capi", 1701, "The interface in C."),
    ("src/cli", 10015, "Arguments and text of the commands."),
    ("src/gpu", 6573, "Vulkan: devices, buffers, passes, and what hosts lend."),
    ("src/loss", 2072, "The terms of the loss."),
    ("src/networks", 2638, "Denoiser, tonemapper, structure and LPIPS."),
    (
        "src/photographs",
        20686,
        "Images, datasets, tone curves and their fits; nights, a chart; rows while decoding, limits of small files.",
    ),
    ("src/reference", 5793, "Each kernel on the CPU, with the bounds of its errors."),
    ("src/results", 11407, "Runs, scores, reports, edits and files of models."),
    ("src/splats", 7843, "Gaussians: rendering, optimizer, density control."),
    (
        "src/train",
        10724,
        "The trainer and its settings, diagnosis and plan; fall-off, bands of lamps; detail of a score.",
    ),
    ("src", 944, "Files without a folder: the list of modules, the self-test."),
    ("tests", 31170, "What no unit test of a file can show."),
    ("shaders-glsl", 6050, "The kernels."),
    ("scripts", 5337, "Measurements, packages, checks against other programs."),
    ("docs", 2015, "What users and contributors read."),
];

/// What is written by hand; the rest is data or generated.
const EXTENSIONS: [&str; 12] =
    ["rs", "comp", "glsl", "vert", "frag", "js", "css", "html", "c", "py", "sh", "md"];

/// The row of a file.
fn row(path: &Path) -> String {
    let names: Vec<&str> = path.iter().map(|name| name.to_str().unwrap()).collect();
    let folder = format!("src/{}", names[1].trim_end_matches(".rs"));
    let is_of_a_folder = names[0] == "src" && Path::new(ROOT).join(&folder).is_dir();
    if is_of_a_folder { folder } else { names[0].to_owned() }
}

/// The lines of each row.
fn lines() -> BTreeMap<String, usize> {
    let mut lines = BTreeMap::new();
    let all = ["src", "tests", "shaders-glsl", "scripts", "docs"].into_iter().flat_map(paths);
    for path in all.filter(|path| !path.starts_with("tests/fixtures")) {
        if path
            .extension()
            .is_some_and(|extension| EXTENSIONS.iter().any(|known| extension == *known))
        {
            let text = fs::read_to_string(Path::new(ROOT).join(&path)).unwrap();
            let written = text.lines().filter(|line| !line.trim().is_empty()).count();
            *lines.entry(row(&path)).or_default() += written;
        }
    }
    lines
}

#[test]
fn the_tree_keeps_within_its_budget_and_the_budget_close_to_the_tree() {
    let mut lines = lines();
    let (mut broken, mut table) = (String::new(), String::new());
    for &(folder, limit, purpose) in BUDGET {
        let count = lines.remove(folder).unwrap_or_default();
        writeln!(table, "    ({folder:?}, {count}, {purpose:?}),").unwrap();
        if count > limit {
            writeln!(broken, "{folder} has {count} lines and may have {limit}: remove some")
                .unwrap();
        } else if limit > count + (count / 50).max(30) {
            writeln!(broken, "{folder} has {count} lines: lower its limit of {limit}").unwrap();
        }
    }
    assert!(lines.is_empty(), "without a row in {}: {lines:?}", file!());
    assert!(broken.is_empty(), "{broken}The table of {} for this tree:\n{table}", file!());
}
