//! Commands whose output has no reader: they do their work all the same.
#![cfg(unix)]

use std::fs::File;
use std::net::{TcpListener, TcpStream};
use std::process::Output;

use nightsplat::gpu::testing::not_run;

use crate::common::command::{Folder, command, exists};
use crate::common::prelude::*;
use crate::fixture;

/// What standard error is; standard output is a pipe without a reader then.
#[derive(Clone, Copy, Debug)]
enum StandardError {
    Read,
    ClosedPipe,
    Full,
    GoneTerminal,
}

/// Every command that writes files and needs no other program, and whether it warns.
const COMMANDS: [(&str, bool); 14] = [
    ("train @set --out @out/run --steps 3 --plan none --view 127.0.0.1:0", true),
    ("eval @run --report @out/eval.html", true),
    ("sweep @set --out @out/sweep --curves linear --steps 2 --sh-degree 0", false),
    ("render @run --split test --out @out/renders", false),
    ("compare @run @run --report @out/compared.html", false),
    ("edit @run/model.ply --up 0,-1,0 --out @out/edited.ply", false),
    ("export @run --format spz --out @out/model.spz", false),
    ("diagnose @set --plan @out/plan.toml", false),
    ("tone apply @set --curve ap3 --out @out/toned", false),
    ("tone list --plot @out/curves.svg", false),
    ("synth @out/set --views 3 --width 16 --height 16", false),
    ("vary @set --out @out/varied", false),
    ("man @out/man", false),
    ("edit @run/absent.ply --up 0,-1,0 --out @out/edited.ply", false),
];

fn run(arguments: &str, error: StandardError) -> Output {
    let mut command = command(arguments);
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    match error {
        StandardError::Read => return command.output().unwrap(),
        StandardError::ClosedPipe => command.stderr(writer.try_clone().unwrap()),
        StandardError::Full => {
            command.stderr(File::options().write(true).open("/dev/full").unwrap())
        }
        StandardError::GoneTerminal => {
            let script = "import os, pty, sys; master, terminal = pty.openpty(); os.dup2(terminal, 2); \
                          os.close(master); os.close(terminal); os.execv(sys.argv[1], sys.argv[1:])";
            let mut python = Command::new("python3");
            python.args(["-c", script]).arg(command.get_program()).args(command.get_args());
            let set = command.get_envs().filter_map(|(name, value)| Some((name, value?)));
            python.envs(set);
            command = python;
            &mut command
        }
    };
    command.stdout(writer).spawn().unwrap().wait_with_output().unwrap()
}

/// The files below a folder, with the bytes of those that have no times in them.
fn files(folder: &Path, inside: &str, found: &mut BTreeMap<String, Vec<u8>>) {
    for entry in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap()) {
        let name = format!("{inside}/{}", entry.file_name().to_str().unwrap());
        if entry.path().is_dir() {
            files(&entry.path(), &name, found);
            continue;
        }
        let is_same = [".ply", ".spz", ".png", ".svg", ".toml", ".1"];
        let is_same = is_same.iter().any(|ending| name.ends_with(ending));
        let bytes = if is_same { fs::read(entry.path()).unwrap() } else { vec![] };
        found.insert(name, bytes);
    }
}

#[test]
fn commands_that_nobody_reads_write_the_same_files_and_end_with_the_same_code() {
    let folder = Folder::empty();
    let [run_folder, out] = ["run", "out"].map(|name| folder.path(name));
    folder.succeed("synth @set --views 9 --width 48 --height 36");
    let done = |arguments: &str, error: StandardError| {
        fs::create_dir(&out).unwrap();
        let output = run(&folder.named(arguments), error);
        let mut found = BTreeMap::new();
        files(&out, "", &mut found);
        if !run_folder.exists() {
            fs::rename(out.join("run"), &run_folder).unwrap();
        }
        fs::remove_dir_all(&out).unwrap();
        (output.status.code(), found, String::from_utf8_lossy(&output.stderr).into_owned())
    };
    for (arguments, warns) in COMMANDS {
        let (code, expected, told) = done(arguments, StandardError::Read);
        assert_eq!(code == Some(0), !expected.is_empty(), "{arguments}: {told}");
        assert!(!warns || told.contains("WARN"), "{arguments} has no warning: {told}");
        let others = [StandardError::Full, StandardError::GoneTerminal];
        let others = others.into_iter().filter(|_| warns);
        for error in std::iter::once(StandardError::ClosedPipe).chain(others) {
            if matches!(error, StandardError::GoneTerminal) && !exists("python3") {
                not_run("python3", "it is not installed");
                continue;
            }
            let (unread, found, _) = done(arguments, error);
            let names =
                |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
            assert_eq!((unread, names(&found)), (code, names(&expected)), "{arguments}, {error:?}");
            assert!(found == expected, "{arguments}, {error:?}: other bytes");
        }
    }
}

#[test]
fn a_page_is_served_though_its_address_cannot_be_told() {
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut view = fixture().command(&format!("view @run/model.ply --listen {}", free.port()));
    let mut view = view.stdout(Stdio::null()).stderr(writer).spawn().unwrap();
    let begin = Instant::now();
    while TcpStream::connect(free).is_err() && begin.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(50));
    }
    // It tells the address once it listens.
    std::thread::sleep(Duration::from_millis(500));
    let ended = view.try_wait().unwrap();
    view.kill().unwrap();
    view.wait().unwrap();
    assert_eq!(ended, None);
}
