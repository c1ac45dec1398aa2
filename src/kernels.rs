//! Every kernel of `shaders-glsl/`, as `build.rs` reflected it: `Params`, `Constants`, `Buffers`, `Slices`.

use std::mem::offset_of;

use bytemuck::{Pod, Zeroable};

use crate::gpu;

include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
