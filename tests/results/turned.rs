//! Photographs of a camera that lay on a side, as their Exif says: what people see of a run is upright.

use std::fs;
use std::path::Path;

use crate::common::png::put_chunk;
use crate::common::{Folder, paths};

/// Exif that says: turn a quarter clockwise.
const TURNED: &[u8] = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";

/// The first bytes of a PNG of this size.
fn header(width: u32, height: u32) -> Vec<u8> {
    let start = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR";
    [&start[..], &width.to_be_bytes(), &height.to_be_bytes()].concat()
}

fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let letters = |three: &[u8]| {
        let bits = three.iter().fold(0, |bits, byte| bits << 8 | u32::from(*byte));
        [18, 12, 6, 0].map(|shift| char::from(LETTERS[(bits >> shift & 63) as usize]))
    };
    bytes.chunks_exact(3).flat_map(letters).collect()
}

fn are_upright(page: &Path) {
    let html = fs::read_to_string(page).unwrap();
    let pictures: Vec<&str> = html.split("data:image/png;base64,").skip(1).collect();
    let upright = base64(&header(32, 40));
    assert!(!pictures.is_empty(), "{}", page.display());
    assert!(
        pictures.iter().all(|page_picture| page_picture.starts_with(&upright)),
        "{}",
        page.display()
    );
}

#[test]
fn pages_and_event_files_show_photographs_and_renders_upright() {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 9 --width 40 --height 32");
    for part in ["low", "high"] {
        for path in paths(&folder.path("set").join(part)) {
            put_chunk(&path, b"eXIf", TURNED);
        }
    }
    let options = "--plan none --curve ase --steps 4 --progress none";
    folder.succeed(&format!("train @set --out @run --tensorboard --eval-every 2 {options}"));
    let written = paths(&folder.path("run/tensorboard"));
    let events: Vec<u8> = written.iter().flat_map(|path| fs::read(path).unwrap()).collect();
    let holds = |part: &[u8]| events.windows(part.len()).any(|bytes| bytes == part);
    assert!(holds(&header(32, 40)) && !holds(&header(40, 32)));

    folder.succeed("eval @run --report @eval.html");
    are_upright(&folder.path("eval.html"));
    folder.succeed("diagnose @set --report @diagnosis.html");
    let diagnosis = folder.text("diagnosis.html");
    assert!(
        diagnosis.contains("width=\"32\" height=\"40\"") && !diagnosis.contains("height=\"32\"")
    );
    folder.succeed("sweep @set --out @sweep --curves ase --steps 4");
    are_upright(&folder.path("sweep/index.html"));
}
