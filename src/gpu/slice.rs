//! Borrowed slices of buffers: what passes bind. They follow the rules of `&` and `&mut`, so `build.rs` may tell the
//! driver that no two buffers of a pass overlap where one is written.

use std::marker::PhantomData;
use std::ops::Range;

use super::Bound;
use super::parts::Parts;
use crate::{Error, Result};

/// Read-only elements of a buffer.
#[derive(Clone, Copy, Debug)]
pub struct Slice<'a, T> {
    memory: &'a Parts,
    /// The offset in the memory, in elements.
    first: usize,
    len: usize,
    element: PhantomData<&'a T>,
}

/// Elements of a buffer to read and write; while it lives, nothing else reads or writes them. None can be made while a
/// [`Slice`] of them lives:
///
/// ```compile_fail,E0502
/// # use nightsplat::gpu::{Buffer, Gpu};
/// # use nightsplat::kernels::crop_gather;
/// fn copied_onto_itself(buffer: &mut Buffer<f32>) -> crop_gather::Buffers<'_> {
///     crop_gather::Buffers { image: buffer.slice(), content: buffer.slice_mut() }
/// }
/// ```
///
/// and none of a buffer that is only shared:
///
/// ```compile_fail,E0596
/// # use nightsplat::gpu::{Buffer, Gpu};
/// # use nightsplat::kernels::crop_gather;
/// fn written_through_a_shared_reference<'a>(
///     image: &'a Buffer<f32>,
///     content: &'a Buffer<f32>,
/// ) -> crop_gather::Buffers<'a> {
///     crop_gather::Buffers { image: image.slice(), content: content.slice_mut() }
/// }
/// ```
///
/// A pass takes two buffers, of which one may be written:
///
/// ```
/// # use nightsplat::gpu::{Buffer, Gpu};
/// # use nightsplat::kernels::crop_gather;
/// fn copied_to_another<'a>(
///     image: &'a Buffer<f32>,
///     content: &'a mut Buffer<f32>,
/// ) -> crop_gather::Buffers<'a> {
///     crop_gather::Buffers { image: image.slice(), content: content.slice_mut() }
/// }
/// ```
#[derive(Debug)]
pub struct SliceMut<'a, T> {
    memory: &'a Parts,
    first: usize,
    len: usize,
    element: PhantomData<&'a mut T>,
}

/// The largest alignment of a binding that Vulkan lets a device require, in bytes.
const ALIGNMENT: usize = 256;

impl<'a, T: bytemuck::Pod> Slice<'a, T> {
    /// The first `len` elements of the memory.
    pub(super) fn new(memory: &'a Parts, len: usize) -> Self {
        Self { memory, first: 0, len, element: PhantomData }
    }

    /// The number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True if it has no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Refuses a slice of fewer elements than a pass accesses.
    pub(crate) fn check_len(&self, needed: usize) -> Result<()> {
        let (name, len) = (self.memory.name(), self.len);
        match len < needed {
            true => {
                Err(Error::Usage(format!("buffer `{name}` holds {len} elements, not {needed}")))
            }
            false => Ok(()),
        }
    }

    /// Where it begins: a number of the buffer, and the element.
    pub(crate) fn begin(&self) -> (usize, usize) {
        (std::ptr::from_ref(self.memory).addr(), self.first)
    }

    /// The name of the buffer.
    pub(crate) fn name(&self) -> &str {
        self.memory.name()
    }

    /// A range of its elements.
    pub(crate) fn range(self, range: Range<usize>) -> Result<Self> {
        let first = self.first + offset_of::<T>(self.memory, self.len, &range)?;
        Ok(Self { first, len: range.len(), ..self })
    }

    /// What a dispatch binds.
    pub(crate) fn bound(&self) -> Bound {
        bound::<T>(self.memory, self.first, self.len)
    }

    /// What copies read or write.
    pub(super) fn pieces(&self) -> impl Iterator<Item = Bound> + use<'a, T> {
        pieces::<T>(self.memory, self.first, self.len)
    }
}

impl<'a, T: bytemuck::Pod> SliceMut<'a, T> {
    /// The first `len` elements of memory whose owner is mutably borrowed.
    pub(super) fn new(memory: &'a Parts, len: usize) -> Self {
        Self { memory, first: 0, len, element: PhantomData }
    }

    /// The number of elements.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// The same elements to read, while this is not used.
    pub fn as_slice(&self) -> Slice<'_, T> {
        let Self { memory, first, len, .. } = *self;
        Slice { memory, first, len, element: PhantomData }
    }

    /// Reborrows it: this can be used again afterwards.
    pub fn reborrow(&mut self) -> SliceMut<'_, T> {
        let Self { memory, first, len, .. } = *self;
        SliceMut { memory, first, len, element: PhantomData }
    }

    /// A range of its elements.
    pub fn range(self, range: Range<usize>) -> Result<Self> {
        let first = self.first + offset_of::<T>(self.memory, self.len, &range)?;
        Ok(Self { first, len: range.len(), ..self })
    }

    /// Several parts of it, for a pass that binds each separately. Parts may be empty, in any order and with gaps.
    pub fn split<const N: usize>(self, ranges: [Range<usize>; N]) -> Result<[Self; N]> {
        for (i, a) in ranges.iter().enumerate() {
            offset_of::<T>(self.memory, self.len, a)?;
            if let Some(b) = ranges[..i].iter().find(|b| a.start.max(b.start) < a.end.min(b.end)) {
                let name = self.memory.name();
                let what = format!("parts {b:?} and {a:?} of buffer `{name}` overlap");
                return Err(Error::Usage(what));
            }
        }
        let Self { memory, first, .. } = self;
        Ok(ranges.map(|range| SliceMut {
            memory,
            first: first + range.start,
            len: range.len(),
            element: PhantomData,
        }))
    }

    /// What a dispatch binds.
    pub(crate) fn bound(&self) -> Bound {
        bound::<T>(self.memory, self.first, self.len)
    }

    /// What copies read or write.
    pub(super) fn pieces(&self) -> impl Iterator<Item = Bound> + use<'a, T> {
        pieces::<T>(self.memory, self.first, self.len)
    }
}

impl<'a> Slice<'a, f32> {
    /// The bits of the same elements, for a kernel that stores other numbers than floats in them.
    pub(crate) fn words(self) -> Slice<'a, u32> {
        let Self { memory, first, len, .. } = self;
        Slice { memory, first, len, element: PhantomData }
    }
}

impl<'a> SliceMut<'a, f32> {
    /// The bits of the same elements, for a kernel that stores other numbers than floats in them.
    pub fn words(self) -> SliceMut<'a, u32> {
        let Self { memory, first, len, .. } = self;
        SliceMut { memory, first, len, element: PhantomData }
    }
}

/// The offset of a range of elements, checked; `len` is the slice's.
fn offset_of<T>(memory: &Parts, len: usize, range: &Range<usize>) -> Result<usize> {
    let name = memory.name();
    if range.start > range.end || range.end > len {
        let what =
            format!("elements {range:?} are out of range for buffer `{name}`, which has {len}");
        return Err(Error::Usage(what));
    }
    if !(range.start * size_of::<T>()).is_multiple_of(ALIGNMENT) {
        let what = format!(
            "elements {range:?} of buffer `{name}` begin at no multiple of {ALIGNMENT} bytes, which a binding must"
        );
        return Err(Error::Usage(what));
    }
    Ok(range.start)
}

/// Vulkan has no empty bindings: an empty slice binds the start, where every buffer has some bytes.
fn bound<T>(memory: &Parts, first: usize, len: usize) -> Bound {
    let [first, size] = [first, len].map(|n| (n * size_of::<T>()) as u64);
    memory.bound(first, size)
}

/// The same in pieces for copies, each of one Vulkan buffer.
fn pieces<T>(memory: &Parts, first: usize, len: usize) -> impl Iterator<Item = Bound> + use<'_, T> {
    let [first, size] = [first, len].map(|n| (n * size_of::<T>()) as u64);
    memory.pieces(first, size)
}

#[cfg(test)]
mod tests {
    use crate::gpu::testing::gpu;

    #[test]
    fn a_range_is_within_the_slice_and_begins_where_a_binding_can() {
        let gpu = gpu();
        let buffer = gpu.zeros::<f32>("numbers", 200).unwrap();
        let second = buffer.slice().range(64..200).unwrap();
        assert_eq!((second.len(), second.bound().offset, second.bound().size), (136, 256, 544));
        let third = second.range(64..136).unwrap();
        assert_eq!((third.len(), third.bound().offset), (72, 512));
        assert!(buffer.slice().range(0..0).unwrap().is_empty());
        #[expect(clippy::reversed_empty_ranges, reason = "that is refused")]
        for (range, problem) in [
            (64..201, "out of range for buffer `numbers`, which has 200"),
            (128..64, "out of range"),
            (1..2, "begin at no multiple of 256 bytes"),
        ] {
            let error = buffer.slice().range(range.clone()).unwrap_err().to_string();
            assert!(error.contains(problem), "{range:?}: {error}");
        }
        assert!(third.range(0..73).is_err(), "the buffer holds them, the slice does not");
    }

    #[test]
    fn parts_of_a_split_are_disjoint_or_refused() {
        let gpu = gpu();
        let mut buffer = gpu.zeros::<f32>("numbers", 256).unwrap();
        let parts = buffer.slice_mut().split([128..256, 0..64, 128..128, 0..0]).unwrap();
        let bounds = parts.map(|part| (part.bound().offset, part.bound().size));
        assert_eq!(bounds, [(512, 512), (0, 256), (0, 0), (0, 0)]);
        for (ranges, problem) in [
            ([0..65, 64..128], "parts 0..65 and 64..128 of buffer `numbers` overlap"),
            ([64..128, 0..256], "overlap"),
            ([0..64, 0..64], "overlap"),
            ([0..64, 192..257], "out of range"),
            ([0..64, 65..70], "begin at no multiple of 256 bytes"),
        ] {
            let error = buffer.slice_mut().split(ranges).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
    }
}
