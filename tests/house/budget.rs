//! How large the tree may be. Without a limit it only grows: a change removes as much as it adds, or raises a number
//! here, and its commit says what for.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::Command;

use crate::architecture::{ROOT, paths};

/// Lines that are not blank (code, comments, unit tests) of a folder, and what it is for. A folder of `src` includes
/// the file of its name beside it.
const BUDGET: &[(&str, usize, &str)] = &[
    (
        "crates/capi",
        4500,
        "The interface in C with instances, eyes, picks, watches and scores, and its tests, of every wrong call too.",
    ),
    (
        "crates/core",
        5165,
        "Errors, files, locks, settings, cameras, watched work, images, formulas of curves, and their properties.",
    ),
    (
        "crates/diagnose",
        2697,
        "What the photographs of a capture show: noise, blur, overlap, lamps and bands by conjugate gradients; tests.",
    ),
    (
        "crates/fit",
        2368,
        "Curves and profiles from pairs of photographs, and their tests on synthetic pairs.",
    ),
    (
        "crates/models",
        9067,
        "Gaussians on the host, their formats, the page with a viewer, levels of detail, edits, and their tests.",
    ),
    (
        "crates/photographs",
        20582,
        "Images, datasets and their parts, tone curves, normal maps, exposures, measurements, skies; their tests.",
    ),
    (
        "crates/pose",
        2895,
        "Poses of dark photographs by COLMAP, again where few or impossible ones are found; drops weak cameras; tests.",
    ),
    ("crates/python", 1650, "The Python package, its types and tests, orthographic cameras too."),
    (
        "crates/report",
        1919,
        "Pages with tables and charts, colour maps, videos, event files, and the tests of pages.",
    ),
    (
        "crates/synth",
        2270,
        "Synthetic sets, with nights, faults of cameras and normal maps; varied sets; and their tests.",
    ),
    (
        "src/bench",
        1267,
        "What `bench` measures; the tuner's tiles, sorts, segments, sums and strips.",
    ),
    ("src/blocks", 960, "Plans, drafts and joins of scenes that outgrow a device."),
    (
        "src/cli",
        6977,
        "Arguments and text of the commands, one for all of them, and words for every verdict.",
    ),
    (
        "src/gpu",
        7659,
        "Vulkan: devices, buffers, passes, checks, tiles; what hosts of any version lend; buffers filled by the host.",
    ),
    ("src/live", 940, "The live page of a run, from which the model is downloaded."),
    (
        "src/loss",
        2109,
        "The terms of the loss, of normals too, kernels ahead, strips of SSIM as tuned.",
    ),
    ("src/networks", 2923, "Denoiser, on maps in 16 bits too, tonemapper, structure and LPIPS."),
    (
        "src/reference",
        6731,
        "Each kernel on the CPU, with its errors, in 16 bits, norms of packed maps, formats of images, normals.",
    ),
    (
        "src/results",
        8453,
        "Runs, sweeps, scores, verdicts that tell a sky from a hole, mapped photographs, contact sheets, edits.",
    ),
    (
        "src/splats",
        6866,
        "Gaussians: rendering, instances, eyes, picks, motion, depth, sorts, kept lists, optimizer, growth, lamps.",
    ),
    ("src/targets", 441, "Targets of views on the device, or of another program."),
    (
        "src/train",
        9639,
        "The trainer, its settings and their length; fall-off, lamps, skies; kernels ahead; lists; palettes; growth.",
    ),
    (
        "src",
        922,
        "Files without a folder: the list of modules, the self-test, the stages of the one command.",
    ),
    (
        "tests",
        25107,
        "What no unit test of a file can show, and needs the engine or the command; packed maps; strips of SSIM.",
    ),
    (
        "shaders-glsl",
        7125,
        "The kernels, with a sort of each tile, staged batches, networks on packed maps, picks, motion, normals.",
    ),
    (
        "scripts",
        6390,
        "Measurements, the paper, packages, releases, pictures, mutants, GPU compilers, matrices, checks of others.",
    ),
    (
        "docs",
        2409,
        "What users and contributors read, with pages of the paper, of pose, of curves, and a gallery.",
    ),
];

/// What is written by hand; the rest is data or generated.
const EXTENSIONS: [&str; 12] =
    ["rs", "comp", "glsl", "vert", "frag", "js", "css", "html", "c", "py", "sh", "md"];

/// The row of a file.
fn row(path: &Path) -> String {
    let names: Vec<&str> = path.iter().map(|name| name.to_str().unwrap()).collect();
    let folder = format!("{}/{}", names[0], names[1].trim_end_matches(".rs"));
    let has_rows = ["src", "crates"].contains(&names[0]) && Path::new(ROOT).join(&folder).is_dir();
    if has_rows { folder } else { names[0].to_owned() }
}

/// The lines of each row.
fn lines() -> BTreeMap<String, usize> {
    let mut lines = BTreeMap::new();
    let all =
        ["src", "crates", "tests", "shaders-glsl", "scripts", "docs"].into_iter().flat_map(paths);
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

/// The largest file of the repository, in bytes: what is larger is data or was built, and stays in its history for
/// ever.
const MAX_BYTES: u64 = 512 << 10;

#[test]
fn no_file_of_the_repository_is_data_or_was_built() {
    let listed = ["ls-files", "-z", "--cached", "--others", "--exclude-standard"];
    let output = Command::new("git").args(listed).current_dir(ROOT).output();
    let Some(output) = output.ok().filter(|output| output.status.success()) else {
        return crate::common::not_run("git", "this is no checkout, or git is not installed");
    };
    let names = String::from_utf8(output.stdout).unwrap();
    let size = |name: &str| fs::metadata(Path::new(ROOT).join(name)).map_or(0, |it| it.len());
    let large: Vec<&str> =
        names.split_terminator('\0').filter(|name| size(name) > MAX_BYTES).collect();
    assert!(
        large.is_empty(),
        "larger than {MAX_BYTES} bytes: {large:?}; ignore them, or make them smaller"
    );
    let built: Vec<&str> = names
        .split_terminator('\0')
        .filter(|name| name.split('/').any(|it| it == "target"))
        .collect();
    assert!(built.is_empty(), "built, and not ignored: {} files", built.len());
}
