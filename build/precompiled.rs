//! Kernels that were compiled before: a packaged crate has them in `precompiled/`, where `scripts/package-crate.sh`
//! wrote them. A host that builds such a crate compiles no C++.

use std::fs;
use std::path::{Path, PathBuf};

pub(crate) const FOLDER: &str = "precompiled";

/// What the compiled kernels depend on: the shaders, and what compiles them.
pub(crate) const SOURCES: [&str; 4] = [crate::SHADERS, "build.rs", "build", "Cargo.lock"];

/// The packages in `Cargo.lock` whose version decides what is compiled.
const COMPILERS: [&str; 3] = ["glslang", "glslang-sys", "spirq"];

/// The file with the hash of the sources, beside what was compiled from them.
const HASH: &str = "sources.hash";

/// Writes the hash of the sources, after what was compiled from them.
pub(crate) fn write_hash(out_dir: &Path) {
    fs::write(out_dir.join(HASH), hash_of_sources()).expect("OUT_DIR is ours");
}

/// Copies `kernels.rs` and the SPIR-V to `out_dir`.
///
/// # Errors
/// The kernels were not compiled before, or the sources have changed since.
pub(crate) fn copy(out_dir: &Path) -> Result<(), String> {
    const REMEDY: &str =
        "build with --features glslang, which needs a C++ compiler, or from a packaged crate";
    let folder = Path::new(FOLDER);
    let Ok(hash) = fs::read_to_string(folder.join(HASH)) else {
        return Err(format!("the kernels are not compiled: there is no {FOLDER}/{HASH}; {REMEDY}"));
    };
    if hash != hash_of_sources() {
        let sources = SOURCES.join(", ");
        return Err(format!("the kernels in {FOLDER}/ are not those of {sources}; {REMEDY}"));
    }
    for path in files(folder) {
        let name = path.file_name().expect("a file has a name");
        fs::copy(&path, out_dir.join(name))
            .map_err(|error| format!("{} cannot be copied: {error}", path.display()))?;
    }
    Ok(())
}

fn hash_of_sources() -> String {
    // FNV-1a, which tells accidental changes.
    let mut hash = 0xCBF2_9CE4_8422_2325_u64;
    let mut write = |bytes: &[u8]| {
        for byte in bytes {
            hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01B3);
        }
    };
    for source in SOURCES {
        for path in files(Path::new(source)) {
            // Windows writes paths and lines otherwise.
            let name = path.to_string_lossy().replace('\\', "/");
            let bytes = fs::read(&path).unwrap_or_default();
            let text = String::from_utf8_lossy(&bytes).replace("\r\n", "\n");
            let text = if source == "Cargo.lock" { compilers(&text) } else { text };
            write(name.as_bytes());
            write(text.as_bytes());
        }
    }
    format!("{hash:016x}")
}

/// The names and versions of the packages that compile.
fn compilers(lock: &str) -> String {
    let is_compiler = |package: &&str| {
        COMPILERS.iter().any(|name| package.starts_with(&format!("\nname = \"{name}\"\n")))
    };
    let packages = lock.split("[[package]]").filter(is_compiler);
    packages.flat_map(|package| package.lines().skip(1).take(2)).collect()
}

/// The files below a folder, in a stable order; of a file, itself.
fn files(path: &Path) -> Vec<PathBuf> {
    let Ok(folder) = fs::read_dir(path) else { return vec![path.to_owned()] };
    let mut paths: Vec<_> =
        folder.map(|entry| entry.expect("a folder can be listed").path()).collect();
    paths.sort();
    paths.iter().flat_map(|path| files(path)).collect()
}
