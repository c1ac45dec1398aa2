//! Views as listed, before any pixel is read.

use std::path::PathBuf;

use glam::DAffine3;
use nightsplat_core::camera::Lens;

use super::Split;
use super::ply::Cloud;
use crate::image::MaskFile;

/// One view as a listing describes it, before any pixel is read.
#[derive(Clone, Debug)]
pub(super) struct ViewEntry {
    pub(super) name: String,
    /// Path as listed, relative to the root; if the photograph was found elsewhere, that path.
    pub(super) listed: String,
    /// Path relative to the common folder of all photographs.
    pub(super) below: String,
    /// `None`: the split rule decides.
    pub(super) split: Option<Split>,
    /// The listed file, if it exists.
    pub(super) file: Option<PathBuf>,
    pub(super) lens: Lens,
    /// A rigid transform from the listing's world.
    pub(super) view_from_world: DAffine3,
    /// The mask that the listing names.
    pub(super) mask: Option<MaskFile>,
    /// The depth map that the listing names.
    pub(super) depth: Option<PathBuf>,
}

#[derive(Debug, Default)]
pub(super) struct Listing {
    pub(super) frames: Vec<ViewEntry>,
    pub(super) skipped: Vec<String>,
    /// Choices that were made, and unused files; one line each.
    pub(super) remarks: Vec<String>,
    /// Points that the listing names.
    pub(super) clouds: Vec<Cloud>,
    /// Whether the listing itself splits the views.
    pub(super) has_split: bool,
}
