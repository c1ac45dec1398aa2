//! Which views take part: some are left out by name, some kept from training.

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

/// Keeps so many training views from training, an eighth of them at most, spread evenly.
pub(super) fn with_held_out(mut views: Vec<View>, count: usize) -> Vec<View> {
    const MOST: usize = 8;
    let mut training: Vec<&mut View> = views.iter_mut().filter(|view| view.is_train()).collect();
    let (of, count) = (training.len(), count.min(training.len() / MOST));
    for place in 0..count {
        training[(2 * place + 1) * of / (2 * count)].split = Split::HeldOut;
    }
    views
}
