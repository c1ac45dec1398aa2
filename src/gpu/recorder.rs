//! Records passes: bindings, parameters, dispatch, and the barriers that their hazards require.

use std::collections::HashMap;
use std::ffi::CString;
use std::hash::{BuildHasherDefault, Hasher};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use ash::vk;
use ash::vk::Handle as _;

use super::Tolerance;
use super::descriptors::Sets;
use super::limits::whole_quads;
use super::pipeline::Objects;
use super::{
    Binding, Bound, Buffer, GpuShared, HostFrame, Interface, Pipeline, Properties, Recordable,
};
use crate::{Error, Result};

/// The invocations of a dispatch; the kernel knows its workgroup size.
#[derive(Clone, Copy, Debug)]
pub enum Threads {
    /// At least this number of threads; a one-dimensional extent is folded where the device takes fewer workgroups
    /// along x.
    Exactly([u32; 3]),
    /// This number of workgroups, folded likewise.
    Workgroups([u32; 3]),
}

/// A command buffer being filled. Passes run in order; each sees the results of those before it.
#[derive(Debug)]
pub struct Recorder<'g> {
    shared: &'g Arc<GpuShared>,
    /// What its passes bind.
    sets: Sets,
    pub(super) commands: vk::CommandBuffer,
    /// The command buffers before that, which are full.
    pub(super) parts: Vec<vk::CommandBuffer>,
    /// Of the command buffers; a host has its own.
    pool: Option<vk::CommandPool>,
    /// Each pass has a command buffer of its own.
    is_cut: bool,
    /// The timeline value that signals the end of this recording.
    pub(super) value: u64,
    timestamps: Option<Timestamps>,
    /// Each pass with the bytes of the buffers that it binds.
    pub(super) labels: Vec<(&'static str, u64)>,
    /// Buffers accessed since the last barrier; true if written.
    pending: HashMap<vk::Buffer, bool, BuildHasherDefault<HandleHasher>>,
    /// The stages outside this recording that read our buffers, before it or after it.
    readers: vk::PipelineStageFlags2,
    /// The passes being recorded write different parts of the same buffers.
    is_concurrent: bool,
    /// Runs each pass alone and compares it with its reference instead of recording it.
    pub(super) observer: Option<&'g mut (dyn PassObserver + 'g)>,
}

/// Where a recording has timestamps.
#[derive(Clone, Copy, Debug)]
pub(super) enum Timestamps {
    /// At its start and after every pass, which then does not overlap with the next.
    OfPasses(vk::QueryPool),
    /// At its start and its end.
    OfAll(vk::QueryPool),
}

/// Runs passes in its own way instead of recording them.
pub(super) trait PassObserver: std::fmt::Debug {
    /// Does what recording and submitting the pass would do.
    fn pass(&mut self, recorder: &mut Recorder<'_>, pass: &ObservedPass<'_>) -> Result<()>;

    /// Submits the recording so far, waits for it, and starts a new one.
    fn run_recorded(&mut self, recorder: &mut Recorder<'_>, label: &str) -> Result<()>;
}

/// A pass without its types.
pub(super) struct ObservedPass<'a> {
    pub(super) objects: &'a Objects,
    pub(super) params: &'a [u8],
    pub(super) bound: &'a [Bound],
    pub(super) threads: Threads,
    pub(super) reference: &'a ReferenceOf<'a>,
}

/// Runs the reference on the words of a pass's buffers; returns the tolerances from other such words.
pub(super) type ReferenceOf<'a> = dyn Fn(&mut [Vec<u32>], &mut [Vec<u32>]) -> Vec<Tolerance> + 'a;

/// The timeline value of a recording that the host application submits: none of ours.
pub(super) const HOST_SUBMITS: u64 = 0;

/// Spreads the bits of handles, which are distinct already; several are looked up for each pass.
#[derive(Debug, Default)]
struct HandleHasher(u64);

impl Hasher for HandleHasher {
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|&byte| self.write_u64(byte.into()));
    }

    fn write_u64(&mut self, handle: u64) {
        self.0 = (self.0 ^ handle).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }

    fn finish(&self) -> u64 {
        self.0.rotate_left(26)
    }
}

/// Timestamps of one recording; later passes are not timed.
pub(super) const MAX_TIMESTAMPS: u32 = 4096;

/// The stages of everything that we record.
pub(super) const OUR_STAGES: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::from_raw(
    vk::PipelineStageFlags2::COMPUTE_SHADER.as_raw()
        | vk::PipelineStageFlags2::ALL_TRANSFER.as_raw(),
);

/// The most that `vkCmdUpdateBuffer` takes, in bytes.
const MAX_UPDATE: usize = 65_536;

impl<'g> Recorder<'g> {
    /// Starts with a barrier after everything submitted before; the host reads once it is done.
    pub(super) fn new(
        shared: &'g Arc<GpuShared>,
        pool: vk::CommandPool,
        value: u64,
        timestamps: Option<Timestamps>,
    ) -> Result<Self> {
        let commands = shared.begin(pool)?;
        let mut recorder = Self {
            value,
            timestamps,
            pool: Some(pool),
            ..Self::unstarted(shared, commands, vk::PipelineStageFlags2::HOST)
        };
        recorder.barrier();
        if let Some(queries) = recorder.queries() {
            // SAFETY: recording, and no other submission uses the pool.
            unsafe { shared.device.cmd_reset_query_pool(commands, queries, 0, MAX_TIMESTAMPS) };
        }
        recorder.timestamp(0);
        Ok(recorder)
    }

    /// Starts with a barrier after everything before it in the host's queue, and ends with one for what the host's own
    /// commands read.
    pub(super) fn for_host(shared: &'g Arc<GpuShared>, frame: &HostFrame) -> Self {
        let commands = vk::CommandBuffer::from_raw(frame.commands);
        let readers = vk::PipelineStageFlags2::from_raw(frame.readers);
        let mut recorder = Self::unstarted(shared, commands, readers);
        recorder.barrier_after(readers);
        recorder
    }

    fn unstarted(
        shared: &'g Arc<GpuShared>,
        commands: vk::CommandBuffer,
        readers: vk::PipelineStageFlags2,
    ) -> Self {
        Self {
            shared,
            sets: Sets::new(shared),
            commands,
            parts: vec![],
            pool: None,
            is_cut: false,
            value: HOST_SUBMITS,
            timestamps: None,
            labels: vec![],
            pending: HashMap::default(),
            readers,
            is_concurrent: false,
            observer: None,
        }
    }

    /// Submits each pass from here on by itself, which changes no result: systems reset a device whose submission takes
    /// seconds.
    pub(crate) fn cut_between_passes(&mut self) {
        self.is_cut = true;
    }

    /// Continues in another command buffer. Barriers hold across command buffers of a queue.
    fn cut(&mut self) -> Result<()> {
        if let Some(pool) = self.pool.filter(|_| self.is_cut) {
            let next = self.shared.begin(pool)?;
            self.parts.push(std::mem::replace(&mut self.commands, next));
        }
        Ok(())
    }

    pub(super) fn shared(&self) -> &'g Arc<GpuShared> {
        self.shared
    }

    pub(super) fn value(&self) -> u64 {
        self.value
    }

    /// The family of the queue that runs the recording.
    pub(super) fn family(&self) -> u32 {
        self.shared.family
    }

    /// What was recorded so far is read on the host once the recording is done.
    pub(super) fn leave_for_host(&mut self) {
        self.readers |= vk::PipelineStageFlags2::HOST;
    }

    /// Records one pass: label, barrier if a hazard requires it, bindings, parameters, dispatch, timestamp.
    #[doc(hidden)]
    pub fn dispatch<K: Recordable>(
        &mut self,
        pipeline: &Pipeline<K>,
        params: &K::Params,
        buffers: K::Buffers<'_>,
        threads: Threads,
    ) -> Result<()> {
        let bound = K::bound(&buffers);
        let words = bytemuck::bytes_of(params);
        if let Some(observer) = self.observer.take() {
            let reference = |words: &mut [Vec<u32>], before: &mut [Vec<u32>]| {
                K::reference(params, &pipeline.constants, words, before)
            };
            let objects = &pipeline.objects;
            let pass = ObservedPass {
                objects,
                params: words,
                bound: &bound,
                threads,
                reference: &reference,
            };
            let done = observer.pass(self, &pass);
            self.observer = Some(observer);
            return done;
        }
        self.record_dispatch(&pipeline.objects, words, &bound, threads)?;
        self.cut()
    }

    pub(super) fn record_dispatch(
        &mut self,
        pipeline: &Objects,
        params: &[u8],
        bound: &[Bound],
        threads: Threads,
    ) -> Result<()> {
        let Interface { name, bindings, .. } = *pipeline.interface;
        self.check_sizes(bindings, bound)?;
        let uses = bindings.iter().zip(bound).map(|(b, bound)| (bound.raw, b.writable));
        self.synchronize(uses);
        let groups = self.fold(name, self.workgroups(pipeline.interface, threads))?;
        self.begin_label(name);
        self.sets.bind(self.commands, pipeline, params, bound)?;
        if !groups.contains(&0) {
            let [x, y, z] = groups;
            // SAFETY: recording; a retired buffer outlives this submission.
            unsafe { self.shared.device.cmd_dispatch(self.commands, x, y, z) };
        }
        self.end_label(name, bound.iter().map(|bound| bound.size).sum());
        Ok(())
    }

    /// Records passes that write different parts of the same buffers, with no barrier between them. A check, which
    /// copies between passes, has its barriers.
    pub(crate) fn concurrently<R>(
        &mut self,
        record: impl FnOnce(&mut Self) -> Result<R>,
    ) -> Result<R> {
        self.barrier();
        self.is_concurrent = self.observer.is_none();
        let done = record(self);
        self.is_concurrent = false;
        done
    }

    /// Sets every 32-bit word of `buffer` to `word`.
    #[doc(hidden)]
    pub fn fill<T: bytemuck::Pod>(&mut self, buffer: &mut Buffer<T>, word: u32) {
        buffer.pieces().for_each(|piece| self.fill_raw(piece, word));
    }

    pub(super) fn fill_raw(&mut self, Bound { raw, offset, size }: Bound, word: u32) {
        self.synchronize([(raw, true)].into_iter());
        // SAFETY: recording; the buffer is live. Sizes of our element types are multiples of four.
        unsafe {
            self.shared.device.cmd_fill_buffer(self.commands, raw, offset, size, word);
        }
    }

    /// Overwrites the first elements of `buffer` with `data`, which is stored in the command buffer: for numbers that
    /// the host knows when it records.
    pub(crate) fn update<T: bytemuck::Pod>(
        &mut self,
        buffer: &mut Buffer<T>,
        data: &[T],
    ) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let Bound { raw, offset, size } = buffer.bound();
        if bytes.len() as u64 > size {
            let (name, count) = (buffer.name(), data.len());
            return Err(Error::Usage(format!("{count} elements do not fit buffer `{name}`")));
        }
        if !bytes.is_empty() {
            self.synchronize([(raw, true)].into_iter());
        }
        for (at, part) in (offset..).step_by(MAX_UPDATE).zip(bytes.chunks(MAX_UPDATE)) {
            // SAFETY: recording; the buffer holds the bytes. Sizes of our element types are multiples of four.
            unsafe { self.shared.device.cmd_update_buffer(self.commands, raw, at, part) };
        }
        Ok(())
    }

    /// Copies elements from the start of `source` to `target`, as many as both hold.
    #[doc(hidden)]
    pub fn copy<T: bytemuck::Pod>(&mut self, source: &Buffer<T>, target: &mut Buffer<T>) {
        // Buffers of the same windows have the same pieces.
        for (source, target) in source.pieces().zip(target.pieces()) {
            self.copy_raw(source, target, source.size.min(target.size));
        }
    }

    pub(super) fn copy_raw(&mut self, source: Bound, target: Bound, size: u64) {
        self.synchronize([(source.raw, false), (target.raw, true)].into_iter());
        let region =
            [vk::BufferCopy { src_offset: source.offset, dst_offset: target.offset, size }];
        // SAFETY: recording; both buffers hold `size` bytes from their offsets on.
        unsafe {
            self.shared.device.cmd_copy_buffer(self.commands, source.raw, target.raw, &region);
        }
    }

    /// Makes everything recorded so far visible to the stages that read it. Our own recordings begin with a barrier.
    pub(super) fn finish(&mut self) {
        if let Some(Timestamps::OfAll(_)) = self.timestamps {
            self.timestamp(1);
        }
        if self.readers.is_empty() {
            return;
        }
        let barrier = [vk::MemoryBarrier2::default()
            .src_stage_mask(OUR_STAGES)
            .src_access_mask(vk::AccessFlags2::SHADER_WRITE | vk::AccessFlags2::TRANSFER_WRITE)
            .dst_stage_mask(self.readers)
            .dst_access_mask(vk::AccessFlags2::MEMORY_READ)];
        let info = vk::DependencyInfo::default().memory_barriers(&barrier);
        // SAFETY: recording.
        unsafe { self.shared.device.cmd_pipeline_barrier2(self.commands, &info) };
    }

    /// Records one full barrier if a buffer in `uses` was written since the last barrier, or is written now and was
    /// read.
    pub(super) fn synchronize(&mut self, uses: impl Iterator<Item = (vk::Buffer, bool)> + Clone) {
        let hazard = !self.is_concurrent
            && uses.clone().any(|(raw, writes)| {
                self.pending.get(&raw).is_some_and(|&written| written || writes)
            });
        if hazard {
            self.barrier();
        }
        for (raw, writes) in uses {
            *self.pending.entry(raw).or_default() |= writes;
        }
    }

    pub(super) fn barrier(&mut self) {
        self.barrier_after(vk::PipelineStageFlags2::empty());
    }

    /// A barrier after our own stages and the host's `readers`, whose reads no later write overtakes.
    fn barrier_after(&mut self, readers: vk::PipelineStageFlags2) {
        self.shared.recorded.barriers.fetch_add(1, Ordering::Relaxed);
        let barrier = [vk::MemoryBarrier2::default()
            .src_stage_mask(OUR_STAGES | readers)
            .src_access_mask(vk::AccessFlags2::SHADER_WRITE | vk::AccessFlags2::TRANSFER_WRITE)
            .dst_stage_mask(OUR_STAGES)
            .dst_access_mask(
                vk::AccessFlags2::SHADER_READ
                    | vk::AccessFlags2::SHADER_WRITE
                    | vk::AccessFlags2::TRANSFER_READ
                    | vk::AccessFlags2::TRANSFER_WRITE,
            )];
        let info = vk::DependencyInfo::default().memory_barriers(&barrier);
        // SAFETY: recording.
        unsafe { self.shared.device.cmd_pipeline_barrier2(self.commands, &info) };
        self.pending.clear();
    }

    /// The workgroups of a dispatch.
    pub(super) fn workgroups(&self, interface: &Interface, threads: Threads) -> [u32; 3] {
        match threads {
            Threads::Exactly(n) => {
                let mut size = interface.workgroup_size;
                if size[0] == 0 {
                    size[0] = self.shared.properties.subgroup_size;
                }
                std::array::from_fn(|i| n[i].div_ceil(size[i]))
            }
            Threads::Workgroups(n) => n,
        }
    }

    /// A buffer that is bound in windows may be longer than a binding; one that is bound whole may not. What is bound
    /// is rounded up.
    fn check_sizes(&self, bindings: &[Binding], bound: &[Bound]) -> Result<()> {
        let Properties { name: device, max_storage_buffer_range: limit, .. } =
            &self.shared.properties;
        match bindings.iter().zip(bound).find(|(_, bound)| whole_quads(bound.size) > *limit) {
            Some((Binding { name, .. }, &Bound { size: bytes, .. })) => {
                let (buffer, device, limit) = ((*name).to_owned(), device.clone(), *limit);
                Err(Error::BufferTooLarge { buffer, bytes, device, limit })
            }
            None => Ok(()),
        }
    }

    /// Folds workgroups along x into y where the device takes fewer along one dimension.
    fn fold(&self, pass: &'static str, [x, y, z]: [u32; 3]) -> Result<[u32; 3]> {
        let max = self.shared.properties.max_workgroups;
        let folded = if x > max && y == 1 { [max, x.div_ceil(max), z] } else { [x, y, z] };
        if folded.iter().any(|&n| n > max) {
            return Err(Error::Usage(format!("{pass}: {x} x {y} x {z} workgroups are too many")));
        }
        Ok(folded)
    }

    fn begin_label(&self, name: &'static str) {
        if let (Some(debug), Ok(name)) = (&self.shared.labels, CString::new(name)) {
            let label = vk::DebugUtilsLabelEXT::default().label_name(&name);
            // SAFETY: recording.
            unsafe { debug.cmd_begin_debug_utils_label(self.commands, &label) };
        }
    }

    fn end_label(&mut self, name: &'static str, bytes: u64) {
        if let Some(debug) = &self.shared.labels {
            // SAFETY: recording; every label that is ended was begun.
            unsafe { debug.cmd_end_debug_utils_label(self.commands) };
        }
        self.shared.recorded.dispatches.fetch_add(1, Ordering::Relaxed);
        self.labels.push((name, bytes));
        if let Some(Timestamps::OfPasses(_)) = self.timestamps {
            self.timestamp(self.labels.len() as u32);
        }
    }

    fn queries(&self) -> Option<vk::QueryPool> {
        self.timestamps.map(|timestamps| match timestamps {
            Timestamps::OfPasses(queries) | Timestamps::OfAll(queries) => queries,
        })
    }

    /// The time when everything recorded so far is done.
    fn timestamp(&self, index: u32) {
        if let Some(queries) = self.queries().filter(|_| index < MAX_TIMESTAMPS) {
            let stage = vk::PipelineStageFlags2::ALL_COMMANDS;
            // SAFETY: the query was reset when the recording began.
            unsafe {
                self.shared.device.cmd_write_timestamp2(self.commands, stage, queries, index);
            }
        }
    }
}
