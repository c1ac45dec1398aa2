//! What most tests use.

pub(crate) use crate::common::sets::{captured, relit, repaint, small_set, written};
pub(crate) use crate::common::setup::Setup;
pub(crate) use crate::common::train::{advance, set_small_parts};
pub(crate) use crate::common::workspace::Workspace;
pub(crate) use crate::common::{
    Folder, Random, agreeing, agreeing_step, assert_close, pinhole, says, shared,
};
pub(crate) use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3, UVec2, Vec2, Vec3};
pub(crate) use nightsplat::gpu::testing::{gpu, gpu_with};
pub(crate) use nightsplat::gpu::{Gpu, Threads};
pub(crate) use nightsplat::networks::{DenoiserSettings, NetworkVariant};
pub(crate) use nightsplat::reference::gaussian::Gaussian;
pub(crate) use nightsplat::splats::device::{Layout, Upload};
pub(crate) use nightsplat::splats::optimizer::Moments;
pub(crate) use nightsplat::splats::packed_sh::StorageFormat;
pub(crate) use nightsplat::splats::render::{RenderOptions, RenderSettings, Renderer};
pub(crate) use nightsplat::targets::pseudo_gt::PseudoGt;
pub(crate) use nightsplat::train::{TrainConfig, Trainer};
pub(crate) use nightsplat_core::camera::{Camera, CameraModel};
pub(crate) use nightsplat_core::random::Stream;
pub(crate) use nightsplat_models::gaussians::{Features, Gaussians, Shape, ply};
pub(crate) use nightsplat_photographs::dataset::{Dataset, Split};
pub(crate) use nightsplat_photographs::image::{Image, ImageFile, linear_from_srgb};
pub(crate) use nightsplat_photographs::metrics::Scores;
pub(crate) use nightsplat_photographs::tone::{Statistics, ToneCurve, ToneSettings};
pub(crate) use nightsplat_synth::{Capture, SyntheticOptions};
pub(crate) use serde_json::Value;
pub(crate) use std::collections::{BTreeMap, BTreeSet};
pub(crate) use std::fs;
pub(crate) use std::path::{Path, PathBuf};
pub(crate) use std::process::{Command, Stdio};
pub(crate) use std::sync::OnceLock;
pub(crate) use std::time::{Duration, Instant};
