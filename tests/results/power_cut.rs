//! What a power cut leaves: the order in which a run flushes and renames its files, as strace records it.
#![cfg(target_os = "linux")]

use nightsplat::gpu::testing::not_run;

use crate::common::command::command;
use crate::common::prelude::*;

/// What happens to a file of the run, by its name; the folder itself is "".
#[derive(Debug, PartialEq)]
enum Event {
    Written(String),
    Flushed(String),
    Renamed(String, String),
}

/// The events in a trace with the paths of descriptors.
fn events(trace: &str, run: &Path) -> Vec<Event> {
    let name = |path: &str| Some(Path::new(path).strip_prefix(run).ok()?.to_str()?.to_owned());
    let event = |line: &str| {
        let (call, arguments) = line.split_once(' ')?.1.trim_start().split_once('(')?;
        let of_descriptor = || name(arguments.split_once('<')?.1.split_once('>')?.0);
        let mut quoted = arguments.split('"').skip(1).step_by(2);
        match call {
            "fsync" | "fdatasync" => Some(Event::Flushed(of_descriptor()?)),
            "write" | "writev" | "pwrite64" => Some(Event::Written(of_descriptor()?)),
            "rename" | "renameat" | "renameat2" => {
                Some(Event::Renamed(name(quoted.next()?)?, name(quoted.next()?)?))
            }
            _ => None,
        }
    };
    trace.lines().filter_map(event).collect()
}

/// Files by name, each with whether it is on the disk as it is, and whether the folder is.
#[derive(Default)]
struct Disk {
    is_whole: BTreeMap<String, bool>,
    has_names: bool,
}

impl Disk {
    fn apply(&mut self, event: &Event) {
        match event {
            Event::Written(file) => drop(self.is_whole.insert(file.clone(), false)),
            Event::Flushed(file) if file.is_empty() => self.has_names = true,
            Event::Flushed(file) => drop(self.is_whole.insert(file.clone(), true)),
            Event::Renamed(from, to) => {
                let is_whole = self.is_whole.remove(from).unwrap_or_default();
                self.is_whole.insert(to.clone(), is_whole);
                self.has_names = false;
            }
        }
    }

    /// The file is complete, or the run has none.
    fn holds(&self, file: &str) -> bool {
        self.is_whole.get(file).copied().unwrap_or(true)
    }
}

#[test]
fn files_are_on_the_disk_before_what_relies_on_them() {
    let is_there =
        Command::new("strace").args(["-f", "--seccomp-bpf", "-o", "/dev/null", "true"]).status();
    if !is_there.is_ok_and(|status| status.success()) {
        return not_run("strace", "strace is absent or may not trace");
    }
    let workspace = Workspace::new();
    let trace = workspace.path("trace");
    let train = command(&workspace.train("run", "--steps 7 --checkpoint-every 3"));
    let calls = "trace=write,writev,pwrite64,fsync,fdatasync,rename,renameat,renameat2";
    let mut traced = Command::new("strace");
    traced.args(["-f", "-y", "-qq", "-s", "0", "--seccomp-bpf", "-e", calls, "-o"]).arg(&trace);
    traced.arg(train.get_program()).args(train.get_args());
    traced.envs(train.get_envs().filter_map(|(name, value)| Some((name, value?))));
    let output = traced.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let trace = fs::read_to_string(trace).unwrap();
    let events = events(&trace, &workspace.path("run").canonicalize().unwrap());

    let (mut disk, mut checkpoints, mut is_done) = (Disk::default(), 0, false);
    for event in &events {
        if let Event::Renamed(from, to) = event {
            // A generation takes the place of another only when it is whole.
            if to.starts_with("checkpoint") && !to.ends_with(".partial") {
                assert!(disk.holds(from), "{event:?}");
            }
            if to == "checkpoint.safetensors" {
                checkpoints += 1;
                for needed in ["config.toml", "train.csv", "views.csv", "plan.toml"] {
                    assert!(disk.holds(needed), "{needed} before checkpoint {checkpoints}");
                }
            }
            if to == "done.json" {
                is_done = true;
                let missing: Vec<&String> = disk
                    .is_whole
                    .iter()
                    .filter(|(file, is_whole)| !**is_whole && !file.starts_with("done"))
                    .filter(|(file, _)| *file != ".lock")
                    .map(|(file, _)| file)
                    .collect();
                assert!(missing.is_empty() && disk.has_names, "{missing:?}, {}", disk.has_names);
            }
        }
        disk.apply(event);
    }
    assert!(checkpoints >= 2 && is_done, "{checkpoints} checkpoints: {events:?}");
    assert!(disk.holds("done.json") && disk.has_names, "done.json itself");
}
