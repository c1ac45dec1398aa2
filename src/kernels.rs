//! Every kernel of `shaders-glsl/`, as `build.rs` reflected it: `Params`, `Constants`, `Buffers`, `Slices`.

#![allow(
    clippy::doc_markdown,
    rustdoc::broken_intra_doc_links,
    reason = "a kernel's documentation is the comment of its shader"
)]
#![allow(clippy::derivable_impls, reason = "`Default` is written alike with and without constants")]

use std::mem::offset_of;

use bytemuck::{Pod, Zeroable};

use crate::gpu;

include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
