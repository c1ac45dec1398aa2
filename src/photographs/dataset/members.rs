//! Which views take part: some are left out by name, some kept from training.

use super::{Dataset, Split, View};
use crate::camera::Camera;

impl Dataset {
    /// The training views.
    pub fn train_views(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|view| view.split == Split::Train)
    }

    /// The held-out views.
    pub fn test_views(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|view| view.split == Split::Test)
    }

    /// Leaves out views by name; points forget them.
    pub fn leave_out(&mut self, names: &[String]) {
        let stays: Vec<bool> = self.views.iter().map(|view| !names.contains(&view.name)).collect();
        let place = |view: u32| {
            let stays_before = stays[..view as usize].iter().filter(|&&stays| stays).count();
            stays[view as usize].then_some(stays_before as u32)
        };
        for point in &mut self.points {
            point.views = point.views.iter().filter_map(|&view| place(view)).collect();
        }
        self.views.retain(|view| !names.contains(&view.name));
    }
}

/// Holds out `count` of the training views, an eighth of them at most: views that cover where the cameras stand and look.
pub(super) fn with_held_out(mut views: Vec<View>, count: usize) -> Vec<View> {
    const MOST: usize = 8;
    let mut training: Vec<&mut View> = views.iter_mut().filter(|view| view.is_train()).collect();
    let cameras: Vec<Camera> = training.iter().map(|view| view.camera).collect();
    for place in Camera::covering(&cameras, count.min(training.len() / MOST)) {
        training[place].split = Split::HeldOut;
    }
    views
}
