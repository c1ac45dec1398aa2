//! Trains and renders 3D Gaussian Splatting models of dark photographs, with explicit Vulkan compute.
//!
//! | to | begin with |
//! |---|---|
//! | open a device, or lend one | [`Gpu::new`], [`Gpu::from_host`], [`devices`] |
//! | read and write models | [`Gaussians::open`], [`Gaussians::save`] |
//! | draw | [`Renderer`], [`Camera`] |
//! | read photographs | [`Dataset::load`], [`Preset::load_options`] |
//! | train | [`Trainer::planned`], [`TrainConfig`] |
//! | train into a directory with log, checkpoints and scores | [`run::train`] |
//! | learn what went wrong | [`Error`]: one line that names the object and the remedy |
//!
//! Without default features there is the renderer, forward and backward, and nothing else. Feature `io` adds files, datasets
//! and training; `check` the CPU references; `fit` the fitting of curves; `cli` the command.
//!
//! # Render a model
//!
//! ```no_run
//! use nightsplat::glam::{DAffine3, DVec3};
//! use nightsplat::{Camera, DeviceChoice, Gaussians, Gpu, RenderOptions, RenderSettings, Renderer};
//!
//! let gpu = Gpu::new(&DeviceChoice::Best)?;
//! let gaussians = Gaussians::open("model.ply")?;
//! let on_device = gaussians.upload(&gpu)?;
//!
//! let settings = RenderSettings { shape: gaussians.shape, ..RenderSettings::default() };
//! let mut renderer = Renderer::new(&gpu, settings)?;
//! let options = RenderOptions { sh_degree: gaussians.shape.sh_degree, background: [0.0; 3] };
//! for frame in 0..60 {
//!     let view_from_world = DAffine3::from_translation(DVec3::new(0.0, 0.0, 3.0))
//!         * DAffine3::from_rotation_y(f64::from(frame) * 0.1);
//!     let camera = Camera::perspective(view_from_world, 60_f64.to_radians(), [1280, 720]);
//!     renderer.reserve(gaussians.count, [&camera])?;
//!     let image = renderer.render_image(&on_device, &camera, &options)?;
//!     image.save_png8(format!("{frame:02}.png"))?;
//! }
//! # Ok::<(), nightsplat::Error>(())
//! ```
//!
<<<<<<< ours
//! A host with its own Vulkan device lends it ([`Gpu::from_host`]), records [`Renderer::forward`] into its own command buffers
//! ([`Gpu::record_into`]) and binds the buffers with the result; `examples/embed.rs` is such a host.
=======
//! A host with a Vulkan device of its own lends it ([`Gpu::from_host`]), records [`Renderer::forward`] into its own
//! command buffers ([`Gpu::record_into`]) and binds the resulting buffers; `examples/embed.rs` is such a host. Without
//! default features this is the whole API; feature `io` adds files, datasets and training.
>>>>>>> theirs
//!
//! # Train as the command does
//!
//! ```no_run
//! use nightsplat::{Dataset, DeviceChoice, Gpu, Preset, Trainer};
//!
//! let gpu = Gpu::new(&DeviceChoice::Best)?;
//! let preset = Preset::Balanced;
//! let dataset = Dataset::load("photos", &preset.load_options()?)?;
//!
//! let mut trainer = Trainer::planned(&gpu, &dataset, preset)?;
//! while !trainer.has_ended() {
//!     for report in trainer.advance(trainer.last_step())? {
//!         println!("step {}: loss {:.4}", report.step, report.loss);
//!     }
//!     let shown = trainer.render(&dataset.views[0].camera)?;
//!     shown.output().save_png8("now.png")?;
//! }
//! println!("{}", trainer.end()?);
//! trainer.gaussians()?.save("model.spz")?;
//! # Ok::<(), nightsplat::Error>(())
//! ```
//!
<<<<<<< ours
//! [`Trainer::new`] trains a [`TrainConfig`] of your own, and [`run::train`] trains one into a run directory, as
//! `examples/train.rs` does.
=======
//! The configuration of a training is a [`TrainConfig`]: [`Trainer::new`] takes one, and [`run::train`] trains one into
//! a run directory with log, checkpoints and scores, as `examples/train.rs` does.
>>>>>>> theirs
//!
//! # The modules
//!
//! ```text
//! photographs on disk -> dataset -> pseudo-GT (tone curve) ┐
//!                                                          ├-> loss -> backward -> optimizer -> densify -> next step
//! points -> scene (Gaussians) -> project -> bin -> sort -> blend ┘
//!                                                          └-> run, eval, render
//! ```
//!
<<<<<<< ours
//! For contributors. The names on this page are the API, listed in `docs/public-api.txt`; the folders are private. Data
//! flows one way: a folder uses only folders above it in this list, which `tests/house/architecture.rs` reads and asserts.
//! The page of each folder says what flows in and out, and lists its modules (`cargo doc --features testing`).
//!
//! - `error`: errors, sorted by their remedy
=======
//! The names on this page are the API; `docs/public-api.txt` lists them with their methods and fields. The folders are
//! no part of it. Data flows one way: a folder uses only folders above it in this list, as
//! `tests/house/architecture.rs` asserts. The first page of each folder describes its input and output, and lists its
//! modules (`cargo doc --features testing`).
//!
//! - `error`: errors, sorted by what the user can do about them
>>>>>>> theirs
//! - `base`: files read and written whole, hashes, random numbers
//! - `gpu`: device, buffers, passes; the only module that speaks Vulkan, and the only one with `unsafe`
//! - `kernels`: the typed Rust side of every shader, generated by `build.rs`
//! - `camera`: cameras and lens distortion
//! - `photographs`: images, datasets, tone curves, pseudo-GT
//! - `splats`: Gaussians, the differentiable rasteriser, Adam, density control
//! - `reference`: the CPU reference of each kernel, in plain loops
//! - `networks`: denoiser, tonemapper and LPIPS
//! - `loss`: the loss terms with their gradients, exposures of views, and the log
<<<<<<< ours
//! - `train`: the plan, and the training loop
=======
//! - `train`: the plan of a capture, and training steps
>>>>>>> theirs
//! - `results`: runs and their directories, scores, reports, exports
//! - `cli`: one file per subcommand (feature `cli`)

#![cfg_attr(
    not(feature = "testing"),
    allow(unreachable_pub, unused_imports, reason = "what is no API is public to tests")
)]
#![cfg_attr(
    not(any(feature = "testing", all(feature = "cli", feature = "fit"))),
    expect(dead_code, reason = "the command, and training, use more")
)]

// Tests reach into every folder;
#[cfg(feature = "testing")]
pub mod base;
#[cfg(feature = "testing")]
pub mod camera;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
#[cfg(feature = "testing")]
pub mod error;
#[cfg(feature = "testing")]
#[expect(unsafe_code, reason = "the only module that speaks Vulkan")]
pub mod gpu;
#[cfg(feature = "testing")]
pub mod kernels;
#[cfg(feature = "testing")]
pub mod loss;
#[cfg(feature = "testing")]
pub mod networks;
#[cfg(feature = "testing")]
pub mod photographs;
#[cfg(feature = "testing")]
pub mod reference;
#[cfg(feature = "testing")]
pub mod results;
#[cfg(feature = "testing")]
pub mod splats;
#[cfg(feature = "testing")]
pub mod train;

// everyone else sees the names below.
#[cfg(not(feature = "testing"))]
mod base;
#[cfg(not(feature = "testing"))]
mod camera;
#[cfg(not(feature = "testing"))]
mod error;
#[cfg(not(feature = "testing"))]
#[expect(unsafe_code, reason = "the only module that speaks Vulkan")]
mod gpu;
#[cfg(not(feature = "testing"))]
mod kernels;
#[cfg(all(not(feature = "testing"), feature = "io"))]
mod loss;
#[cfg(all(not(feature = "testing"), feature = "io"))]
mod networks;
#[cfg(not(feature = "testing"))]
mod photographs;
#[cfg(all(not(feature = "testing"), feature = "check"))]
mod reference;
#[cfg(all(not(feature = "testing"), feature = "io"))]
mod results;
#[cfg(not(feature = "testing"))]
mod splats;
#[cfg(all(not(feature = "testing"), feature = "io"))]
mod train;

// Types of these crates are part of what follows.
pub use {ash, glam};

pub use error::{Error, Result, Stop};

// The device.
pub use gpu::{
    Buffer, CooperativeMatrix, DeviceChoice, DeviceLimits, DeviceReport, Gpu, HostDevice,
    HostRecording, MemoryBudget, PassTime, PciAddress, Properties, Recorder, Requirement,
    RequirementReport, Slice, Tile, devices, required_device_features,
};
#[cfg(feature = "check")]
pub use gpu::{CheckReport, CheckedPass, Difference, Tolerance};

// Cameras, Gaussians, and the renderer.
pub use camera::{Camera, CameraModel, CameraPath, KannalaBrandt};
pub use photographs::image::Image;
pub use splats::packed_sh::StorageFormat;
pub use splats::render::{
    Damping, Gradients, RenderOptions, RenderSettings, Renderer, Status, Viewpoint,
};
pub use splats::scene::{DeviceGaussians, Features, GaussianSlice, Gaussians, Layout, Shape};

// Photographs and training.
#[cfg(feature = "io")]
pub use {
    loss::Term,
    photographs::dataset::{Dataset, DepthOptions, LoadOptions, Original, Point, Split, View},
    photographs::image::Mask,
    photographs::metrics::Scores,
    photographs::tone::{Profile, Table, ToneCurve, ToneSettings},
    results::export::{Format, spz::Version as SpzVersion},
    splats::scene::init::Initialization,
    train::{Ended, MemoryEstimate, Part, Preset, Rendered, StepReport, TrainConfig, Trainer},
};

/// The sections of a [`TrainConfig`].
#[cfg(feature = "io")]
pub mod config {
    pub use crate::camera::TrainingFrame;
    pub use crate::loss::exposure::ExposureRates;
    pub use crate::loss::{ParameterWeights, Weights};
    pub use crate::networks::{DenoiserSettings, NetworkVariant, Precision};
    pub use crate::photographs::dataset::MeasuredSize;
    pub use crate::photographs::tone::{GainChoice, TableInput, White};
    pub use crate::splats::densify::DensityControl;
    pub use crate::splats::optimizer::{LearningRates, Schedule};
    pub use crate::train::{
        Background, CacheSize, CheckConfig, DensityConfig, EndReason, ExposureConfig, ModelConfig,
        NetworkRates, NotFinite, OnOff, PhotographBits, PrecisionConfig, StopConfig,
    };
}

/// A small synthetic dark dataset.
#[cfg(feature = "io")]
pub mod synthetic {
    pub use crate::photographs::dataset::synthetic::{
        Capture, SyntheticOptions, write, write_captured,
    };
}

/// Training into a run directory with a log, checkpoints and scores, and reading such a directory.
#[cfg(feature = "io")]
pub mod run {
    pub use crate::results::eval::{
        ModelRenderer, ReferenceKind, RenderLayer, ResidualTransmittance, ViewScore, means,
    };
    pub use crate::results::run::{
        Event, IfExists, ResourceUsage, RunSummary, load_config, load_model, load_networks, train,
    };
    pub use crate::train::Networks;
}
