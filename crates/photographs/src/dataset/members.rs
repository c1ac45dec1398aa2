//! Changes to the set of views: some are left out by name, some held out from training.

use std::collections::HashSet;

use nightsplat_core::camera::Camera;

use super::{Dataset, Split, View};

impl Dataset {
    /// The training views.
    pub fn train_views(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|view| view.split == Split::Train)
    }

    /// The held-out views.
    pub fn test_views(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|view| view.split == Split::Test)
    }

    /// Leaves out views by name, also from the tracks of points.
    pub fn leave_out(&mut self, names: &[String]) {
        let names: HashSet<&str> = names.iter().map(String::as_str).collect();
        let stays = |view: &View| !names.contains(view.name.as_str());
        let mut indices = 0..;
        let of_view = self.views.iter().map(|view| if stays(view) { indices.next() } else { None });
        let indices: Vec<Option<u32>> = of_view.collect();
        for point in &mut self.points {
            point.views = point.views.iter().filter_map(|&view| indices[view as usize]).collect();
        }
        self.views.retain(stays);
    }
}

/// Holds out `count` of the training views, at most an eighth: views that cover the positions and directions of the
/// cameras.
pub(super) fn with_held_out(mut views: Vec<View>, count: usize) -> Vec<View> {
    const MOST: usize = 8;
    let mut training: Vec<&mut View> = views.iter_mut().filter(|view| view.is_train()).collect();
    let cameras: Vec<Camera> = training.iter().map(|view| view.camera).collect();
    for index in Camera::covering(&cameras, count.min(training.len() / MOST)) {
        training[index].split = Split::HeldOut;
    }
    views
}
