//! Limits on the declared size of an image, checked before memory is allocated, and on the memory of decoding.

use std::io::Cursor;
use std::path::Path;
use std::sync::{Condvar, Mutex, PoisonError};

use super::source::{BufReadSeek, reader};
use super::{exr_file, png_file};
use crate::{Error, Result};

/// More than any camera: 16 384 x 16 384.
const MAX_PIXELS: u64 = 1 << 28;

/// The limit for the samples of all layers of an EXR file, which are decoded at once, bytes.
const MAX_BYTES: u64 = 1 << 33;

/// A photograph of more pixels is reduced while it is decoded, to at most `REDUCED`, unless it is wanted larger.
/// Cameras have 61 million; those of medium format 102 or 151.
const LARGE: u64 = 1 << 26;
const REDUCED: u64 = 1 << 23;

/// Bytes that decoders may hold at a time in all threads, unless one alone needs more.
const MOST_AT_ONCE: u64 = 1 << 30;

/// The size at which a photograph of this size is decoded: its own, or that by a whole number, at least `wanted`.
pub(crate) fn reduced_size((width, height): (u32, u32), wanted: (u32, u32)) -> (u32, u32) {
    let pixels = u64::from(width) * u64::from(height);
    if pixels <= LARGE {
        return (width, height);
    }
    let factor = (pixels as f64 / REDUCED as f64).sqrt().ceil() as u32;
    let most = [(width, wanted.0), (height, wanted.1)].map(|(side, wanted)| side / wanted.max(1));
    let factor = factor.min(most[0]).min(most[1]).max(1);
    let side = |side: u32| (f64::from(side) / f64::from(factor)).round().max(1.0) as u32;
    (side(width), side(height))
}

/// Bytes that decoders hold.
static HELD: Mutex<u64> = Mutex::new(0);
static RELEASED: Condvar = Condvar::new();

/// Memory of a decoder, until it is dropped. Who holds it waits for no other thread, which may wait for it.
pub(super) struct Permit(u64);

impl Permit {
    /// Waits until so many bytes are free.
    pub(super) fn wait(bytes: u64) -> Self {
        let held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        let is_full = |held: &mut u64| *held > 0 && held.saturating_add(bytes) > MOST_AT_ONCE;
        let held = RELEASED.wait_while(held, is_full);
        *held.unwrap_or_else(PoisonError::into_inner) += bytes;
        Self(bytes)
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        *HELD.lock().unwrap_or_else(PoisonError::into_inner) -= self.0;
        RELEASED.notify_all();
    }
}

/// Checks the declared size of a file; returns its pixels, 0 if its header is not readable.
pub(super) fn check(path: &Path, bytes: &[u8]) -> Result<u64> {
    // A file without a readable header is refused by its decoder.
    let mut pixels = 0;
    let excess = if bytes.starts_with(&exr_file::MAGIC) {
        excess_of_exr(bytes)
    } else {
        let of_header =
            || reader(Cursor::new(bytes)).ok().and_then(|reader| reader.into_dimensions().ok());
        png_file::size(bytes).or_else(of_header).and_then(|(width, height)| {
            pixels = u64::from(width) * u64::from(height);
            excess_of_size(width.into(), height.into())
        })
    };
    match excess {
        Some(excess) => {
            Err(Error::input(path, format!("{excess}; crop or shrink it, or copy it again")))
        }
        None => Ok(pixels),
    }
}

/// The limits of decoders: those of this module, instead of their own.
pub(super) fn limits() -> ::image::Limits {
    let mut limits = ::image::Limits::no_limits();
    // Four channels of 16 bits, and the decoder's own.
    limits.max_alloc = Some(16 * MAX_PIXELS);
    limits
}

fn excess_of_size(width: u64, height: u64) -> Option<String> {
    let is_more = width.saturating_mul(height) > MAX_PIXELS;
    is_more.then(|| format!("declares {width}x{height}, more than 268 megapixels"))
}

fn excess_of_exr(bytes: &[u8]) -> Option<String> {
    let headers = exr_headers(bytes)?;
    let pixels = headers.iter().find_map(|header| {
        let [width, height] = size(header);
        excess_of_size(width, height)
    });
    let (total, gigabytes) = (exr_bytes(bytes), exr_bytes(bytes) >> 30);
    let is_more = total > MAX_BYTES;
    pixels.or(is_more.then(|| format!("declares layers of {gigabytes} GiB, more than 8")))
}

type ExrHeader = exr::meta::header::Header;

fn exr_headers(bytes: &[u8]) -> Option<exr::meta::Headers> {
    let bytes: Box<dyn BufReadSeek> = Box::new(Cursor::new(bytes));
    Some(exr::meta::MetaData::read_from_buffered(bytes, false).ok()?.headers)
}

fn size(header: &ExrHeader) -> [u64; 2] {
    [header.layer_size.width(), header.layer_size.height()].map(|side| side as u64)
}

/// The bytes of the samples of all layers.
pub(super) fn exr_bytes(bytes: &[u8]) -> u64 {
    let samples = |header: &ExrHeader| {
        let [width, height] = size(header);
        width.saturating_mul(height).saturating_mul(header.channels.bytes_per_pixel as u64)
    };
    let headers = exr_headers(bytes).unwrap_or_default();
    headers.iter().map(samples).fold(0, u64::saturating_add)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The header of a PNG of this size, with its checksum.
    fn png(width: u32, height: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let encoder = ::image::codecs::png::PngEncoder::new(&mut bytes);
        let color = ::image::ExtendedColorType::L8;
        ::image::ImageEncoder::write_image(encoder, &[0], 1, 1, color).unwrap();
        bytes[16..20].copy_from_slice(&width.to_be_bytes());
        bytes[20..24].copy_from_slice(&height.to_be_bytes());
        let crc = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&crc.to_be_bytes());
        bytes
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(u32::MAX, |crc, &byte| {
            (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 * (crc & 1)))
        })
    }

    /// The fixture with another size in its frame header.
    fn jpeg(side: u16) -> Vec<u8> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/jpeg/420.jpg");
        let mut bytes = std::fs::read(path).unwrap();
        let at = bytes.windows(2).position(|marker| marker == [0xFF, 0xC1]).unwrap();
        for side_at in [at + 5, at + 7] {
            bytes[side_at..side_at + 2].copy_from_slice(&side.to_be_bytes());
        }
        bytes
    }

    #[test]
    fn a_size_beyond_any_camera_is_refused_before_it_is_decoded() {
        let path = Path::new("bomb");
        let refused = |bytes: &[u8], part: &str| {
            let message = check(path, bytes).unwrap_err().to_string();
            assert!(message.contains("bomb: declares") && message.contains(part), "{message}");
        };
        refused(&png(20_000, 20_000), "20000x20000");
        check(path, &png(16_384, 16_384)).unwrap();
        refused(&jpeg(20_000), "20000x20000");
        check(path, &jpeg(16_000)).unwrap();
        check(path, b"no picture").unwrap();
    }

    #[test]
    fn a_large_photograph_is_reduced_by_a_whole_number_to_what_is_wanted() {
        // Of a phone and of small cameras.
        for size in [(8064, 6048), (9504, 6336), (8192, 8192)] {
            assert_eq!(reduced_size(size, (1, 1)), size);
        }
        let (whole, half, quarter) = ((11_600, 8700), (5800, 4350), (2900, 2175));
        for (wanted, reduced) in [(1600, quarter), (3867, half), (5801, whole), (11_600, whole)] {
            let found = reduced_size(whole, (wanted, wanted * 3 / 4));
            assert_eq!(found, reduced);
        }
        assert_eq!(reduced_size((1 << 28, 1), (1, 1)), (1 << 28, 1));
    }

    #[test]
    fn decoders_that_need_much_memory_wait_for_each_other() {
        let first = Permit::wait(MOST_AT_ONCE);
        let (sender, receiver) = std::sync::mpsc::channel();
        let second = std::thread::spawn(move || {
            let _permit = Permit::wait(MOST_AT_ONCE + 1);
            sender.send(()).unwrap();
        });
        assert!(receiver.recv_timeout(std::time::Duration::from_millis(20)).is_err());
        drop(first);
        receiver.recv().unwrap();
        second.join().unwrap();
    }

    #[test]
    fn an_exr_of_many_pixels_is_refused_by_its_header() {
        use exr::prelude::{SpecificChannels, Vec2, WritableImage};
        let channels = SpecificChannels::rgb(|Vec2(..): Vec2<usize>| (0.0_f32, 0.0_f32, 0.0_f32));
        let mut file = Cursor::new(Vec::new());
        exr::image::Image::from_channels((3, 2), channels).write().to_buffered(&mut file).unwrap();
        let mut bytes = file.into_inner();
        check(Path::new("small"), &bytes).unwrap();
        // Both windows end at the last column and row.
        for name in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
            let at =
                bytes.windows(name.len()).position(|found| found == name).unwrap() + name.len() + 4;
            for side in [at + 8, at + 12] {
                bytes[side..side + 4].copy_from_slice(&29_999_i32.to_le_bytes());
            }
        }
        let message = check(Path::new("bomb"), &bytes).unwrap_err().to_string();
        assert!(message.contains("30000x30000"), "{message}");
    }
}
