//! Results of a training run: its directory and events, scores, reports, and exported models.
//!
//! In: a configuration and a dataset, or a finished run. Out: files.
//!
//! - [`eval`]: scores of the test views
//! - [`run`]: a training run, its events and its directory
//! - [`run_facts`]: the summary of a run before its first step
//! - [`sweep`]: the results of a sweep
//! - [`toned`]: photographs through a tone curve
//! - [`comparison`]: runs on one dataset, view by view
//! - [`diagnosis`]: a diagnosis of photographs as a table and a page
//! - [`evaluation`]: scores as a table, and the page of a run
//! - [`models`]: model files and run directories
//! - [`finished_run`]: a finished run or a model file, opened for rendering
//! - [`view_exposures`]: renders at the exposure of their targets
//! - [`verdict`]: a sentence on a set of photographs, and on a trained model
//! - [`run_export`]: the export of a run
//! - [`edit`]: changes of a model

pub mod comparison;
pub mod diagnosis;
pub mod edit;
pub mod eval;
pub mod evaluation;
pub mod finished_run;
pub mod models;
pub mod run;
pub mod run_export;
pub mod run_facts;
pub mod sweep;
pub mod toned;
pub mod verdict;
pub mod view_exposures;
