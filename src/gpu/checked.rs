//! Checked recordings: every pass alone, and what it leaves against what its CPU reference makes of the same buffers.
//!
//! A pass works on what the device made of the passes before it, so a difference is named where it arises. Slow, and
//! meant to be: it is for tests, `nightsplat check` and drivers.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::thread::{self, ThreadId};

use ash::vk;

use super::check::Versions;
use super::pipeline::Objects;
use super::submission::Record;
use super::{
    Binding, Bound, CheckReport, CheckedPass, Difference, Download, Gpu, Pipeline, Queue, Recorder,
    Reference, Shared, Threads, Tolerance, lock, testing,
};
use crate::Result;

/// Makes of the words of a pass's buffers what its reference does, and gives the tolerances from other such words.
type ReferenceOf<'a> = dyn Fn(&mut [Vec<u32>], &mut [Vec<u32>]) -> Vec<Tolerance> + 'a;

/// The reports of the threads whose submissions are checked.
#[derive(Debug, Default)]
pub(super) struct Checks(Mutex<HashMap<ThreadId, CheckReport>>);

impl Checks {
    /// This thread's report, while one of its submissions adds to it.
    fn take(&self) -> Option<CheckReport> {
        lock(&self.0).remove(&thread::current().id())
    }

    /// Whether this thread's submissions are checked.
    pub(super) fn are_on(&self) -> bool {
        lock(&self.0).contains_key(&thread::current().id())
    }

    fn put(&self, report: CheckReport) {
        lock(&self.0).insert(thread::current().id(), report);
    }
}

/// What a recorder needs to run its passes one by one.
#[derive(Debug)]
pub(super) struct Checked<'g> {
    queue: &'g Queue,
    pool: vk::CommandPool,
    recording: &'g str,
    report: CheckReport,
    /// An integer differs: whoever takes it for an index may leave its buffers.
    has_wrong_integers: bool,
}

impl Gpu {
    /// Does `work`, and checks every pass that it submits to this device from this thread: runs it alone and compares
    /// all that it writes with what its reference makes of the same buffers. The device's results stay, so whatever is
    /// done comes out as it would unchecked, bit for bit. What a host records itself ([`Gpu::record_into`]) and what is
    /// profiled is not checked.
    pub fn checked<R>(&self, work: impl FnOnce() -> R) -> (R, CheckReport) {
        let scope = CheckedScope { checks: &self.shared.checks, outer: self.shared.checks.take() };
        scope.checks.put(CheckReport::default());
        let result = work();
        (result, scope.end())
    }
}

/// While it lives, this thread's submissions are checked; also where the work panics, checking ends with it.
struct CheckedScope<'a> {
    checks: &'a Checks,
    /// The report of the work around it.
    outer: Option<CheckReport>,
}

impl CheckedScope<'_> {
    fn end(mut self) -> CheckReport {
        let report = self.checks.take().unwrap_or_default();
        if let Some(outer) = &mut self.outer {
            outer.extend(report.clone());
        }
        report
    }
}

impl Drop for CheckedScope<'_> {
    fn drop(&mut self) {
        match self.outer.take() {
            Some(outer) => self.checks.put(outer),
            None => drop(self.checks.take()),
        }
    }
}

impl Shared {
    /// Records and runs every pass on its own; gives the timeline value of the last. Whatever comes of it, what ran is
    /// in the report.
    pub(super) fn record_checked(
        self: &Arc<Self>,
        queue: &Queue,
        pool: vk::CommandPool,
        value: u64,
        recording: &str,
        record: Record<'_>,
    ) -> Result<u64> {
        let mut recorder = Recorder::new(self, self.begin(pool)?, value, None);
        let report = self.checks.take().unwrap_or_default();
        let has_wrong_integers = false;
        recorder.checked = Some(Checked { queue, pool, recording, report, has_wrong_integers });
        let done = record(&mut recorder).and_then(|()| recorder.run_what_is_recorded("copies"));
        let value = recorder.value - 1;
        if let Some(checked) = recorder.checked {
            self.checks.put(checked.report);
        }
        done.map(|()| value)
    }
}

impl Recorder<'_> {
    /// Checks a pass, its kernel's types left behind.
    pub(super) fn dispatch_checked<K: Reference>(
        &mut self,
        pipeline: &Pipeline<K>,
        params: &K::Params,
        bound: &[Bound],
        threads: Threads<'_>,
    ) -> Result<()> {
        let mut on_device = *params;
        testing::plant_defect(K::INTERFACE.name, bytemuck::bytes_of_mut(&mut on_device));
        let on_device = bytemuck::bytes_of(&on_device);
        self.run_checked(&pipeline.objects, on_device, bound, threads, &|reference, before| {
            K::run(params, &pipeline.constants, K::slices(reference));
            K::tolerances(params, &pipeline.constants, K::slices(before)).into()
        })
    }

    /// Runs what was recorded before, then the pass alone, then its reference, and compares.
    fn run_checked(
        &mut self,
        pipeline: &Objects,
        params: &[u8],
        bound: &[Bound],
        threads: Threads<'_>,
        reference_of: &ReferenceOf<'_>,
    ) -> Result<()> {
        let (interface, kernel) = (pipeline.interface, pipeline.interface.name);
        let before = self.copies(interface.bindings, bound, |_| true)?;
        self.record_dispatch(pipeline, params, bound, threads)?;
        let device = self.copies(interface.bindings, bound, |binding| binding.writable)?;
        self.run_what_is_recorded(kernel)?;

        let workgroups = self.workgroups(interface, threads).iter().map(|&n| n as usize).product();
        let Some(checked) = &mut self.checked else { return Ok(()) };
        let recording = checked.recording.to_owned();
        let mut pass = CheckedPass { recording, kernel, error: None, difference: None };
        if !checked.has_wrong_integers {
            let mut before = wait(before)?;
            let mut reference = before.clone();
            let tolerances = reference_of(&mut reference, &mut before);
            let written = interface.bindings.iter().zip(&before).zip(&reference);
            let written = written.filter(|((binding, _), _)| binding.writable);
            pass.error = Some(0.0);
            for ((((binding, before), reference), device), tolerance) in
                written.zip(wait(device)?).zip(tolerances)
            {
                let versions =
                    Versions { before, device: &device, reference, is_float: binding.is_float };
                let comparison = versions.compare(&tolerance, workgroups);
                pass.error = pass.error.map(|error: f64| error.max(comparison.error));
                let Some((index, [device, reference, bound])) = comparison.first else { continue };
                checked.has_wrong_integers |= !binding.is_float;
                pass.difference.get_or_insert(Difference {
                    pass: checked.report.passes.len(),
                    kernel,
                    buffer: binding.name,
                    index,
                    device,
                    reference,
                    bound,
                    count: comparison.count,
                });
            }
        }
        checked.report.passes.push(pass);
        Ok(())
    }

    /// Records copies of what the pass binds.
    fn copies(
        &mut self,
        bindings: &[Binding],
        bound: &[Bound],
        wanted: impl Fn(&Binding) -> bool,
    ) -> Result<Vec<Download<u32>>> {
        let wanted = bindings.iter().zip(bound).filter(|(binding, _)| wanted(binding));
        wanted.map(|(binding, bound)| self.download_bound(binding.name, *bound)).collect()
    }

    /// Submits what is recorded, waits for it, and begins anew.
    fn run_what_is_recorded(&mut self, pass: &str) -> Result<()> {
        let shared = self.shared();
        self.finish();
        let Some(checked) = &mut self.checked else { return Ok(()) };
        // Under the pass's name: should the device be lost, it is known where.
        shared.submit(checked.queue, self.commands, self.value, pass)?;
        shared.wait(self.value)?;
        self.commands = shared.begin(checked.pool)?;
        self.value += 1;
        shared.last_use.store(self.value, Ordering::Release);
        self.barrier();
        Ok(())
    }
}

fn wait(downloads: Vec<Download<u32>>) -> Result<Vec<Vec<u32>>> {
    downloads.into_iter().map(Download::wait).collect()
}
