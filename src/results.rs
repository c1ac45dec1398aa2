//! What a training run leaves: its directory and events, scores, reports, and models in the formats of others.
//!
//! In: a configuration and a dataset, or a finished run. Out: files.
//!
//! - [`eval`]: scores of the test views
//! - [`run`]: a training run, its events and its directory
//! - [`report`]: tables and plots in one self-contained page
//! - [`export`]: a model in the formats of others

pub mod eval;
pub mod export;
pub mod report;
pub mod run;
