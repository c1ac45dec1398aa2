//! Compiles every kernel in `shaders-glsl/` and writes its Rust side, or takes what a packaged crate has of both.
//!
//! A kernel is declared once, in GLSL. Its parameters, buffers, constants and workgroup size are read from its SPIR-V;
//! `$OUT_DIR/kernels.rs` gets one typed module per kernel, so host code that disagrees with a shader does not compile.
//!
//! - `build/precompiled.rs`: kernels that were compiled before
//! - `build/kernels.rs`: compiles and reflects every kernel
//! - `build/compiler.rs`: GLSL to SPIR-V
//! - `build/glsl.rs`: what GLSL says beside that: constants and comments
//! - `build/reflection.rs`: SPIR-V to a description
//! - `build/rust.rs`: a description to Rust

#[cfg(any(feature = "glslang", feature = "shaderc"))]
#[path = "build/kernels.rs"]
mod kernels;
#[path = "build/precompiled.rs"]
#[allow(
    dead_code,
    reason = "a build compiles the kernels, or takes those that were compiled before"
)]
mod precompiled;

use std::env;
use std::path::PathBuf;

const SHADERS: &str = "shaders-glsl";

fn main() {
    for source in precompiled::SOURCES {
        println!("cargo::rerun-if-changed={source}");
    }
    let out_dir = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    #[cfg(any(feature = "glslang", feature = "shaderc"))]
    {
        kernels::compile(&out_dir);
        precompiled::write_hash(&out_dir);
    }
    #[cfg(not(any(feature = "glslang", feature = "shaderc")))]
    {
        println!("cargo::rerun-if-changed={}", precompiled::FOLDER);
        if let Err(problem) = precompiled::copy(&out_dir) {
            println!("cargo::error={problem}");
        }
    }
}
