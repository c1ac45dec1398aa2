//! The order of the training views: every epoch takes each view once, in its own order.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use nightsplat_core::random::Stream;

use super::streams;

/// The orders of recent epochs, each drawn once.
#[derive(Debug, Default)]
pub(super) struct Epochs(Mutex<VecDeque<(Key, Arc<[usize]>)>>);

/// Seed, number of views and epoch, which determine an order.
type Key = (u64, usize, u64);

/// The most orders kept: steps are reported while those of the next epoch are recorded.
const MAX_KEPT: usize = 4;

impl Epochs {
    /// The order of the epoch of a step, counted from 1, and the step's position in it.
    pub(super) fn of_step(&self, seed: u64, step: u64, view_count: usize) -> (Arc<[usize]>, usize) {
        let count = view_count as u64;
        let (epoch, position) = ((step - 1) / count, (step - 1) % count);
        let key = (seed, view_count, epoch);
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let cached = kept.iter().find(|(cached, _)| *cached == key).map(|(_, order)| order.clone());
        let order = cached.unwrap_or_else(|| {
            let order: Arc<[usize]> = order(seed, view_count, epoch).into();
            kept.truncate(MAX_KEPT - 1);
            kept.push_front((key, Arc::clone(&order)));
            order
        });
        (order, position as usize)
    }
}

/// A Fisher-Yates shuffle; its draws depend only on seed and epoch.
fn order(seed: u64, view_count: usize, epoch: u64) -> Vec<usize> {
    let stream = Stream::new(seed, streams::VIEWS);
    let mut order: Vec<usize> = (0..view_count).collect();
    for left in (1..view_count as u64).rev() {
        let draw = stream.bits(epoch * view_count as u64 + left) % (left + 1);
        order.swap(left as usize, draw as usize);
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_takes_every_view_once_and_its_order_is_drawn_once() {
        let epochs = Epochs::default();
        for epoch in 0..3_u64 {
            let taken = (0..7).map(|step| {
                let (order, position) = epochs.of_step(5, 1 + 7 * epoch + step, 7);
                assert_eq!(order.as_ptr(), epochs.of_step(5, 1 + 7 * epoch, 7).0.as_ptr());
                order[position]
            });
            let mut taken: Vec<usize> = taken.collect();
            assert_eq!(taken, order(5, 7, epoch));
            taken.sort_unstable();
            assert_eq!(taken, [0, 1, 2, 3, 4, 5, 6]);
        }
        assert_ne!(order(5, 7, 0), order(5, 7, 1));
        assert_eq!(epochs.0.lock().unwrap().len(), 3);
    }
}
