//! Words that recordings leave on the host, to be read later: nothing waits for them.

use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::{Bound, Buffer, Gpu, LastUse, Recorder};
use crate::Result;

/// The recordings whose words are kept at a time; more in flight overwrite the oldest.
const SLOTS: usize = 4;

/// A copy of the same few words for each of the last recordings.
#[derive(Debug)]
pub(crate) struct Ring {
    memory: DeviceMemory,
    words: usize,
    slots: [Option<RingSlot>; SLOTS],
    next: usize,
}

/// The recording of a slot's words.
#[derive(Clone, Copy, Debug)]
struct RingSlot {
    recording: LastUse,
    /// The order of recording.
    number: u64,
    tag: u32,
}

impl Gpu {
    pub(crate) fn ring(&self, name: &str, words: usize) -> Result<Ring> {
        let bytes = (SLOTS * words * size_of::<u32>()) as u64;
        let memory = DeviceMemory::new(&self.shared, name, bytes, MemoryLocation::GpuToCpu)?;
        Ok(Ring { memory, words, slots: [None; SLOTS], next: 0 })
    }
}

impl Recorder<'_> {
    /// Copies the words of `buffer` as they are at this point of the recording to the host, with a number of the
    /// caller's beside them.
    pub(crate) fn copy_to_ring(&mut self, buffer: &Buffer<u32>, ring: &mut Ring, tag: u32) {
        let index = ring.next % SLOTS;
        let size = (ring.words * size_of::<u32>()) as u64;
        let target = Bound { offset: index as u64 * size, size, ..ring.memory.bound() };
        self.copy_raw(buffer.bound(), target, size);
        self.leave_for_host();
        let recording = LastUse { submission: self.value(), frame: self.shared().last_frame() };
        ring.slots[index] = Some(RingSlot { recording, number: ring.next as u64, tag });
        ring.next += 1;
    }
}

impl Ring {
    /// The place of the next recording in their order.
    pub(crate) fn number(&self) -> u64 {
        self.next as u64
    }

    /// The words of the newest recording that is done.
    pub(crate) fn newest(&self) -> Option<RingEntry> {
        let shared = &self.memory.shared;
        let done = LastUse { submission: shared.reached(), frame: shared.frames_reached() };
        let is_done = |slot: &RingSlot| {
            slot.recording.submission <= done.submission && slot.recording.frame <= done.frame
        };
        let slots = self.slots.iter().enumerate();
        let used = slots.filter_map(|(index, slot)| Some((index, (*slot)?)));
        let (index, slot) =
            used.filter(|(_, slot)| is_done(slot)).max_by_key(|(_, slot)| slot.number)?;
        let bytes = self.words * size_of::<u32>();
        let mapped = self.memory.mapped()?.get(index * bytes..)?.get(..bytes)?;
        let mut words = vec![0u32; self.words];
        bytemuck::cast_slice_mut(&mut words).copy_from_slice(mapped);
        Some(RingEntry { frame: slot.recording.frame, number: slot.number, tag: slot.tag, words })
    }
}

/// What [`Ring::newest`] finds.
#[derive(Debug)]
pub(crate) struct RingEntry {
    /// The number of its frame.
    pub(crate) frame: u64,
    /// Its place in the order of recording.
    pub(crate) number: u64,
    /// What was passed with them.
    pub(crate) tag: u32,
    pub(crate) words: Vec<u32>,
}
