//! Resources of a run: wall-clock time, processor time, energy and memory, as far as the system reports them.
//!
//! Processor time and memory are those of the process (`/proc/self`, Linux). Energy is that of the whole machine during
//! the run, including idle power: the packages and memory of `/sys/class/powercap` (RAPL), and GPUs whose driver counts
//! microjoules.

use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::Serialize;

/// Resources of the steps of a run; `None` if the system does not report them, or an earlier process did a part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ResourceUsage {
    /// Wall-clock time.
    #[serde(skip)]
    pub seconds: f64,
    /// Time on all processors, user and system.
    pub processor_seconds: Option<f64>,
    /// Energy of the whole machine.
    pub joules: Option<f64>,
    /// Peak device memory of buffers.
    pub device_bytes: u64,
    /// Peak memory of the process; on a software device, this includes the device's buffers.
    pub host_bytes: Option<u64>,
}

/// Sums the resources of pieces of work.
#[derive(Debug)]
pub(super) struct ResourceMeter {
    counters: Vec<Counter>,
    spent: ResourceUsage,
}

impl ResourceMeter {
    /// Begins after `seconds_before` of an earlier process, whose other figures are unknown.
    pub(super) fn new(seconds_before: f64) -> Self {
        let is_whole = seconds_before == 0.0;
        let counters = Counter::all(Path::new("/sys"));
        let joules = (is_whole && !counters.is_empty()).then_some(0.0);
        let processor_seconds = processor_seconds().filter(|_| is_whole).map(|_| 0.0);
        let spent = ResourceUsage {
            seconds: seconds_before,
            processor_seconds,
            joules,
            ..ResourceUsage::default()
        };
        Self { counters, spent }
    }

    /// Runs `work` and adds its resources.
    pub(super) fn measure<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let energy = |meter: &Self| meter.counters.iter().map(Counter::read).collect::<Vec<_>>();
        let (joules, processor, begin) = (energy(self), processor_seconds(), Instant::now());
        let done = work();
        self.spent.seconds += begin.elapsed().as_secs_f64();
        let sum = |sum: Option<f64>, more: Option<f64>| Some(sum? + more?);
        let processor = processor_seconds().zip(processor).map(|(now, then)| now - then);
        self.spent.processor_seconds = sum(self.spent.processor_seconds, processor);
        let taken = self.counters.iter().zip(joules.into_iter().zip(energy(self)));
        let taken = taken.map(|(counter, (then, now))| Some(counter.between(then?, now?)));
        self.spent.joules = sum(self.spent.joules, taken.sum());
        done
    }

    /// The resources so far, and the peak memory of the process.
    pub(super) fn spent(&self, device_bytes: u64) -> ResourceUsage {
        ResourceUsage { device_bytes, host_bytes: host_bytes(), ..self.spent }
    }
}

/// The energy counters of this machine; empty if there are none or only administrators may read them.
pub fn energy_counters() -> Vec<String> {
    Counter::all(Path::new("/sys")).into_iter().map(|counter| counter.name).collect()
}

/// A file that counts microjoules.
#[derive(Debug)]
struct Counter {
    name: String,
    file: PathBuf,
    /// The value at which it wraps around, microjoules; `None` if it never does.
    range: Option<f64>,
}

impl Counter {
    /// The readable counters below `sys`, each domain once.
    fn all(sys: &Path) -> Vec<Self> {
        let mut counters: Vec<Self> = vec![];
        for zone in folders(&sys.join("class/powercap")) {
            let name = text(&zone.join("name")).unwrap_or_default();
            // Cores are a part of their package, and psys contains the packages.
            let is_counted = name.starts_with("package") || name == "dram";
            let parent = zone.file_name().unwrap_or_default().to_string_lossy();
            let package = parent.split(':').nth(1).unwrap_or_default();
            let name = if name == "dram" { format!("{name}-{package}") } else { name };
            if is_counted && counters.iter().all(|counter| counter.name != name) {
                let range = number(&zone.join("max_energy_range_uj"));
                counters.push(Self { name, file: zone.join("energy_uj"), range });
            }
        }
        for card in folders(&sys.join("class/drm")) {
            let name = card.file_name().unwrap_or_default().to_string_lossy().into_owned();
            // Connectors of a card, such as card0-DP-1, are entries too.
            let monitors =
                if name.contains('-') { vec![] } else { folders(&card.join("device/hwmon")) };
            let files = monitors.into_iter().map(|monitor| monitor.join("energy1_input"));
            counters.extend(files.map(|file| Self { name: name.clone(), file, range: None }));
        }
        counters.retain(|counter| counter.read().is_some());
        counters
    }

    fn read(&self) -> Option<f64> {
        number(&self.file)
    }

    /// Joules between two readings, with at most one wrap-around of the counter.
    fn between(&self, then: f64, now: f64) -> f64 {
        let wraps = if now < then { self.range.unwrap_or(0.0) } else { 0.0 };
        1e-6 * (now + wraps - then).max(0.0)
    }
}

/// Processor time of this process so far.
fn processor_seconds() -> Option<f64> {
    // Linux reports hundredths of a second, whatever the kernel's tick rate.
    const TICKS: f64 = 100.0;
    let text = text(Path::new("/proc/self/stat"))?;
    // The program's name is in parentheses and may contain anything; after it, the times are fields 12 and 13.
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / TICKS)
}

/// The most that this process has had in memory.
fn host_bytes() -> Option<u64> {
    let text = text(Path::new("/proc/self/status"))?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// What a folder holds, in the order of the names.
fn folders(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn text(file: &Path) -> Option<String> {
    std::fs::read_to_string(file).ok().map(|text| text.trim().to_owned())
}

fn number(file: &Path) -> Option<f64> {
    text(file)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn energy_is_that_of_packages_memory_and_cards_each_once() {
        let sys = tempfile::tempdir().unwrap();
        let zone = |folder: &str, name: &str, energy: &str| {
            let folder = sys.path().join("class/powercap").join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("name"), format!("{name}\n")).unwrap();
            std::fs::write(folder.join("energy_uj"), energy).unwrap();
            std::fs::write(folder.join("max_energy_range_uj"), "1000000\n").unwrap();
        };
        zone("intel-rapl:0", "package-0", "900000\n");
        zone("intel-rapl:0:0", "core", "5\n");
        zone("intel-rapl:0:1", "dram", "7\n");
        zone("intel-rapl:1", "psys", "9\n");
        zone("intel-rapl-mmio:0", "package-0", "900000\n");
        zone("intel-rapl:2", "package-1", "not for you");
        let card = sys.path().join("class/drm/card0/device/hwmon/hwmon3");
        std::fs::create_dir_all(&card).unwrap();
        std::fs::write(card.join("energy1_input"), "12").unwrap();
        std::fs::create_dir_all(sys.path().join("class/drm/card0-DP-1")).unwrap();
        let counters = Counter::all(sys.path());
        let names: Vec<&str> = counters.iter().map(|counter| counter.name.as_str()).collect();
        assert_eq!(names, ["package-0", "dram-0", "card0"]);
        // The counter begins anew at its range.
        let package = &counters[0];
        assert!((package.between(900_000.0, 100_000.0) - 0.2).abs() < 1e-12);
        assert!((package.between(1e5, 3e5) - 0.2).abs() < 1e-12);
        assert!(Counter::all(Path::new("/nowhere")).is_empty());
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn work_takes_time_and_memory_and_idling_takes_no_processor() {
        let mut meter = ResourceMeter::new(0.0);
        meter.measure(|| std::thread::sleep(std::time::Duration::from_millis(60)));
        let idle = meter.spent(7);
        assert!(idle.seconds >= 0.06 && idle.processor_seconds.unwrap() < 60.0, "{idle:?}");
        assert!(idle.device_bytes == 7 && idle.host_bytes.unwrap() > 1 << 20, "{idle:?}");
        let begin = processor_seconds().unwrap();
        meter.measure(|| while processor_seconds().unwrap() < begin + 0.05 {});
        let busy = meter.spent(7).processor_seconds.unwrap() - idle.processor_seconds.unwrap();
        assert!(busy >= 0.04, "{busy}");
        assert_eq!(
            ResourceMeter::new(1.0).spent(0).processor_seconds,
            None,
            "another process took a part"
        );
    }
}
