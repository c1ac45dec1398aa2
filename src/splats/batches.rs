//! Gaussians in batches: planes that exceed one binding are stored batch after batch.
//!
//! A pass over Gaussians is dispatched once per batch and bound to its slices. Most devices bind gigabytes, and there
//! is one batch; some bind 128 MiB, the planes of half a million Gaussians of SH degree 3.

use std::ops::Range;

use nightsplat_models::attributes::{Attribute, AttributePlane, PlaneCounts, planes};

use crate::Result;
use crate::gpu::{Buffer, Gpu, Slice, SliceMut};
use crate::splats::packed_sh::StorageFormat;

/// The layout of planes in a buffer.
#[derive(Clone, Copy, Debug)]
pub struct Batches {
    planes: PlaneCounts,
    /// Columns, from the first, that the buffer does not have.
    frozen: u32,
    /// The most Gaussians of a batch.
    size: usize,
    rest_by_column: bool,
}

/// Whether these columns, from the first, hold all that splats depend on but colours: means, shapes and opacities.
pub(crate) fn freezes_splats(frozen_columns: u32) -> bool {
    frozen_columns as usize >= Attribute::Dc.column(0)
}

/// Whether SH coefficients above degree 0 are stored word by word, each for all Gaussians of a batch, instead of
/// Gaussian by Gaussian. On a GPU, the lanes of a subgroup, one for each Gaussian, then access neighbouring words. A
/// CPU accesses the words of each lane by themselves. Files have them Gaussian by Gaussian.
pub(crate) fn rest_by_column(gpu: &Gpu) -> bool {
    !gpu.properties().is_cpu
}

/// What the backward pass writes of the gradients of SH coefficients above degree 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GradientKind {
    /// All of them.
    All,
    /// That of the colour in place of the first three, from which `adam_gaussian` computes them and what they add to
    /// the gradient of the mean, through the viewing direction.
    Colors,
}

impl GradientKind {
    /// The kind for coefficients and moments of these formats. Those of colours are less to write and to read; but a
    /// CPU updates 32-bit floats faster four at a time, whatever their Gaussian.
    pub(crate) fn on(gpu: &Gpu, formats: [StorageFormat; 2]) -> Self {
        let are_single = formats == [StorageFormat::Single; 2];
        if gpu.properties().is_cpu && are_single { Self::All } else { Self::Colors }
    }
}

/// Gaussians whose planes are contiguous.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Batch {
    /// The number of Gaussians before it.
    pub first: usize,
    /// Its number of Gaussians.
    pub count: usize,
    columns: usize,
    frozen: u32,
}

/// The floats of a batch, from the first, that its gradients and moments do not have: those of the first `columns`
/// columns, in whole vectors of four (include/trained.glsl).
pub(crate) fn frozen_floats(columns: u32, gaussians: usize) -> usize {
    columns as usize * gaussians / 4 * 4
}

/// A batch starts at a multiple of this many Gaussians: its binding is then aligned on every device, for any element
/// size.
pub(crate) const ALIGNMENT: usize = 64;

impl Batches {
    /// Batches of planes of floats: each binding holds a batch.
    pub fn new(gpu: &Gpu, planes: PlaneCounts) -> Self {
        let floats = gpu.properties().max_storage_buffer_range / size_of::<f32>() as u64;
        // Kernels count floats in 32 bits.
        let floats = floats.min(u64::from(u32::MAX)) as usize;
        let size = (floats / planes.columns.max(1) / ALIGNMENT).max(1) * ALIGNMENT;
        Self { planes, frozen: 0, size, rest_by_column: rest_by_column(gpu) }
    }

    /// The layout of the gradients and moments of the same Gaussians if their first `columns` columns are not trained.
    /// It has no memory for these; they are read as 0.
    pub fn without(self, columns: u32) -> Self {
        Self { frozen: columns, ..self }
    }

    /// Floats of a batch that is full.
    pub(crate) fn window(&self) -> usize {
        self.size * (self.planes.columns - self.frozen as usize)
    }

    /// Floats of all batches. Those of all but the last have a multiple of [`ALIGNMENT`] Gaussians.
    pub(crate) fn floats(&self) -> usize {
        self.planes.total() - frozen_floats(self.frozen, self.planes.gaussians)
    }

    /// The layout of the same Gaussians with `columns` words each instead of their floats.
    pub(crate) fn with_columns(self, columns: usize) -> Self {
        Self { planes: PlaneCounts { columns, ..self.planes }, ..self }
    }

    /// The batches in order; one empty batch if there are no Gaussians.
    pub fn iter(&self) -> impl Iterator<Item = Batch> + use<> {
        let Self { planes: PlaneCounts { gaussians: count, columns, .. }, frozen, size, .. } =
            *self;
        let begins = (0..count.max(1)).step_by(size);
        begins.map(move |first| Batch { first, count: size.min(count - first), columns, frozen })
    }

    /// A buffer of planes in batches, from the planes of all Gaussians.
    pub fn upload(&self, gpu: &Gpu, name: &str, planes: &[f32]) -> Result<Buffer<f32>> {
        let mut buffer = self.uninit(gpu, name)?;
        self.write(gpu, &mut buffer, planes)?;
        Ok(buffer)
    }

    /// A buffer of uninitialised planes.
    pub fn uninit(&self, gpu: &Gpu, name: &str) -> Result<Buffer<f32>> {
        gpu.uninit_in_windows(name, self.floats(), self.window())
    }

    /// A buffer of zeroed planes.
    pub fn zeros(&self, gpu: &Gpu, name: &str) -> Result<Buffer<f32>> {
        gpu.zeroed(self.uninit(gpu, name)?)
    }

    /// Overwrites the planes in a buffer by those of all Gaussians.
    pub fn write<'a>(
        &self,
        gpu: &Gpu,
        buffer: impl Into<SliceMut<'a, f32>>,
        planes: &[f32],
    ) -> Result<()> {
        if self.is_plain() {
            return gpu.write(buffer, planes);
        }
        let mut batched = Vec::with_capacity(self.floats());
        for BufferPart { range, columns } in self.parts() {
            let rows = &planes[range];
            (0..columns).for_each(|k| batched.extend(rows.iter().skip(k).step_by(columns)));
        }
        gpu.write(buffer, &batched)
    }

    /// The planes of all Gaussians, from those in a buffer.
    pub fn read<'a>(&self, gpu: &Gpu, buffer: impl Into<Slice<'a, f32>>) -> Result<Vec<f32>> {
        let mut batched = gpu.read(buffer)?;
        batched.truncate(self.floats());
        if self.is_plain() {
            return Ok(batched);
        }
        let mut planes = vec![0.0; self.planes.total()];
        let mut rest = batched.as_slice();
        for BufferPart { range, columns } in self.parts() {
            let (part, others) = rest.split_at(range.len());
            let count = (range.len() / columns).max(1);
            for (k, column) in part.chunks(count).enumerate() {
                let rows = planes[range.clone()].iter_mut().skip(k).step_by(columns);
                rows.zip(column).for_each(|(to, value)| *to = *value);
            }
            rest = others;
        }
        Ok(planes)
    }

    /// The index of a float of a buffer in the planes of all Gaussians.
    pub fn index_of(&self, float: usize) -> usize {
        let mut before = 0;
        for BufferPart { range, columns } in self.parts() {
            let (offset, count) = (float - before, range.len() / columns);
            if offset < range.len() {
                return range.start + offset % count * columns + offset / count;
            }
            before += range.len();
        }
        float
    }

    /// Whether the buffer has the planes as they are.
    fn is_plain(&self) -> bool {
        let is_whole = self.planes.gaussians <= self.size;
        is_whole && self.frozen == 0 && !(self.rest_by_column && self.planes.rest() > 1)
    }

    /// The parts of a buffer, in order.
    fn parts(&self) -> impl Iterator<Item = BufferPart> + use<> {
        let Self { planes: PlaneCounts { gaussians: count, columns, features }, .. } = *self;
        let rest_by_column = self.rest_by_column;
        self.iter().flat_map(move |batch| {
            let frozen = frozen_floats(batch.frozen, batch.count);
            planes(features, columns).into_iter().map(move |plane| {
                let AttributePlane { attribute, column, width } = plane;
                let begin = column * count + width * batch.first;
                let end = begin + width * batch.count;
                let is_by_column = rest_by_column && attribute == Attribute::Rest;
                let columns = if is_by_column { width.max(1) } else { 1 };
                let left_out = frozen.saturating_sub(column * batch.count).min(end - begin);
                BufferPart { range: begin + left_out..end, columns }
            })
        })
    }
}

/// A part of a buffer.
struct BufferPart {
    /// The corresponding range of the planes of all Gaussians.
    range: Range<usize>,
    /// The columns that the part stores one after the other; 1: as in the range.
    columns: usize,
}

impl Batch {
    /// Its slice of a buffer of planes in batches.
    pub fn planes<'a>(&self, planes: impl Into<Slice<'a, f32>>) -> Result<Slice<'a, f32>> {
        planes.into().range(self.floats())
    }

    /// [`Self::planes`], mutable.
    pub fn planes_mut<'a>(
        &self,
        planes: impl Into<SliceMut<'a, f32>>,
    ) -> Result<SliceMut<'a, f32>> {
        planes.into().range(self.floats())
    }

    fn floats(&self) -> Range<usize> {
        let Range { start, end } = self.range(self.columns);
        let first = start - frozen_floats(self.frozen, self.first);
        first..first + end - start - frozen_floats(self.frozen, self.count)
    }

    /// Its slice of a buffer of `each` elements per Gaussian, Gaussian-major.
    pub fn rows<'a, T: bytemuck::Pod>(
        &self,
        rows: impl Into<Slice<'a, T>>,
        each: usize,
    ) -> Result<Slice<'a, T>> {
        rows.into().range(self.range(each))
    }

    /// [`Self::rows`], mutable.
    pub fn rows_mut<'a, T: bytemuck::Pod>(
        &self,
        rows: impl Into<SliceMut<'a, T>>,
        each: usize,
    ) -> Result<SliceMut<'a, T>> {
        rows.into().range(self.range(each))
    }

    fn range(&self, each: usize) -> Range<usize> {
        self.first * each..(self.first + self.count) * each
    }

    /// The same Gaussians in buffers that have others before them, a multiple of [`ALIGNMENT`].
    pub(crate) fn after(self, others: usize) -> Self {
        Self { first: self.first + others, ..self }
    }

    /// Its number of Gaussians in 32 bits, for kernels.
    pub fn gaussian_count(&self) -> u32 {
        self.count as u32
    }

    /// The number of Gaussians before it in 32 bits, for kernels.
    pub fn first_gaussian(&self) -> u32 {
        self.first as u32
    }
}
