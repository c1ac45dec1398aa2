//! Limits on the size of an image and on the memory of decoding.

use std::sync::{Condvar, Mutex, PoisonError};

/// More than any camera: 16 384 x 16 384.
pub(super) const MAX_PIXELS: u64 = 1 << 28;

/// A photograph of more pixels is reduced while it is decoded, to at most `REDUCED`, unless it is wanted larger.
/// Cameras have 61 million; those of medium format 102 or 151.
const LARGE: u64 = 1 << 26;
const REDUCED: u64 = 1 << 22;

/// Bytes that decoders may hold at a time in all threads, unless one alone needs more.
const MOST_AT_ONCE: u64 = 1 << 30;

/// The size at which a photograph of this size is decoded: its own, or that by a whole number, at least `wanted`.
pub fn reduced_size((width, height): (u32, u32), wanted: (u32, u32)) -> (u32, u32) {
    let pixels = u64::from(width) * u64::from(height);
    if pixels <= LARGE {
        return (width, height);
    }
    let factor = (pixels as f64 / REDUCED as f64).sqrt().ceil() as u32;
    let most = [(width, wanted.0), (height, wanted.1)].map(|(side, wanted)| side / wanted.max(1));
    let factor = factor.min(most[0]).min(most[1]).max(1);
    let side = |side: u32| (f64::from(side) / f64::from(factor)).round().max(1.0) as u32;
    (side(width), side(height))
}

/// How many photographs of this number of pixels may be decoded at once, within a memory budget.
pub fn decoded_at_once(pixels: u64) -> usize {
    /// Memory budget, bytes.
    const MOST: u64 = 1 << 30;
    /// Pixels in the file's format, as floats, and reordered.
    const BYTES_PER_PIXEL: u64 = 40;
    usize::try_from(MOST / (BYTES_PER_PIXEL * pixels.max(1))).unwrap_or(usize::MAX).max(1)
}

/// Bytes that decoders hold.
static HELD: Mutex<u64> = Mutex::new(0);
static RELEASED: Condvar = Condvar::new();

/// Memory of a decoder, until it is dropped. Who holds it waits for no other thread, which may wait for it.
pub(super) struct Permit(u64);

impl Permit {
    /// Waits until this number of bytes is free.
    pub(super) fn wait(bytes: u64) -> Self {
        let held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        let is_full = |held: &mut u64| *held > 0 && held.saturating_add(bytes) > MOST_AT_ONCE;
        let held = RELEASED.wait_while(held, is_full);
        *held.unwrap_or_else(PoisonError::into_inner) += bytes;
        Self(bytes)
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        *HELD.lock().unwrap_or_else(PoisonError::into_inner) -= self.0;
        RELEASED.notify_all();
    }
}

/// The limits of decoders: those of this module, instead of their own.
pub(super) fn limits() -> ::image::Limits {
    let mut limits = ::image::Limits::no_limits();
    // Four channels of 16 bits, and the decoder's own.
    limits.max_alloc = Some(16 * MAX_PIXELS);
    limits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_photograph_is_reduced_by_a_whole_number_to_what_is_wanted() {
        // Of a phone and of small cameras.
        for size in [(8064, 6048), (9504, 6336), (8192, 8192)] {
            assert_eq!(reduced_size(size, (1, 1)), size);
        }
        let (whole, half, fifth) = ((11_600, 8700), (5800, 4350), (2320, 1740));
        for (wanted, reduced) in [(1600, fifth), (3867, half), (5801, whole), (11_600, whole)] {
            let found = reduced_size(whole, (wanted, wanted * 3 / 4));
            assert_eq!(found, reduced);
        }
        assert_eq!(reduced_size((1 << 28, 1), (1, 1)), (1 << 28, 1));
    }

    #[test]
    fn decoders_that_need_much_memory_wait_for_each_other() {
        let first = Permit::wait(MOST_AT_ONCE);
        let (sender, receiver) = std::sync::mpsc::channel();
        let second = std::thread::spawn(move || {
            let _permit = Permit::wait(MOST_AT_ONCE + 1);
            sender.send(()).unwrap();
        });
        assert!(receiver.recv_timeout(std::time::Duration::from_millis(20)).is_err());
        drop(first);
        receiver.recv().unwrap();
        second.join().unwrap();
    }
}
