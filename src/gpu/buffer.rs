//! Typed device buffers, and their transfers to and from the host.

use std::marker::PhantomData;

use ash::vk::Handle as _;

use super::limits::whole_quads;
use super::parts::Parts;
use super::{Bound, Gpu, Properties, Slice, SliceMut};
use crate::{Error, Result};

/// An array of `T` in device memory, and its only owner: passes bind [`Slice`](super::Slice)s and
/// `SliceMut`s that borrow it. Dropping it frees the memory once no submission uses it.
#[derive(Debug)]
pub struct Buffer<T> {
    memory: Parts,
    len: usize,
    element: PhantomData<T>,
}

impl<T: bytemuck::Pod> Buffer<T> {
    /// The number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True for a buffer of no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The name it was created with.
    pub fn name(&self) -> &str {
        self.memory.name()
    }

    /// The `VkBuffer`, for a host application that binds it itself; the first, where one cannot hold the elements.
    pub fn handle(&self) -> u64 {
        self.memory.handle().as_raw()
    }

    /// Whether it is in the memory of this device.
    #[doc(hidden)]
    pub fn is_on(&self, gpu: &Gpu) -> bool {
        self.memory.is_on(&gpu.shared)
    }

    /// All of it, to read.
    #[doc(hidden)]
    pub fn slice(&self) -> Slice<'_, T> {
        Slice::new(&self.memory, self.len)
    }

    /// All of it, to read and write.
    #[doc(hidden)]
    pub fn slice_mut(&mut self) -> SliceMut<'_, T> {
        SliceMut::new(&self.memory, self.len)
    }

    /// Refuses a buffer of fewer elements than a pass accesses.
    pub(crate) fn check_len(&self, needed: usize) -> Result<()> {
        self.slice().check_len(needed)
    }

    /// Reallocates it if it has fewer than `len` elements; its contents are then undefined.
    pub(crate) fn grow(&mut self, gpu: &Gpu, len: usize) -> Result<()> {
        if self.len < len {
            *self = gpu.uninit(self.name(), len)?;
        }
        Ok(())
    }

    /// Writes a new buffer, which no submission uses yet; returns whether the host sees its memory.
    pub(super) fn write_from_host(&mut self, data: &[T]) -> bool {
        self.memory.write(bytemuck::cast_slice(data))
    }

    /// All of it, for copies of a buffer within the limit of a binding.
    pub(super) fn bound(&self) -> Bound {
        Bound { raw: self.memory.handle(), offset: 0, size: (self.len * size_of::<T>()) as u64 }
    }

    /// All of it, for copies, each of one Vulkan buffer.
    pub(super) fn pieces(&self) -> impl Iterator<Item = Bound> {
        self.memory.pieces(0, (self.len * size_of::<T>()) as u64)
    }

    /// Whether passes can bind windows of this number of elements, from multiples of it on.
    pub(crate) fn suits_windows(&self, window: usize) -> bool {
        self.memory.suit((window * size_of::<T>()) as u64)
    }
}

impl<'a, T: bytemuck::Pod> From<&'a Buffer<T>> for Slice<'a, T> {
    fn from(buffer: &'a Buffer<T>) -> Self {
        buffer.slice()
    }
}

impl<'a, T: bytemuck::Pod> From<&'a mut Buffer<T>> for SliceMut<'a, T> {
    fn from(buffer: &'a mut Buffer<T>) -> Self {
        buffer.slice_mut()
    }
}

impl Gpu {
    /// A buffer of `len` elements whose contents are undefined.
    #[doc(hidden)]
    pub fn uninit<T: bytemuck::Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        let Properties { name: device, max_storage_buffer_range: limit, .. } = self.properties();
        if whole_quads(bytes) > *limit {
            let (buffer, device, limit) = (name.to_owned(), device.clone(), *limit);
            return Err(Error::BufferTooLarge { buffer, bytes, device, limit });
        }
        self.uninit_in_windows(name, len, len)
    }

    /// [`Gpu::uninit`] for a buffer of which passes only bind windows of `window` elements, from multiples of that on:
    /// only memory limits its length.
    pub(crate) fn uninit_in_windows<T: bytemuck::Pod>(
        &self,
        name: &str,
        len: usize,
        window: usize,
    ) -> Result<Buffer<T>> {
        let [bytes, window] =
            [len, window].map(|len| (len as u64).saturating_mul(size_of::<T>() as u64));
        let memory = Parts::new(&self.shared, name, bytes, window)?;
        Ok(Buffer { memory, len, element: PhantomData })
    }
}
