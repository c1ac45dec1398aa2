//! Training: each step renders one view and compares it with its pseudo-GT.

mod batching;
mod cache;
mod call;
mod checkpoint;
mod clock;
mod config;
mod context;
mod decisions;
mod depth_seeding;
mod difference;
mod early_stopping;
mod encoding;
mod epochs;
mod exposures;
mod first_gaussians;
mod gaussians;
mod growth;
mod kept;
mod lamp;
mod layers;
mod masks;
mod memory;
mod model;
mod networks;
mod parts;
mod passes;
mod patches;
mod paths;
pub mod plan;
mod planned;
mod precision;
mod preset;
mod reference;
mod rendered;
mod scoring;
pub mod settings;
mod start;
mod stated;
mod streams;
mod submission;
mod supervision;
mod target_views;
mod terms;
mod trainer;
mod views;

pub use cache::CacheSize;
pub use checkpoint::check_checkpoint;
pub use config::{
    AntialiasingConfig, Background, CheckConfig, DensityConfig, ExposureConfig, Freeze, LampConfig,
    LampRates, NotFinite, StopConfig, TrainConfig,
};
pub use early_stopping::{EndReason, Ended};
pub(crate) use exposures::known_stops;
pub use layers::{Origin, Settings, SettingsLayer, values};
pub use memory::MemoryEstimate;
pub use networks::Networks;
pub use parts::{ModelConfig, ModelName, NetworkRates, Part};
pub use planned::{PlanSource, PlannedRun, RequestedSettings, diagnosed};
pub use precision::{PhotographBits, PrecisionConfig};
pub use preset::Preset;
pub use reference::reference;
pub use rendered::Rendered;
pub use trainer::{StepReport, Trainer};
