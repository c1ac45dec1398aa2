//! The points of a dataset's COLMAP model, in the world of its views.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

use glam::DVec3;

use super::similarity::Similarity;
use super::{Point, View, colmap, names};
use crate::Result;

/// The largest camera-centre error, relative to the cameras' extent, at which two worlds count as the same.
const MAX_WORLD_RESIDUAL: f64 = 0.01;

/// The points of the dataset's COLMAP model, brought into the views' world.
pub(super) fn points(root: &Path, views: &[View]) -> Result<Vec<Point>> {
    let by_name: BTreeMap<&str, u32> =
        views.iter().zip(0..).map(|(view, index)| (view.name.as_str(), index)).collect();
    let view_named = |image: &str| {
        let names = names::possible(&image.replace('\\', "/"));
        names.iter().find_map(|name| by_name.get(name.as_str()).copied())
    };
    let models = colmap::find(root, &["images", "points3D"]);
    let Some((folder, _)) = colmap::largest(&models, |name| view_named(name).is_some())? else {
        return Ok(Vec::new());
    };
    let images = colmap::read_images(folder)?;
    let points = colmap::read_points(folder)?;
    let shared = images.iter().filter_map(|image| {
        let view = view_named(&image.name)?;
        Some((image.id, view, image.view_from_world?.inverse().translation))
    });
    let shared: Vec<(u32, u32, DVec3)> = shared.collect();
    let pairs: Vec<_> = shared
        .iter()
        .map(|(_, view, center)| (*center, views[*view as usize].camera.center()))
        .collect();
    let Some(to_views) = same_world(folder, &pairs) else {
        return Ok(Vec::new());
    };
    let view_of: HashMap<u32, u32> =
        shared.iter().map(|(image, view, _)| (*image, *view)).collect();
    let point = |point: colmap::ModelPoint| {
        let seen_by: BTreeSet<u32> =
            point.images.iter().filter_map(|image| view_of.get(image).copied()).collect();
        Point { position: to_views(point.position), views: seen_by.into_iter().collect() }
    };
    Ok(points.into_iter().map(point).collect())
}

/// The map from the model's world to the views'; a warning and `None` where the two do not belong together.
fn same_world(folder: &Path, pairs: &[(DVec3, DVec3)]) -> Option<Box<dyn Fn(DVec3) -> DVec3>> {
    if !pairs.is_empty() && pairs.iter().all(|(model, view)| model == view) {
        return Some(Box::new(|point| point));
    }
    let folder = folder.display();
    let Some(similarity) = Similarity::solve(pairs) else {
        tracing::warn!(
            "{folder}: {} shared cameras do not tell its place; its points are left out",
            pairs.len()
        );
        return None;
    };
    let residual = similarity.residual;
    if residual > MAX_WORLD_RESIDUAL {
        tracing::warn!(
            "{folder}: its cameras are off by {residual:.3} of their extent; its points are left out"
        );
        return None;
    }
    tracing::info!(
        "{folder}: brought into the views' world, residual {residual:.1e} of the cameras' extent"
    );
    Some(Box::new(move |point| similarity.apply(point)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_that_is_off_by_more_than_a_hundredth_gives_no_points() {
        let center = |i: i32| DVec3::new(f64::from(i % 3), f64::from(i / 3), f64::from(i * i % 5));
        let bent: Vec<_> =
            (0..9).map(|i| (center(i), center(i) + DVec3::X * 0.3 * f64::from(i % 2))).collect();
        assert!(same_world(Path::new("sparse/0"), &bent).is_none());
    }
}
