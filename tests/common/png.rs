//! PNG files with more than their pixels.

use std::fs;
use std::path::Path;

/// Puts a chunk in front of the pixels of a PNG.
pub(crate) fn put_chunk(path: &Path, name: &[u8; 4], data: &[u8]) {
    let mut file = fs::read(path).unwrap();
    let body = [&name[..], data].concat();
    let crc = !body.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 * (crc & 1)))
    });
    let chunk = [&(data.len() as u32).to_be_bytes()[..], &body, &crc.to_be_bytes()].concat();
    // After the signature and IHDR.
    file.splice(33..33, chunk);
    fs::write(path, file).unwrap();
}
