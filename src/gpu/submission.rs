//! Submits recorded work and waits for it.

use std::sync::atomic::Ordering;
use std::sync::{Arc, MutexGuard};
use std::thread;

use ash::vk;

use super::recorder::{MAX_TIMESTAMPS, Timestamps};
use super::{Gpu, GpuShared, Queue, Recorder, Retired, lock};
use crate::{Error, Result};

/// A closure that records into a command buffer.
pub(super) type Record<'a> = Box<dyn FnOnce(&mut Recorder<'_>) -> Result<()> + 'a>;

/// Work in flight.
#[derive(Debug)]
pub struct Submission {
    shared: Arc<GpuShared>,
    value: u64,
}

/// The time of one pass on the device.
#[derive(Clone, Copy, Debug)]
pub struct PassTime {
    /// The kernel.
    pub name: &'static str,
    /// Milliseconds on the device.
    pub milliseconds: f64,
    /// Bytes of the buffers that it binds: what it moves if it reads or writes each element once.
    pub bytes: u64,
}

impl Submission {
    /// Blocks until the work is done.
    pub fn wait(&self) -> Result<()> {
        self.shared.wait(self.value)
    }
}

/// The queue, held by the thread that records.
struct Recording<'a> {
    shared: &'a GpuShared,
    queue: MutexGuard<'a, Queue>,
}

impl GpuShared {
    pub(super) fn refuse_nested(&self, label: &str) -> Result<()> {
        match lock(&self.progress).recorded_here() {
            Some(outer) => Err(Error::Usage(format!(
                "`{label}` cannot be submitted while `{outer}` is recorded; do it before or after that"
            ))),
            None => Ok(()),
        }
    }

    /// Locks the queue; refuses where this thread has it already, which would deadlock, and on a device that only
    /// records.
    fn begin_recording(&self, label: &str) -> Result<Recording<'_>> {
        self.refuse_nested(label)?;
        if self.host.as_ref().is_some_and(|host| host.is_record_only) {
            return Err(Error::Usage(format!(
                "`{label}` needs a submission, which a record-only device does not make; lend the queue with a lock"
            )));
        }
        let queue = lock(&self.queue);
        lock(&self.progress).recording = Some((thread::current().id(), label.to_owned()));
        Ok(Recording { shared: self, queue })
    }
}

impl Drop for Recording<'_> {
    fn drop(&mut self) {
        lock(&self.shared.progress).recording = None;
    }
}

impl Gpu {
    /// Records passes and submits them; does not wait.
    ///
    /// The queue is locked while `record` runs: other threads that submit wait. Calls that submit themselves, such as
    /// [`Gpu::write`], [`Gpu::zeros`] or [`crate::splats::render::Renderer::reserve`], must come before or after the
    /// recording.
    #[doc(hidden)]
    pub fn submit(
        &self,
        label: &str,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<Submission> {
        self.record_and_submit(label, None, Box::new(record)).map(|(submission, _)| submission)
    }

    /// Records passes, submits them and waits; returns what `record` returns.
    ///
    /// # Errors
    /// The error of `record` (nothing is submitted then), this thread is recording already, or the device was lost.
    pub fn run<R>(
        &self,
        label: &str,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<R>,
    ) -> Result<R> {
        let mut result = None;
        let submission = self.submit(label, |pass| {
            result = Some(record(pass)?);
            Ok(())
        })?;
        submission.wait()?;
        result.ok_or_else(|| Error::Usage(format!("`{label}` was not recorded")))
    }

    /// As [`Gpu::run`], and measures the time of each pass.
    #[doc(hidden)]
    pub fn profile(
        &self,
        label: &str,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<Vec<PassTime>> {
        self.timed(label, Timestamps::OfPasses, Box::new(record))
    }

    /// As [`Gpu::run`], and measures the milliseconds from the start of the first pass to the end of the last, with
    /// nothing between the passes that a run without measurement lacks.
    #[doc(hidden)]
    pub fn profile_whole(
        &self,
        label: &str,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<f64> {
        let times = self.timed(label, Timestamps::OfAll, Box::new(record))?;
        Ok(times.iter().map(|time| time.milliseconds).sum())
    }

    fn timed(
        &self,
        label: &str,
        timestamps: fn(vk::QueryPool) -> Timestamps,
        record: Record<'_>,
    ) -> Result<Vec<PassTime>> {
        let shared = &self.shared;
        if shared.properties.timestamp_bits == 0 {
            let (device, feature) =
                (shared.properties.name.clone(), "timestampValidBits > 0".to_owned());
            return Err(Error::MissingFeature { device, feature });
        }
        let info = vk::QueryPoolCreateInfo::default()
            .query_type(vk::QueryType::TIMESTAMP)
            .query_count(MAX_TIMESTAMPS);
        // SAFETY: the device is live; the pool is retired below whatever happens.
        let queries = unsafe { shared.device.create_query_pool(&info, shared.callbacks()) }
            .map_err(|result| shared.error("vkCreateQueryPool", result))?;
        let timestamps = timestamps(queries);
        let times =
            self.record_and_submit(label, Some(timestamps), record).and_then(|(done, labels)| {
                done.wait()?;
                match timestamps {
                    Timestamps::OfPasses(_) => self.pass_times(queries, &labels),
                    Timestamps::OfAll(_) => self.pass_times(queries, &[("all", 0)]),
                }
            });
        shared.retire(Retired::Queries(queries));
        times
    }

    fn pass_times(
        &self,
        queries: vk::QueryPool,
        labels: &[(&'static str, u64)],
    ) -> Result<Vec<PassTime>> {
        let mut ticks = vec![0u64; (labels.len() + 1).min(MAX_TIMESTAMPS as usize)];
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        // SAFETY: as many timestamps were written.
        unsafe { self.shared.device.get_query_pool_results(queries, 0, &mut ticks, flags) }
            .map_err(|result| self.shared.error("vkGetQueryPoolResults", result))?;
        let period = f64::from(self.shared.properties.timestamp_period) * 1e-6;
        // The bits beyond are undefined, and the valid ones wrap around.
        let counting = u64::MAX >> (64 - self.shared.properties.timestamp_bits.clamp(1, 64));
        let milliseconds =
            |pair: &[u64]| (pair[1].wrapping_sub(pair[0]) & counting) as f64 * period;
        let times = labels.iter().zip(ticks.windows(2));
        let time =
            |(&(name, bytes), pair)| PassTime { name, milliseconds: milliseconds(pair), bytes };
        Ok(times.map(time).collect())
    }

    fn record_and_submit(
        &self,
        label: &str,
        timestamps: Option<Timestamps>,
        record: Record<'_>,
    ) -> Result<(Submission, Vec<(&'static str, u64)>)> {
        let shared = &self.shared;
        let recording = shared.begin_recording(label)?;
        let fail = |call| move |result| shared.error(call, result);
        let pool_info = vk::CommandPoolCreateInfo::default()
            .flags(vk::CommandPoolCreateFlags::TRANSIENT)
            .queue_family_index(shared.family);
        // SAFETY: the device is live; the pool is retired when this function ends, after its last submission.
        let pool = unsafe { shared.device.create_command_pool(&pool_info, shared.callbacks()) }
            .map_err(fail("vkCreateCommandPool"))?;
        let value = lock(&shared.progress).submitted + 1;
        // From here on, a dropped object may be in this recording.
        shared.last_submission.store(value, Ordering::Release);
        let queue = &recording.queue;
        let submitted = self.record_with(queue, pool, value, label, timestamps, record);
        // Where nothing was submitted, objects dropped meanwhile wait for the next submission, which has the same
        // value.
        shared.retire(Retired::Commands(pool));
        submitted.map(|(value, labels)| (Submission { shared: Arc::clone(shared), value }, labels))
    }

    /// Records and submits; returns the timeline value of the last submission and the recording.
    fn record_with(
        &self,
        queue: &Queue,
        pool: vk::CommandPool,
        value: u64,
        label: &str,
        timestamps: Option<Timestamps>,
        record: Record<'_>,
    ) -> Result<(u64, Vec<(&'static str, u64)>)> {
        let shared = &self.shared;
        if timestamps.is_none() && shared.checks.are_on() {
            let last = shared.record_checked(queue, pool, value, label, record)?;
            return Ok((last, vec![]));
        }
        let mut recorder = Recorder::new(shared, pool, value, timestamps)?;
        shared.with_uploads(&mut recorder, record)?;
        recorder.finish();
        let parts = std::mem::take(&mut recorder.parts);
        parts.into_iter().try_for_each(|commands| shared.enqueue(queue, commands, None))?;
        shared.submit(queue, recorder.commands, value, label)?;
        tracing::trace!(label, value, "submitted");
        Ok((value, recorder.labels))
    }
}

impl GpuShared {
    /// A command buffer that is being recorded.
    pub(super) fn begin(&self, pool: vk::CommandPool) -> Result<vk::CommandBuffer> {
        let fail = |call| move |result| self.error(call, result);
        let allocate =
            vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
        let begin = vk::CommandBufferBeginInfo::default()
            .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: pool and command buffer are live and used by this thread alone.
        unsafe {
            let commands = self
                .device
                .allocate_command_buffers(&allocate)
                .map_err(fail("vkAllocateCommandBuffers"))?[0];
            self.device
                .begin_command_buffer(commands, &begin)
                .map_err(fail("vkBeginCommandBuffer"))?;
            Ok(commands)
        }
    }

    /// Ends a recording and hands it to the queue; the timeline reaches `value` when it is done.
    pub(super) fn submit(
        &self,
        queue: &Queue,
        commands: vk::CommandBuffer,
        value: u64,
        label: &str,
    ) -> Result<()> {
        #[cfg(debug_assertions)]
        if self.faults.loses_submission() {
            return Err(self.error("vkQueueSubmit2", vk::Result::ERROR_DEVICE_LOST));
        }
        self.enqueue(queue, commands, Some(value))?;
        let mut progress = lock(&self.progress);
        progress.submitted = value;
        progress.labels.insert(value, label.to_owned());
        Ok(())
    }

    /// Ends a command buffer and hands it to the queue; the timeline reaches `value`, where there is one, when all up
    /// to it are done.
    fn enqueue(
        &self,
        queue: &Queue,
        commands: vk::CommandBuffer,
        value: Option<u64>,
    ) -> Result<()> {
        let fail = |call| move |result| self.error(call, result);
        self.recorded.submits.fetch_add(1, Ordering::Relaxed);
        // SAFETY: recording.
        unsafe { self.device.end_command_buffer(commands) }.map_err(fail("vkEndCommandBuffer"))?;
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let signal = value.map(|value| {
            vk::SemaphoreSubmitInfo::default()
                .semaphore(self.timeline)
                .value(value)
                .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
        });
        let info = [vk::SubmitInfo2::default()
            .command_buffer_infos(&commands)
            .signal_semaphore_infos(signal.as_slice())];
        // SAFETY: the queue is locked, the command buffer recorded and not touched again.
        let submit = || unsafe { self.device.queue_submit2(queue.raw, &info, vk::Fence::null()) };
        match &self.host {
            Some(host) => host.with_queue(queue.raw, submit),
            None => submit(),
        }
        .map_err(fail("vkQueueSubmit2"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceChoice;

    #[test]
    fn a_device_without_timestamps_runs_and_says_that_it_cannot_be_timed() {
        let mut gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        Arc::get_mut(&mut gpu.shared).unwrap().properties.timestamp_bits = 0;
        gpu.run("a pass", |_| Ok(())).unwrap();
        let message = gpu.profile("a pass", |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("lacks timestampValidBits > 0"), "{message}");
        assert!(!message.contains('\n'), "{message}");
    }
}
