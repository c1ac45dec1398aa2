//! Changes of a model, with what they measure left to the caller.

pub mod content;
pub mod floaters;
pub mod operation;
pub mod placement;
pub mod step;
