//! Event files for `TensorBoard`: scalars and images over the steps of a run.
//!
//! A file is records of (length u64, masked CRC-32C of that, bytes, masked CRC-32C of those), little-endian, as in
//! TensorFlow's `TFRecord`; the bytes are a protocol buffer `tensorflow.Event` with a few of its fields.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use nightsplat_core::{Error, Result};

/// A growing event file.
#[derive(Debug)]
pub struct EventFile {
    path: PathBuf,
    file: BufWriter<File>,
}

impl EventFile {
    /// Creates a new file in `folder` for events after `step`. It invalidates later events of earlier files, from an
    /// interrupted run.
    pub fn create(folder: &Path, step: u64) -> Result<Self> {
        let failed = |error: std::io::Error| unwritable(folder, &error);
        std::fs::create_dir_all(folder).map_err(failed)?;
        // Readers order the files of a run by name.
        let (now, mut number) = (seconds() as u64, 0);
        let (path, file) = loop {
            let path = folder.join(format!("events.out.tfevents.{now:010}.{number:04}.nightsplat"));
            match File::create_new(&path) {
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
                file => break (path, file.map_err(failed)?),
            }
        };
        let mut events = Self { path, file: BufWriter::new(file) };
        events.write(0, &Message::default().bytes(3, b"brain.Event:2"))?;
        // SessionLog { status: START }.
        events.write(step + 1, &Message::default().message(7, &Message::default().varint(1, 1)))?;
        events.flush()?;
        Ok(events)
    }

    /// Writes scalars of a step by name; a slash separates group and name.
    pub fn scalars(&mut self, step: u64, values: &[(String, f64)]) -> Result<()> {
        let mut summary = Message::default();
        for (tag, value) in values {
            let value = Message::default().bytes(1, tag.as_bytes()).float(2, *value as f32);
            summary = summary.message(1, &value);
        }
        self.write(step, &Message::default().message(5, &summary))
    }

    /// Writes an image of a step, a PNG file.
    pub fn picture(
        &mut self,
        step: u64,
        tag: &str,
        [width, height]: [u32; 2],
        png: &[u8],
    ) -> Result<()> {
        const RGB: u64 = 3;
        let image = Message::default().varint(1, height.into()).varint(2, width.into());
        let image = image.varint(3, RGB).bytes(4, png);
        let value = Message::default().bytes(1, tag.as_bytes()).message(4, &image);
        self.write(step, &Message::default().message(5, &Message::default().message(1, &value)))
    }

    /// Writes a line of text of a step.
    pub fn text(&mut self, step: u64, tag: &str, text: &str) -> Result<()> {
        const DT_STRING: u64 = 7;
        let one = Message::default().message(2, &Message::default().varint(1, 1));
        let tensor = Message::default().varint(1, DT_STRING).message(2, &one);
        let tensor = tensor.bytes(8, text.as_bytes());
        let plugin = Message::default().message(1, &Message::default().bytes(1, b"text"));
        let value = Message::default().bytes(1, tag.as_bytes());
        let value = value.message(8, &tensor).message(9, &plugin);
        self.write(step, &Message::default().message(5, &Message::default().message(1, &value)))
    }

    /// Flushes the file for other readers.
    pub fn flush(&mut self) -> Result<()> {
        self.file.flush().map_err(|error| unwritable(&self.path, &error))
    }

    /// Writes the fields of an event as one record.
    fn write(&mut self, step: u64, what: &Message) -> Result<()> {
        let mut event = Message::default().double(1, seconds()).varint(2, step);
        event.0.extend(&what.0);
        let length = (event.0.len() as u64).to_le_bytes();
        let parts: [&[u8]; 4] = [
            &length,
            &masked(crc32c(&length)).to_le_bytes(),
            &event.0,
            &masked(crc32c(&event.0)).to_le_bytes(),
        ];
        let written = parts.into_iter().try_for_each(|part| self.file.write_all(part));
        written.map_err(|error| unwritable(&self.path, &error))
    }
}

/// Seconds since the Unix epoch.
fn seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

fn unwritable(path: &Path, error: &std::io::Error) -> Error {
    Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
}

/// The fields of a protocol buffer, concatenated.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn key(mut self, field: u64, wire_type: u64) -> Self {
        self.number(field << 3 | wire_type);
        self
    }

    /// A varint: seven bits per byte, least significant first; the high bit marks that more follow.
    fn number(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn varint(self, field: u64, value: u64) -> Self {
        let mut message = self.key(field, 0);
        message.number(value);
        message
    }

    fn double(self, field: u64, value: f64) -> Self {
        let mut message = self.key(field, 1);
        message.0.extend(value.to_le_bytes());
        message
    }

    fn bytes(self, field: u64, bytes: &[u8]) -> Self {
        let mut message = self.key(field, 2);
        message.number(bytes.len() as u64);
        message.0.extend(bytes);
        message
    }

    fn float(self, field: u64, value: f32) -> Self {
        let mut message = self.key(field, 5);
        message.0.extend(value.to_le_bytes());
        message
    }

    fn message(self, field: u64, inner: &Self) -> Self {
        self.bytes(field, &inner.0)
    }
}

/// CRC-32C (Castagnoli), reflected.
fn crc32c(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = table();
    let step = |crc: u32, byte: &u8| TABLE[((crc ^ u32::from(*byte)) & 0xff) as usize] ^ (crc >> 8);
    !bytes.iter().fold(u32::MAX, step)
}

const fn table() -> [u32; 256] {
    const POLYNOMIAL: u32 = 0x82f6_3b78;
    let (mut table, mut byte) = ([0; 256], 0);
    while byte < 256 {
        let (mut crc, mut bit) = (byte as u32, 0);
        while bit < 8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ POLYNOMIAL } else { crc >> 1 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
}

/// The format masks checksums of data that contain checksums.
fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_matches_a_vector_of_rfc_3720() {
        // RFC 3720, B.4.
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
    }

    /// The fields of a message: number and bytes, with numbers as eight bytes.
    fn fields(mut bytes: &[u8]) -> Vec<(u64, Vec<u8>)> {
        fn number(bytes: &mut &[u8]) -> u64 {
            let (mut value, mut shift) = (0, 0);
            loop {
                let byte = bytes[0];
                *bytes = &bytes[1..];
                value |= u64::from(byte & 0x7f) << shift;
                shift += 7;
                if byte < 0x80 {
                    return value;
                }
            }
        }
        let mut fields = vec![];
        while !bytes.is_empty() {
            let key = number(&mut bytes);
            let len = match key & 7 {
                0 => {
                    fields.push((key >> 3, number(&mut bytes).to_le_bytes().to_vec()));
                    continue;
                }
                1 => 8,
                2 => number(&mut bytes) as usize,
                5 => 4,
                other => panic!("wire type {other}"),
            };
            fields.push((key >> 3, bytes[..len].to_vec()));
            bytes = &bytes[len..];
        }
        fields
    }

    /// The events of a file, with every checksum verified.
    fn events(path: &Path) -> Vec<Vec<(u64, Vec<u8>)>> {
        let bytes = std::fs::read(path).unwrap();
        let (mut rest, mut events) = (&bytes[..], vec![]);
        let word = |bytes: &[u8]| u32::from_le_bytes(bytes[..4].try_into().unwrap());
        while !rest.is_empty() {
            let len = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            assert_eq!(word(&rest[8..]), masked(crc32c(&rest[..8])));
            let data = &rest[12..12 + len];
            assert_eq!(word(&rest[12 + len..]), masked(crc32c(data)));
            events.push(fields(data));
            rest = &rest[16 + len..];
        }
        events
    }

    #[test]
    fn written_events_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = EventFile::create(folder.path(), 7).unwrap();
        let values = [("loss/l1".to_owned(), 0.25), ("Gaussians".to_owned(), 70_000.0)];
        file.scalars(300, &values).unwrap();
        file.picture(301, "view 3", [640, 480], b"pixels").unwrap();
        file.flush().unwrap();
        let read = events(&file.path);
        let field = |event: usize, number: u64| -> Vec<u8> {
            read[event].iter().find(|(found, _)| *found == number).unwrap().1.clone()
        };
        assert_eq!(field(0, 3), b"brain.Event:2");
        let step = |event| u64::from_le_bytes(field(event, 2).try_into().unwrap());
        assert_eq!([step(1), step(2), step(3)], [8, 300, 301]);
        let wall = f64::from_le_bytes(field(2, 1).try_into().unwrap());
        assert!((wall - seconds()).abs() < 60.0);
        for ((_, value), (tag, expected)) in fields(&field(2, 5)).iter().zip(&values) {
            let value = fields(value);
            assert_eq!(value[0], (1, tag.as_bytes().to_vec()));
            assert_eq!(value[1], (2, (*expected as f32).to_le_bytes().to_vec()));
        }
        let picture = fields(&fields(&field(3, 5))[0].1);
        let image = fields(&picture[1].1);
        let number = |bytes: &Vec<u8>| u64::from_le_bytes(bytes.clone().try_into().unwrap());
        assert_eq!([0, 1, 2].map(|index| number(&image[index].1)), [480, 640, 3]);
        assert_eq!(image[3], (4, b"pixels".to_vec()));
        // A second file of the same second gets another name.
        let again = EventFile::create(folder.path(), 0).unwrap();
        assert_ne!(again.path, file.path);
    }
}
