//! Every kernel of `shaders-glsl/`, reflected by `build.rs`: `Params`, `Constants`, `Buffers`, `Slices`; and the
//! constants of every include, a module each. Floats have the digits of the source: a shader rounds them to `f32`.

#![allow(
    clippy::doc_markdown,
    clippy::approx_constant,
    clippy::excessive_precision,
    clippy::unnecessary_cast,
    rustdoc::broken_intra_doc_links,
    reason = "documentation and numbers are the shaders'"
)]
#![allow(dead_code, reason = "a build may need fewer kernels, and fewer of their constants")]
#![allow(clippy::derivable_impls, reason = "`Default` is written alike with and without constants")]

use std::mem::offset_of;

use bytemuck::{Pod, Zeroable};

use crate::gpu;

include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
