//! The points of a dataset, in the world of its views.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use nightsplat_core::Result;

use super::layout::{CAMERAS, DatasetLayout};
use super::ply::Cloud;
use super::similarity::Similarity;
use super::source::ViewFiles;
use super::{Point, View, colmap, names, ply};
use crate::image::files::is_hidden;
use crate::tree;

/// The maximum error of camera centres, relative to the cameras' extent, at which two worlds are the same.
const MAX_WORLD_RESIDUAL: f64 = 0.01;

/// The points of the dataset, in the views' world: those of its COLMAP model, which know the photographs that see them;
/// where it has none, those of a PLY file that the listing names or that lies beside it.
pub(super) fn points(
    layout: &DatasetLayout,
    views: &[View],
    listed: &[Cloud],
) -> Result<Vec<Point>> {
    let places: Vec<Place<'_>> = views.iter().map(Place::of_view).collect();
    let of_model = of_model(layout, &places)?;
    if !of_model.is_empty() {
        return Ok(of_model);
    }
    for cloud in listed.iter().cloned().chain(beside(&layout.root)) {
        if let Some(points) = read(&cloud.file) {
            return Ok(placed(&cloud, points, views));
        }
    }
    let models = layout.models(&CAMERAS);
    for folder in &models {
        let Some(points) = beside(folder).find_map(|cloud| read(&cloud.file)) else { continue };
        if let Some(to_views) = SharedImages::read(folder, &places)?.to_views(folder) {
            let point = |position| Point { position: to_views(position), views: vec![] };
            return Ok(points.into_iter().map(point).collect());
        }
    }
    warn_of_unread(layout, &models);
    Ok(vec![])
}

/// Files of points beside a listing or in a model, by the names that tools give them.
fn beside(folder: &Path) -> impl Iterator<Item = Cloud> + use<> {
    const NAMES: [&str; 5] =
        ["points3D.ply", "points3d.ply", "sparse_pc.ply", "point_cloud.ply", "pointcloud.ply"];
    let files = NAMES.map(|name| folder.join(name)).into_iter();
    files.filter(|file| tree::is_file(file)).map(|file| Cloud { file, applied: None })
}

/// Names the files of points that are not read where the dataset has none.
fn warn_of_unread(layout: &DatasetLayout, models: &[PathBuf]) {
    const ENDINGS: [&str; 6] = ["ply", "pcd", "las", "laz", "e57", "pts"];
    let folders = [&layout.root].into_iter().chain(models);
    let mut files: Vec<PathBuf> =
        folders.flat_map(|folder| tree::entries(folder).unwrap_or_default()).collect();
    files.retain(|file| {
        let ending = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        ENDINGS.contains(&ending.as_str()) && !is_hidden(file)
    });
    files.sort();
    if let Some(first) = files.first() {
        tracing::warn!(
            "{}: is not read; points come from a COLMAP model, from `ply_file_path` of a transforms.json or from \
             points3D.ply",
            first.display()
        );
    }
}

/// The points of a file; `None` and a warning where there are none.
fn read(file: &Path) -> Option<Vec<DVec3>> {
    match ply::points(file) {
        Ok(points) if points.is_empty() => tracing::warn!("{}: holds no points", file.display()),
        Ok(points) => {
            tracing::info!("{}: {} points", file.display(), points.len());
            return Some(points);
        }
        Err(problem) => tracing::warn!("{problem}"),
    }
    None
}

/// The points in a listing's world. If the listing applied a transform to its cameras, it may not have applied it to
/// the points: of the two worlds, the one whose points are visible in more photographs is used.
fn placed(cloud: &Cloud, points: Vec<DVec3>, views: &[View]) -> Vec<Point> {
    /// In the wrong world, about as many points are visible by chance; this factor is not chance.
    const CLEARLY_MORE: f64 = 1.1;
    let seen = |to_views: DAffine3| {
        let step = points.len().div_ceil(1000);
        let some: Vec<DVec3> =
            points.iter().step_by(step).map(|point| to_views.transform_point3(*point)).collect();
        let by_view =
            |view: &View| some.iter().filter(|point| view.camera.sees(**point).is_some()).count();
        views.iter().map(by_view).sum::<usize>() as f64
    };
    let as_stored = seen(DAffine3::IDENTITY);
    let applied = cloud.applied.filter(|applied| seen(*applied) > CLEARLY_MORE * as_stored);
    if applied.is_some() {
        tracing::info!(
            "{}: brought into the views' world by applied_transform",
            cloud.file.display()
        );
    }
    let to_views = applied.unwrap_or(DAffine3::IDENTITY);
    let point = |position| Point { position: to_views.transform_point3(position), views: vec![] };
    points.into_iter().map(point).collect()
}

/// The points of the dataset's COLMAP model, with indices into `sources`.
pub(super) fn of_sources(layout: &DatasetLayout, sources: &[ViewFiles]) -> Result<Vec<Point>> {
    of_model(layout, &sources.iter().map(Place::of_source).collect::<Vec<_>>())
}

/// A view's name, and where its camera stands.
struct Place<'a> {
    name: &'a str,
    center: DVec3,
}

impl Place<'_> {
    fn of_view(view: &View) -> Place<'_> {
        Place { name: &view.name, center: view.camera.center() }
    }

    fn of_source(source: &ViewFiles) -> Place<'_> {
        Place { name: &source.name, center: source.view_from_world.inverse().translation }
    }
}

/// The photographs that a model and the views share.
struct SharedImages {
    /// Image id, view, and the camera's position in either world.
    images: Vec<(u32, u32, [DVec3; 2])>,
}

impl SharedImages {
    fn read(folder: &Path, views: &[Place<'_>]) -> Result<Self> {
        let view_named = view_named(views);
        let images = colmap::read_images(folder)?;
        let shared = images.iter().filter_map(|image| {
            let view = view_named(&image.name)?;
            let center = image.view_from_world?.inverse().translation;
            Some((image.id, view, [center, views[view as usize].center]))
        });
        Ok(Self { images: shared.collect() })
    }

    fn to_views(&self, folder: &Path) -> Option<Box<dyn Fn(DVec3) -> DVec3>> {
        let pairs: Vec<_> = self.images.iter().map(|(.., [model, view])| (*model, *view)).collect();
        same_world(folder, &pairs)
    }
}

/// The view of a photograph that a model names.
fn view_named(views: &[Place<'_>]) -> impl Fn(&str) -> Option<u32> {
    let by_name: BTreeMap<&str, u32> =
        views.iter().zip(0..).map(|(view, index)| (view.name, index)).collect();
    move |image| {
        let names = names::possible(&image.replace('\\', "/"));
        names.iter().find_map(|name| by_name.get(name.as_str()).copied())
    }
}

/// The points of the dataset's COLMAP model.
fn of_model(layout: &DatasetLayout, views: &[Place<'_>]) -> Result<Vec<Point>> {
    let models = layout.models(&["images", "points3D"]);
    let view_named = view_named(views);
    let Some((folder, _)) = colmap::largest(&models, |name| view_named(name).is_some())? else {
        return Ok(Vec::new());
    };
    let points = colmap::read_points(folder)?;
    let shared = SharedImages::read(folder, views)?;
    let Some(to_views) = shared.to_views(folder) else {
        return Ok(Vec::new());
    };
    let view_of: HashMap<u32, u32> =
        shared.images.iter().map(|(image, view, _)| (*image, *view)).collect();
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
