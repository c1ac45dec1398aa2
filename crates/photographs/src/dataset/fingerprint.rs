//! The identity of a dataset: names, sizes, poses and pixels of the training photographs, as checksums.

use std::collections::BTreeMap;

use nightsplat_core::Result;
use nightsplat_core::camera::CameraModel;
use nightsplat_core::hash::{self, Hasher};
use nightsplat_core::watch::Stage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Dataset, Original, View};

/// The identity of a dataset as it was loaded.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fingerprint {
    /// Checksums of camera and photograph of each view for training, by name.
    views: BTreeMap<String, [String; 2]>,
    /// The points.
    points: String,
}

impl Fingerprint {
    /// Reads every pixel once.
    pub fn compute(dataset: &Dataset) -> Result<Self> {
        let views = dataset.views.par_iter().filter(|view| view.is_for_training());
        let stage = Stage::begin("hashing photographs", dataset.views.len());
        let views = views.map(|view| {
            stage.next()?;
            Ok((view.name.clone(), [camera(view), pixels(view)?].map(hash::text)))
        });
        let mut points = Hasher::default();
        for point in &dataset.points {
            points.write_numbers(&point.position.to_array());
        }
        Ok(Self { views: views.collect::<Result<_>>()?, points: hash::text(points.finish()) })
    }

    /// One checksum of everything.
    pub fn checksum(&self) -> String {
        let mut hasher = Hasher::default();
        for (name, [camera, pixels]) in &self.views {
            [name, camera, pixels].into_iter().for_each(|text| hasher.write(text.as_bytes()));
        }
        hasher.write(self.points.as_bytes());
        hash::text(hasher.finish())
    }

    /// The first difference from another dataset, in words; `None` if they are equal.
    pub fn difference(&self, other: &Self) -> Option<String> {
        let missing =
            |a: &Self, b: &Self| a.views.keys().find(|name| !b.views.contains_key(*name)).cloned();
        if let Some(name) = missing(self, other) {
            return Some(format!("view {name} is gone"));
        }
        if let Some(name) = missing(other, self) {
            return Some(format!("view {name} is new"));
        }
        for ((name, [camera, pixels]), [other_camera, other_pixels]) in
            self.views.iter().zip(other.views.values())
        {
            if camera != other_camera {
                return Some(format!("view {name} has another camera or pose"));
            }
            if pixels != other_pixels {
                return Some(format!("view {name} shows other pixels"));
            }
        }
        (self.points != other.points).then(|| "its points are others".to_owned())
    }
}

fn camera(View { camera, .. }: &View) -> u64 {
    let mut hasher = Hasher::default();
    hasher.write_numbers(&[camera.width.into(), camera.height.into()]);
    hasher.write_numbers(&camera.focal.to_array());
    hasher.write_numbers(&camera.principal_point.to_array());
    hasher.write_numbers(&camera.view_from_world.to_cols_array());
    if let CameraModel::Fisheye(lens) = camera.model {
        hasher.write_numbers(&lens.coefficients);
    }
    hasher.finish()
}

fn pixels(view: &View) -> Result<u64> {
    // The checksum of a photograph that is not kept was computed while it was decoded.
    let not_kept = view.original.as_ref().filter(|_| view.image.is_none());
    let recorded = not_kept.and_then(Original::checksum);
    let image = if recorded.is_some() { None } else { view.loaded()? };
    let mut hasher = recorded.unwrap_or_default();
    for numbers in image.iter().map(|image| &image.data).chain(&view.depth) {
        hasher.write(bytemuck::cast_slice(numbers));
    }
    view.normals.iter().for_each(|map| hasher.write(bytemuck::cast_slice(map.packed())));
    Ok(hasher.finish())
}
