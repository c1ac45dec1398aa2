//! Checked recordings: each pass runs alone, and its result is compared with that of its CPU reference on the same
//! buffers.
//!
//! A pass works on the device's results of earlier passes, so a difference is reported where it arises. This is slow by
//! design: it is for tests, `nightsplat check` and drivers.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::thread::{self, ThreadId};

use ash::vk;

use super::check::Versions;
use super::recorder::{ObservedPass, PassObserver};
use super::submission::Record;
#[cfg(debug_assertions)]
use super::testing;
use super::{
    Binding, Bound, CheckReport, CheckedPass, Difference, Download, Gpu, GpuShared, Queue,
    Recorder, lock,
};
use crate::Result;

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

/// The state for running a recorder's passes one by one.
#[derive(Debug)]
pub(super) struct Checked<'g> {
    queue: &'g Queue,
    pool: vk::CommandPool,
    recording: &'g str,
    report: CheckReport,
    /// An integer differs: a kernel that uses it as an index may leave its buffers.
    has_wrong_integers: bool,
}

impl Gpu {
    /// Runs `work` and checks every pass that this thread submits to this device meanwhile: each runs alone, and all
    /// that it writes is compared with its reference on the same buffers. The device's results are kept, so the outcome
    /// is that of an unchecked run, bit for bit. Not checked: recordings of a host ([`Gpu::record_into`]) and profiled
    /// ones.
    #[cfg(feature = "train")]
    pub fn checked<R>(&self, work: impl FnOnce() -> R) -> (R, CheckReport) {
        let scope = CheckedScope { checks: &self.shared.checks, outer: self.shared.checks.take() };
        scope.checks.put(CheckReport::default());
        let result = work();
        (result, scope.end())
    }
}

/// While it lives, this thread's submissions are checked; a panic of the work ends that too.
struct CheckedScope<'a> {
    checks: &'a Checks,
    /// The report of an enclosing check.
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

impl GpuShared {
    /// Records and runs each pass on its own; returns the timeline value of the last. On failure too, the report has
    /// the passes that ran.
    pub(super) fn record_checked(
        self: &Arc<Self>,
        queue: &Queue,
        pool: vk::CommandPool,
        value: u64,
        recording: &str,
        record: Record<'_>,
    ) -> Result<u64> {
        let report = self.checks.take().unwrap_or_default();
        let mut checked = Checked { queue, pool, recording, report, has_wrong_integers: false };
        let done = checked.run(self, value, record);
        self.checks.put(checked.report);
        done
    }
}

impl Checked<'_> {
    /// Records and runs; returns the timeline value of the last submission.
    fn run(&mut self, shared: &Arc<GpuShared>, value: u64, record: Record<'_>) -> Result<u64> {
        let mut recorder = Recorder::new(shared, self.pool, value, None)?;
        recorder.observer = Some(self);
        shared.with_uploads(&mut recorder, record)?;
        if let Some(observer) = recorder.observer.take() {
            observer.run_recorded(&mut recorder, "copies")?;
        }
        Ok(recorder.value - 1)
    }
}

impl PassObserver for Checked<'_> {
    /// Runs what was recorded before, then the pass alone, then its reference, and compares.
    fn pass(&mut self, recorder: &mut Recorder<'_>, pass: &ObservedPass<'_>) -> Result<()> {
        let ObservedPass { objects, params, bound, threads, reference: reference_of } = *pass;
        let (interface, kernel) = (objects.interface, objects.interface.name);
        let before = copies(recorder, interface.bindings, bound, |_| true)?;
        #[cfg(debug_assertions)]
        let params = &testing::with_defect_of(kernel, params);
        recorder.record_dispatch(objects, params, bound, threads)?;
        let device = copies(recorder, interface.bindings, bound, |binding| binding.writable)?;
        self.run_recorded(recorder, kernel)?;

        let workgroups =
            recorder.workgroups(interface, threads).iter().map(|&n| n as usize).product();
        let recording = self.recording.to_owned();
        let mut pass = CheckedPass { recording, kernel, error: None, difference: None };
        if !self.has_wrong_integers {
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
                self.has_wrong_integers |= !binding.is_float;
                pass.difference.get_or_insert(Difference {
                    pass: self.report.passes.len(),
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
        self.report.passes.push(pass);
        Ok(())
    }

    /// Submits the recording so far, waits for it, and starts a new one under the pass's name, so that a lost device is
    /// attributed to it.
    fn run_recorded(&mut self, recorder: &mut Recorder<'_>, pass: &str) -> Result<()> {
        let shared = recorder.shared();
        recorder.finish();
        shared.submit(self.queue, recorder.commands, recorder.value, pass)?;
        shared.wait(recorder.value)?;
        recorder.commands = shared.begin(self.pool)?;
        recorder.value += 1;
        shared.last_submission.store(recorder.value, Ordering::Release);
        recorder.barrier();
        Ok(())
    }
}

/// Records copies of what the pass binds.
fn copies(
    recorder: &mut Recorder<'_>,
    bindings: &[Binding],
    bound: &[Bound],
    wanted: impl Fn(&Binding) -> bool,
) -> Result<Vec<Download<u32>>> {
    let wanted = bindings.iter().zip(bound).filter(|(binding, _)| wanted(binding));
    wanted.map(|(binding, bound)| recorder.download_bound(binding.name, *bound)).collect()
}

fn wait(downloads: Vec<Download<u32>>) -> Result<Vec<Vec<u32>>> {
    downloads.into_iter().map(Download::wait).collect()
}
