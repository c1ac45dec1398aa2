//! The live page of `view` and `train --view`, asked as a browser asks and as an attacker does.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::Child;

use crate::common::command::{Folder, json};
use crate::common::prelude::*;
use crate::fixture;

/// A command that serves a page, until it is dropped.
struct Serving {
    process: Child,
    address: SocketAddr,
    token: String,
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Serving {
    fn start(folder: &Folder, arguments: &str) -> Self {
        let mut command = folder.command(arguments);
        let mut process = command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
        let mut lines = BufReader::new(process.stderr.take().unwrap()).lines().map(Result::unwrap);
        let line = lines.find(|line| line.contains("http://")).expect("no address is printed");
        let url = line.split_whitespace().find(|word| word.starts_with("http://")).unwrap();
        let (address, token) = url["http://".len()..].split_once('/').unwrap();
        let serving = Self {
            process,
            address: address.parse().unwrap(),
            token: token.trim_end_matches('/').to_owned(),
        };
        // What it writes later must not block it.
        std::thread::spawn(move || lines.for_each(drop));
        serving
    }

    /// Status and body of the answer.
    fn ask(&self, method: &str, path: &str) -> (u16, Vec<u8>) {
        self.ask_raw(method, &format!("/{}/{path}", self.token))
    }

    fn ask_raw(&self, method: &str, path: &str) -> (u16, Vec<u8>) {
        let begin = Instant::now();
        loop {
            // A server whose connections are all taken closes others at once.
            match self.answer(method, path) {
                Some(answer) => return answer,
                None => assert!(begin.elapsed() < Duration::from_secs(60), "no answer to {path}"),
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    fn answer(&self, method: &str, path: &str) -> Option<(u16, Vec<u8>)> {
        let request = format!(
            "{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n",
            self.address
        );
        let answer = self.exchange(request.as_bytes()).ok()?;
        let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n")?;
        let head = std::str::from_utf8(&answer[..end]).unwrap();
        says(head, &["no-store", "default-src 'none'"]);
        Some((head[9..12].parse().unwrap(), answer[end + 4..].to_vec()))
    }

    fn exchange(&self, request: &[u8]) -> std::io::Result<Vec<u8>> {
        let mut stream = TcpStream::connect(self.address)?;
        stream.set_read_timeout(Some(Duration::from_secs(60)))?;
        stream.write_all(request)?;
        let mut answer = vec![];
        stream.read_to_end(&mut answer)?;
        Ok(answer)
    }

    fn state(&self) -> Value {
        let (status, body) = self.ask("GET", "state");
        assert_eq!(status, 200);
        json(body)
    }

    /// The first state for which `holds`.
    fn until(&self, what: &str, holds: impl Fn(&Value) -> bool) -> Value {
        let begin = Instant::now();
        loop {
            let state = self.state();
            if holds(&state) {
                return state;
            }
            assert!(begin.elapsed() < Duration::from_secs(120), "never {what}: {state}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// The most memory that the process has used, in KiB.
    #[cfg(target_os = "linux")]
    fn peak_memory(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    }
}

const LONG: &str = "--steps 20000 --seed 3 --sh-degree 1 --curve ap3 --model plain --progress none";

#[test]
fn the_page_of_a_run_shows_model_photographs_and_targets() {
    let serving = Serving::start(fixture(), "view @run --listen 0");
    let (status, page) = serving.ask("GET", "");
    let page = String::from_utf8(page).unwrap();
    assert!(status == 200 && page.contains("picture/0/photograph"), "{page}");
    let state = serving.state();
    for (key, value) in
        [("phase", Value::from("finished")), ("step", 40.into()), ("model", 1.into())]
    {
        assert_eq!(state[key], value);
    }
    assert_eq!(state["canControl"], false);
    let (_, model) = serving.ask("GET", "model");
    assert_eq!(u64::from(u32::from_le_bytes(*model.first_chunk().unwrap())), state["gaussians"]);
    for kind in ["photograph", "target", "reference"] {
        let (status, jpeg) = serving.ask("GET", &format!("picture/0/{kind}"));
        assert!(status == 200 && jpeg.starts_with(&[0xff, 0xd8]), "{kind}: {status}");
    }
    for (method, path) in [
        ("GET", "picture/9/photograph"),
        ("GET", "picture/0/secret"),
        ("GET", "picture/-1/photograph"),
        ("GET", "../run/config.toml"),
        ("GET", "picture/..%2f..%2fconfig.toml/photograph"),
        ("POST", "do/stop"),
        ("GET", "do/stop"),
        ("DELETE", "model"),
    ] {
        assert_eq!(serving.ask(method, path).0, 404, "{method} {path}");
    }
}

#[test]
fn a_page_follows_a_model_file_and_a_dataset() {
    let folder = Folder::empty();
    folder.write("model.ply", fixture().model("run"));
    let serving = Serving::start(&folder, "view @model.ply --listen 0");
    assert_eq!(serving.until("a model", |state| state["model"] == 1)["phase"], "model");
    fs::remove_file(folder.path("model.ply")).unwrap();
    let gone = serving.until("a problem", |state| !state["problem"].is_null());
    assert!(gone["problem"].as_str().unwrap().contains("is gone"), "{gone}");
    assert_eq!(serving.ask("GET", "model").0, 200);

    let serving = Serving::start(fixture(), "view @set --listen 0");
    let state = serving.until("points", |state| state["model"] == 1);
    assert_eq!(state["phase"], "model");
    assert_eq!(serving.ask("GET", "picture/1/target").0, 200);
}

#[test]
fn a_training_is_paused_saved_and_stopped_from_its_page() {
    let run = fixture().path("stopped-from-page");
    let train = format!("train @set --out @stopped-from-page {LONG} --view 127.0.0.1:0");
    let mut serving = Serving::start(fixture(), &train);
    let first = serving.until("a model", |state| state["model"].as_u64() > Some(0));
    assert_eq!((&first["phase"], &first["canControl"]), (&"training".into(), &true.into()));
    assert!(first["modelStep"].is_u64(), "{first}");
    // The first view is a test view, whose dark photograph no training loads.
    for (view, kind) in [(0, "photograph"), (0, "target"), (0, "reference"), (1, "target")] {
        let (status, jpeg) = serving.ask("GET", &format!("picture/{view}/{kind}"));
        assert!(status == 200 && jpeg.starts_with(&[0xff, 0xd8]), "{view} {kind}: {status}");
    }
    assert_eq!(serving.ask("POST", "do/pause").0, 200);
    let mut paused = serving.until("paused", |state| state["phase"] == "paused");
    // The steps under way are done.
    loop {
        std::thread::sleep(Duration::from_millis(500));
        let again = serving.state();
        if again["step"] == paused["step"] {
            break;
        }
        paused = again;
    }
    assert!(!run.join("checkpoint.safetensors").exists());
    assert_eq!(serving.ask("POST", "do/save").0, 200);
    let begin = Instant::now();
    while !run.join("model.ply").exists() {
        assert!(begin.elapsed() < Duration::from_secs(60), "no checkpoint");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(serving.ask("POST", "do/resume").0, 200);
    serving.until("more steps", |state| state["step"].as_u64() > paused["step"].as_u64());
    assert_eq!(serving.ask("POST", "do/stop").0, 200);
    let stopped = serving.until("stopped", |state| !state["endedBy"].is_null());
    let told = stopped["endedBy"].as_str().unwrap();
    assert!(told.starts_with("stopped after step "), "{told}");
    assert!(told.contains("--resume --finish"), "{told}");
    assert_eq!(serving.process.wait().unwrap().code(), Some(130));
    assert!(run.join("checkpoint.safetensors").exists());
}

#[test]
fn a_training_is_finished_from_its_page_also_while_it_is_paused() {
    let train = format!("train @set --out @finished-from-page {LONG} --view 0");
    let mut serving = Serving::start(fixture(), &train);
    serving.until("a model", |state| state["model"].as_u64() > Some(0));
    assert_eq!(serving.ask("POST", "do/pause").0, 200);
    serving.until("paused", |state| state["phase"] == "paused");
    assert_eq!(serving.ask("POST", "do/finish").0, 200);
    let cooling = serving.until("its last step", |state| state["steps"].as_u64() < Some(20_000));
    assert!(cooling["steps"].as_u64() > cooling["step"].as_u64(), "{cooling}");
    assert!(serving.process.wait().unwrap().success());
    assert!(fixture().path("finished-from-page/metrics.json").exists());
}

#[test]
fn a_page_on_all_addresses_is_opened_at_one_of_them() {
    let serving = Serving::start(fixture(), "view @run --listen 0.0.0.0:0");
    assert!(!serving.address.ip().is_unspecified(), "{}", serving.address);
    assert_eq!(serving.ask("GET", "state").0, 200);
}

/// Holds connections that say nothing, half a request or nonsense, or read nothing of what they ask for.
fn attack(serving: &Serving) -> Vec<TcpStream> {
    let token = &serving.token;
    let requests = [
        Vec::new(),
        b"GET ".to_vec(),
        format!("GET /{token}/model HTTP/1.1\r\nHost: x\r\n\r\n").into_bytes(),
        [b'x'; 40_000].to_vec(),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(),
        b"POST /x HTTP/1.1\r\nContent-Length: 999999999999\r\n\r\nx".to_vec(),
        b"GET / HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: 4\r\n\r\nffffffffffffffff\r\n".to_vec(),
    ];
    let one = |index: usize| {
        let mut stream = TcpStream::connect(serving.address).ok()?;
        // The server may have closed it already.
        let _ = stream.write_all(&requests[index % requests.len()]);
        Some(stream)
    };
    (0..1000).filter_map(one).collect()
}

#[test]
fn hostile_clients_change_no_bit_of_a_training_and_hold_little_memory() {
    let train = "--steps 600 --seed 3 --sh-degree 1 --curve ap3 --model plain";
    fixture().succeed(&format!("train @set --out @unwatched {train}"));
    let watched = format!("train @set --out @watched {train} --progress none --view 0");
    let mut serving = Serving::start(fixture(), &watched);
    serving.until("a model", |state| state["model"].as_u64() > Some(0));
    // It shall not end before the attack does.
    assert_eq!(serving.ask("POST", "do/pause").0, 200);
    #[cfg(target_os = "linux")]
    let before = serving.peak_memory();
    let held = attack(&serving);
    assert!(held.len() > 100, "{} connections", held.len());
    #[cfg(target_os = "linux")]
    assert!(
        serving.peak_memory() < before + (64 << 10),
        "{before} KiB grew to {}",
        serving.peak_memory()
    );
    drop(held);
    for path in
        ["/", "/state", "/../../etc/passwd", "/00000000000000000000000000000000/state", "//"]
    {
        assert_eq!(serving.ask_raw("GET", path).0, 404, "{path}");
    }
    assert_eq!(serving.ask("POST", "do/resume").0, 200);
    assert!(serving.process.wait().unwrap().success());
    let [unwatched, watched] = ["unwatched", "watched"].map(|run| fixture().model(run));
    assert!(unwatched == watched, "watching changed the model");
}

#[test]
fn an_address_in_use_and_a_path_that_is_nothing_are_refused() {
    let serving = Serving::start(fixture(), "view @run --listen 0");
    let port = serving.address.port();
    fixture().refused(
        &format!("view @run --listen {port}"),
        2,
        &[&port.to_string(), "in use", "another port"],
    );
    fs::create_dir(fixture().path("empty")).unwrap();
    fixture().refuses_all(
        "
        3 | view nowhere | nowhere & does not exist & run directory
        2 | view @run --listen here | here & 127.0.0.1:7007
        3 | view @empty | transforms",
    );
}
