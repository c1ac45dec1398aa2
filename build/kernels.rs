//! Compiles and reflects every kernel.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use glsl::Text;
use reflection::{Kernel, Structs};

mod compiler;
mod glsl;
mod reflection;
mod rust;

/// Writes `kernels.rs`, and the SPIR-V of each kernel, to `out_dir`.
pub(crate) fn compile(out_dir: &Path) {
    let mut structs = Structs::default();
    let mut text = Text::default();
    let (mut kernels, mut all) = (String::new(), String::new());
    let mut names = BTreeSet::new();
    for path in kernel_paths(Path::new(crate::SHADERS)) {
        let source = fs::read_to_string(&path).expect("a listed file can be read");
        let compiled = compiler::compile(&path, &restricted(&source));
        let kernel = Kernel::reflect(&path, &source, &compiled.reflected, &mut structs);
        assert!(names.insert(kernel.name.clone()), "two kernels are called {}", kernel.name);
        let shipped = without_names(&compiled.shipped);
        let bytes: Vec<u8> = shipped.iter().flat_map(|word| word.to_le_bytes()).collect();
        fs::write(out_dir.join(&kernel.name).with_extension("spv"), bytes)
            .expect("OUT_DIR is ours");
        let says = Text::read_with_includes(&source);
        kernel.write(&says, &mut kernels);
        all += &kernel.entry();
        text.add_comments(says);
    }
    let names: Vec<&String> = names.iter().collect();
    let names = format!("/// Every kernel, by name.\npub const NAMES: &[&str] = &{names:?};\n");
    let all = format!(
        "/// The ids of a kernel's constants and the bits of their defaults.
pub type Defaults = fn() -> Vec<(u32, u32)>;
/// Every kernel.
pub const ALL: &[(&gpu::Interface, Defaults)] = &[\n{all}];\n"
    );
    let kernels = structs.write(&text) + &glsl::include_modules() + &names + &all + &kernels;
    fs::write(out_dir.join("kernels.rs"), kernels).expect("OUT_DIR is ours");
}

/// The module without the names of its variables and types, a sixth of it, which no driver reads.
fn without_names(module: &[u32]) -> Vec<u32> {
    /// From `OpSourceContinued` to `OpLine` in the specification: what is there for debuggers.
    const DEBUG: std::ops::RangeInclusive<u32> = 2..=8;
    let (header, mut rest) = module.split_at(5);
    let mut kept = header.to_vec();
    while let [first, ..] = rest {
        let (instruction, after) = rest.split_at((first >> 16) as usize);
        if !DEBUG.contains(&(first & 0xffff)) {
            kept.extend(instruction);
        }
        rest = after;
    }
    kept
}

/// The source with `restrict` on every buffer, so that drivers may move loads across stores. It holds: a pass binds
/// `Slice`s and `SliceMut`s, which borrow their buffer as `&` and `&mut` do, and the parts of one `SliceMut` are
/// checked to be disjoint.
fn restricted(source: &str) -> String {
    let line = |line: &str| match line.starts_with("layout(binding") {
        true => line.replacen(" buffer ", " restrict buffer ", 1) + "\n",
        false => line.to_owned() + "\n",
    };
    source.lines().map(line).collect()
}

/// Every `.comp` below `dir`, in a stable order.
fn kernel_paths(dir: &Path) -> Vec<PathBuf> {
    let mut paths = vec![];
    for entry in fs::read_dir(dir).expect("the shader folder exists") {
        let path = entry.expect("a folder can be listed").path();
        if path.is_dir() {
            paths.extend(kernel_paths(&path));
        } else if path.extension().is_some_and(|extension| extension == "comp") {
            paths.push(path);
        }
    }
    paths.sort();
    paths
}
