//! House rules that the compiler does not check, asserted on the sources.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::circles;
use crate::common::files_below;

pub(crate) const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The longest file, in lines, that is still easy to read.
const MAX_LINES: usize = 600;

/// The paths of all files below `folder`, relative to the repository.
pub(crate) fn paths(folder: &str) -> Vec<PathBuf> {
    let relative = |path: PathBuf| path.strip_prefix(ROOT).unwrap().to_owned();
    files_below(&Path::new(ROOT).join(folder)).into_iter().map(relative).collect()
}

/// Every file below `folder` with the extension, with its text.
pub(crate) fn files(folder: &str, extension: &str) -> Vec<(PathBuf, String)> {
    let mut paths = paths(folder);
    paths.retain(|path| path.extension().is_some_and(|found| found == extension));
    assert!(!paths.is_empty(), "no {folder}/**/*.{extension}");
    let text = |path: &PathBuf| fs::read_to_string(Path::new(ROOT).join(path)).unwrap();
    paths.into_iter().map(|path| (path.clone(), text(&path))).collect()
}

/// Every Rust file of the library: of the root package, and of the crates that it stands on or that stand on it.
pub(crate) fn library() -> Vec<(PathBuf, String)> {
    let mut crates = files("crates", "rs");
    crates.retain(|(path, _)| path.iter().nth(2).is_some_and(|folder| folder == "src"));
    [files("src", "rs"), crates].concat()
}

fn stem(path: &Path) -> &str {
    path.file_stem().unwrap().to_str().unwrap()
}

/// The module of a file of `src`: `render` for `src/splats/render.rs` and `src/splats/render/buffers.rs`.
fn module(path: &Path) -> &str {
    Path::new(path.iter().nth(1).unwrap()).file_stem().unwrap().to_str().unwrap()
}

/// The modules in the order of the crate's documentation.
fn layers(lib: &str) -> Vec<&str> {
    let entry = |line| {
        let name = str::strip_prefix(line, "//! - ")?.split('`').nth(1)?;
        Some(name)
    };
    lib.lines().filter_map(entry).collect()
}

/// The code of a line, without its comment. Strings may remain; they name no modules.
pub(crate) fn code(line: &str) -> &str {
    line.split("//").next().unwrap()
}

#[test]
fn the_list_of_layers_names_every_module_once() {
    let lib = fs::read_to_string(Path::new(ROOT).join("src/lib.rs")).unwrap();
    let declared: BTreeSet<&str> =
        lib.lines().filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';')).collect();
    let layers = layers(&lib);
    assert_eq!(layers.iter().copied().collect::<BTreeSet<_>>(), declared);
    assert_eq!(layers.len(), declared.len(), "a module is listed twice");
    // Tests and the other crates use them, hosts do not.
    let hidden = lib.lines().filter(|line| *line == "#[doc(hidden)]").count();
    assert_eq!(hidden, declared.len(), "a module is part of the API");
}

#[test]
fn a_folder_of_modules_lists_each_on_its_page() {
    let crates = ["core", "diagnose", "models", "photographs", "pose", "report"]
        .map(|name| format!("crates/{name}/src/lib.rs"));
    for folder in
        crates.into_iter().chain(["splats", "results"].map(|name| format!("src/{name}.rs")))
    {
        let page = fs::read_to_string(Path::new(ROOT).join(&folder)).unwrap();
        let declared =
            page.lines().filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';'));
        let listed: BTreeSet<&str> = layers(&page).into_iter().collect();
        assert_eq!(listed, declared.collect(), "{folder}");
    }
}

#[test]
fn a_module_uses_only_modules_above_it() {
    let lib = fs::read_to_string(Path::new(ROOT).join("src/lib.rs")).unwrap();
    let layers = layers(&lib);
    let layer = |name: &str| layers.iter().position(|layer| *layer == name);
    let mut broken = vec![];
    for (path, text) in files("src", "rs") {
        // `main` is above all modules, and `lib` only lists them.
        let Some(layer_of_file) = layer(module(&path)) else { continue };
        for used in circles::paths(&text).iter().filter(|used| used[0] == "crate") {
            let used =
                used.get(1).filter(|used| layer(used).is_some_and(|used| used > layer_of_file));
            broken.extend(used.map(|used| format!("{} uses {used}", path.display())));
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn every_kernel_has_a_reference_with_its_name() {
    for (path, _) in files("shaders-glsl", "comp") {
        let reference = Path::new("src/reference").join(stem(&path)).with_extension("rs");
        assert!(Path::new(ROOT).join(&reference).exists(), "{} is missing", reference.display());
    }
}

#[test]
fn every_kernel_is_named_in_a_test() {
    let tests = files("tests", "rs");
    for (path, _) in files("shaders-glsl", "comp") {
        let words = |text: &str| -> bool {
            text.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == stem(&path))
        };
        assert!(tests.iter().any(|(_, text)| words(text)), "no test names {}", path.display());
    }
}

/// How often the text dispatches the kernel by hand: names its `Buffers`, or the test macro.
fn wirings(text: &str, kernel: &str) -> usize {
    let code: String = text.lines().map(code).flat_map(|line| [line.trim(), " "]).collect();
    let words = |pattern: String| {
        let begins = |at: usize| !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_');
        code.match_indices(&pattern).filter(|&(at, _)| begins(at)).count()
    };
    let [buffers, run] = [format!("{kernel}::Buffers {{"), format!("run_kernel!( {kernel},")];
    words(buffers) + words(run) + words(format!("run_kernel!({kernel},"))
}

#[test]
fn the_library_dispatches_each_kernel_in_one_place_and_no_command_dispatches_any() {
    let sources = files("src", "rs");
    for (shader, _) in files("shaders-glsl", "comp") {
        let count = |(_, text): &(PathBuf, String)| wirings(text, stem(&shader));
        let wired = sources.iter().filter(|(path, _)| module(path) != "reference");
        let places: usize = wired.map(count).sum();
        assert_eq!(places, 1, "{} is wired in {places} places", stem(&shader));
        let commands = sources.iter().filter(|(path, _)| module(path) == "cli");
        assert_eq!(commands.map(count).sum::<usize>(), 0, "a command wires {}", stem(&shader));
    }
}

#[test]
fn a_test_dispatches_a_kernel_by_hand_only_to_test_that_kernel() {
    // The recorder is tested with kernels of the rasteriser, and each curve with the kernel that maps images.
    const EXEMPT: [&str; 2] = ["tests/gpu/gpu.rs", "tests/photographs/curves.rs"];
    let mut tests = files("tests", "rs");
    tests.retain(|(path, _)| !EXEMPT.iter().any(|exempt| path == Path::new(exempt)));
    for (shader, _) in files("shaders-glsl", "comp") {
        let wiring = tests.iter().filter(|(_, text)| wirings(text, stem(&shader)) > 0);
        let places: Vec<_> = wiring.map(|(path, _)| path.display().to_string()).collect();
        assert!(places.len() <= 1, "{} is wired by hand in {places:?}", stem(&shader));
    }
}

#[test]
fn unsafe_code_is_only_in_the_gpu_layer_and_the_c_interface() {
    for (path, text) in library() {
        if path.starts_with("src/gpu")
            || path == Path::new("src/gpu.rs")
            || path.starts_with("crates/capi")
        {
            continue;
        }
        for (number, line) in text.lines().enumerate() {
            // A browser's policy has a keyword of this name.
            let line = line.replace("'unsafe-inline'", "");
            let is_unsafe = code(&line).split(|c: char| !c.is_alphanumeric() && c != '_');
            let is_unsafe = is_unsafe.filter(|word| *word == "unsafe").count() > 0;
            assert!(!is_unsafe, "{}:{}: {line}", path.display(), number + 1);
        }
    }
}

#[test]
fn tests_start_the_command_and_look_for_captures_in_one_place() {
    // There, validation fails the command, and missing captures are reported.
    for (what, file) in [("CARGO_BIN_", "common/command.rs"), ("../shar", "common/files.rs")] {
        for (path, text) in [files("tests", "rs"), files("crates", "rs")].concat() {
            let allowed = path.ends_with(file) || path.ends_with("architecture.rs");
            assert!(allowed || !text.contains(what), "{}: see tests/{file}", path.display());
        }
    }
}

#[test]
fn examples_use_the_api_alone() {
    // What is no module of the API.
    let api = ["config", "run", "synthetic", "ash", "glam"];
    for (path, text) in files("examples", "rs") {
        // An instrument of ours.
        if path.ends_with("growth.rs") {
            continue;
        }
        assert!(!text.contains("nightsplat_"), "{} uses a crate below", path.display());
        for rest in text.split("nightsplat::").skip(1) {
            let (name, after) =
                rest.split_at(rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap());
            let is_module = name.starts_with(char::is_lowercase) && after.starts_with("::");
            assert!(!is_module || api.contains(&name), "{} uses {name}", path.display());
        }
    }
}

#[test]
fn a_file_can_be_read_in_one_sitting() {
    let all = [
        ("src", "rs"),
        ("crates", "rs"),
        ("tests", "rs"),
        ("shaders-glsl", "comp"),
        ("shaders-glsl", "glsl"),
    ];
    for (path, text) in all.into_iter().flat_map(|(folder, extension)| files(folder, extension)) {
        let lines = text.lines().count();
        assert!(lines <= MAX_LINES, "{} has {lines} lines", path.display());
    }
}

#[test]
fn a_clock_that_jumps_changes_nothing_but_the_dates_of_event_files_and_which_files_are_read_again()
{
    let clocks = ["SystemTime", "UNIX_EPOCH", ".modified()"];
    // A changed time stamp costs only a checksum of the pixels, another look at a model, or a new search for cameras.
    let may_ask = [
        "crates/photographs/src/tree.rs",
        "crates/pose/src/origin.rs",
        "src/results/run/tail.rs",
        "crates/report/src/tensorboard.rs",
    ];
    for (path, text) in library() {
        let asks =
            text.lines().map(code).any(|line| clocks.iter().any(|clock| line.contains(clock)));
        let may = may_ask.iter().any(|allowed| path.ends_with(allowed));
        assert_eq!(asks, may, "{}", path.display());
    }
}
