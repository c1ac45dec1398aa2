//! JPEG as libjpeg decodes it: accurate integer DCT, smooth chroma upsampling. Huffman-coded, sequential or progressive.
//!
//! Other decoders round otherwise, by fractions of a code value; a tone curve multiplies that by ten. libjpeg itself
//! leaves a damaged file by unwinding through C, which ends a host that aborts on panics; and it paints what it cannot
//! read. Here such a file is refused.

mod entropy;
mod pixels;

use std::path::Path;

use self::entropy::{Codes, Huffman, Scan, ZIGZAG};
use super::Image;
use crate::{Error, Result};

/// What a JPEG file begins with.
pub(super) const MAGIC: [u8; 2] = [0xFF, 0xD8];

/// What the components are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Colors {
    Grey,
    Rgb,
    Ycc,
}

/// The picture before it is one: coefficients, as far as the scans have brought them.
#[derive(Debug)]
struct Picture {
    is_progressive: bool,
    /// Columns and rows of pixels.
    size: [usize; 2],
    /// The samples that a component of full resolution has in a unit, in blocks.
    sampling: [usize; 2],
    /// Columns and rows of units; a unit holds the blocks of all components that cover the same pixels.
    units: [usize; 2],
    components: Vec<Component>,
}

/// A colour channel at its own resolution.
#[derive(Debug)]
struct Component {
    id: u8,
    /// Columns and rows of blocks in a unit.
    sampling: [usize; 2],
    /// Columns and rows of samples, without padding.
    size: [usize; 2],
    /// Columns and rows of blocks that hold them.
    blocks: [usize; 2],
    /// Columns of blocks in memory.
    stride: usize,
    coefficients: Vec<[i16; 64]>,
    table: usize,
    /// The table as it was at the component's first scan, row by row.
    quantization: Option<[u16; 64]>,
}

/// The image; none where the file holds four colours (CMYK).
///
/// # Errors
/// [`Error::Input`] names the file when it is cut short or damaged.
pub(super) fn load(path: &Path, bytes: &[u8]) -> Result<Option<Image>> {
    if !is_whole(bytes) {
        return Err(Error::input(path, "this JPEG is cut short; copy it again"));
    }
    let mut decoder = Decoder::default();
    let image = match decoder.read(bytes) {
        Some(()) => decoder.picture.as_ref().and_then(|p| pixels::image(p, decoder.colors(p))),
        None if decoder.has_four_colors => return Ok(None),
        None => None,
    };
    image.map(Some).ok_or_else(|| Error::input(path, "this JPEG is damaged; copy it again"))
}

/// What the segments of a file have said so far.
#[derive(Default)]
struct Decoder {
    quantization: [Option<[u16; 64]>; 4],
    codes: Codes,
    restart_interval: usize,
    is_jfif: bool,
    /// How an Adobe file transforms its colours.
    adobe_transform: Option<u8>,
    has_four_colors: bool,
    picture: Option<Picture>,
}

impl Decoder {
    /// Reads the file to its end marker; none where it is damaged, or of a kind that libjpeg refuses.
    fn read(&mut self, bytes: &[u8]) -> Option<()> {
        let mut at = MAGIC.len();
        loop {
            let marker = next_marker(bytes, &mut at)?;
            match marker {
                0xD9 => return Some(()),
                0x01 | 0xD0..=0xD7 => continue,
                0xD8 => return None,
                _ => {}
            }
            let length = usize::from(word(bytes.get(at..)?)?);
            let segment = bytes.get(at + 2..at + length)?;
            at += length;
            match marker {
                0xC0..=0xC2 => self.start_picture(segment, marker == 0xC2, bytes.len())?,
                0xC4 => self.read_codes(segment)?,
                0xDB => self.read_quantization(segment)?,
                0xDD => self.restart_interval = word(segment)?.into(),
                0xDA => {
                    let scan = self.scan(segment)?;
                    scan.read(self.picture.as_mut()?, &self.codes, bytes, &mut at)?;
                }
                // Lossless, hierarchical and arithmetic coding, and pictures of unknown height.
                0xC3..=0xCF | 0xDC => return None,
                0xE0 => self.is_jfif |= segment.len() >= 14 && segment.starts_with(b"JFIF\0"),
                0xEE if segment.starts_with(b"Adobe") => {
                    self.adobe_transform = segment.get(11).copied().or(self.adobe_transform);
                }
                _ => {}
            }
        }
    }

    fn start_picture(&mut self, segment: &[u8], is_progressive: bool, bytes: usize) -> Option<()> {
        let [8, y1, y0, x1, x0, count, components @ ..] = segment else { return None };
        let size = [[*x1, *x0], [*y1, *y0]].map(|side| usize::from(u16::from_be_bytes(side)));
        self.has_four_colors = *count == 4;
        if self.picture.is_some()
            || size.contains(&0)
            || components.len() != 3 * usize::from(*count)
            || !matches!(count, 1 | 3)
        {
            return None;
        }
        let components: Vec<[u8; 3]> = components.as_chunks().0.to_vec();
        let sampling_of = |[_, factors, _]: &[u8; 3]| [factors >> 4, factors & 15].map(usize::from);
        if components.iter().flat_map(sampling_of).any(|factor| !(1..=4).contains(&factor)) {
            return None;
        }
        let most = |axis: usize| components.iter().map(|c| sampling_of(c)[axis]).max();
        let sampling = [most(0)?, most(1)?];
        let units = [0, 1].map(|axis| size[axis].div_ceil(8 * sampling[axis]));
        let component = |of: &[u8; 3]| {
            let own = sampling_of(of);
            let size = [0, 1].map(|axis| (size[axis] * own[axis]).div_ceil(sampling[axis]));
            let stride = units[0] * own[0];
            Component {
                id: of[0],
                sampling: own,
                size,
                blocks: size.map(|side| side.div_ceil(8)),
                stride,
                coefficients: vec![[0; 64]; stride * units[1] * own[1]],
                table: of[2].into(),
                quantization: None,
            }
        };
        // A block takes a bit at least: what claims more blocks would only eat memory.
        let unit_blocks: usize =
            components.iter().map(|c| sampling_of(c).iter().product::<usize>()).sum();
        if units[0] * units[1] * unit_blocks > 8 * bytes {
            return None;
        }
        let components = components.iter().map(component).collect();
        self.picture = Some(Picture { is_progressive, size, sampling, units, components });
        Some(())
    }

    /// What libjpeg takes the components for.
    fn colors(&self, picture: &Picture) -> Colors {
        let ids: Vec<u8> = picture.components.iter().map(|component| component.id).collect();
        match (ids.as_slice(), self.adobe_transform) {
            ([_], _) => Colors::Grey,
            _ if self.is_jfif => Colors::Ycc,
            (_, Some(0)) | ([b'R', b'G', b'B'], None) => Colors::Rgb,
            _ => Colors::Ycc,
        }
    }

    fn read_codes(&mut self, mut segment: &[u8]) -> Option<()> {
        while let [place, rest @ ..] = segment {
            let (counts, rest) = rest.split_first_chunk::<16>()?;
            let count = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(count)?;
            let code =
                self.codes.get_mut(usize::from(place >> 4))?.get_mut(usize::from(place & 15))?;
            *code = Some(Huffman::new(counts, symbols));
            segment = rest;
        }
        Some(())
    }

    fn read_quantization(&mut self, mut segment: &[u8]) -> Option<()> {
        while let [place, rest @ ..] = segment {
            let width = if place >> 4 == 0 { 1 } else { 2 };
            let (values, rest) = rest.split_at_checked(64 * width)?;
            let mut table = [0; 64];
            for (place, value) in ZIGZAG.into_iter().zip(values.chunks(width)) {
                table[place] = value.iter().fold(0, |word, &byte| word << 8 | u16::from(byte));
            }
            *self.quantization.get_mut(usize::from(place & 15))? = Some(table);
            segment = rest;
        }
        Some(())
    }

    /// The scan that a segment announces.
    fn scan(&mut self, segment: &[u8]) -> Option<Scan> {
        let picture = self.picture.as_mut()?;
        let [count, rest @ ..] = segment else { return None };
        let (selected, band) = rest.split_at_checked(2 * usize::from(*count))?;
        let &[first, last, bits] = band else { return None };
        let mut components = vec![];
        for &[id, tables] in selected.as_chunks().0 {
            let index = picture.components.iter().position(|component| component.id == id)?;
            if components.iter().any(|&(other, _)| other == index) {
                return None;
            }
            let component = &mut picture.components[index];
            if component.quantization.is_none() {
                component.quantization = *self.quantization.get(component.table)?;
            }
            components
                .push((index, [tables >> 4, tables & 15].map(|table| usize::from(table & 3))));
        }
        let band = [first, last].map(usize::from);
        let is_ac = (1..=band[1]).contains(&band[0]) && band[1] < 64 && components.len() == 1;
        let bits = [bits >> 4, bits & 15].map(u32::from);
        if components.is_empty()
            || picture.is_progressive && (!(is_ac || band == [0, 0]) || bits[1] > 13)
        {
            return None;
        }
        Some(Scan { components, band, bits, restart_interval: self.restart_interval })
    }
}

fn word(bytes: &[u8]) -> Option<u16> {
    bytes.first_chunk().map(|&word| u16::from_be_bytes(word))
}

/// The next marker at or behind `at`, which moves behind it.
fn next_marker(bytes: &[u8], at: &mut usize) -> Option<u8> {
    loop {
        match bytes.get(*at..)? {
            [0xFF, marker @ (1..=0xFE), ..] => {
                *at += 2;
                return Some(*marker);
            }
            [] => return None,
            _ => *at += 1,
        }
    }
}

/// Whether a JPEG reaches its end-of-image marker: the decoder paints what is missing grey and says nothing.
///
/// Segments are stepped over by their length, so a thumbnail's own marker does not count.
fn is_whole(bytes: &[u8]) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while let [marker, rest @ ..] = bytes.get(at..).unwrap_or_default() {
        match (marker, rest) {
            (0xFF, [0xD9, ..]) => return true,
            (0xFF, [0x00 | 0xD0..=0xD7, ..]) if in_scan => at += 2,
            (0xFF, [0xFF, ..]) => at += 1,
            (0xFF, [kind, high, low, ..]) => {
                in_scan = *kind == 0xDA;
                at += 2 + usize::from(u16::from_be_bytes([*high, *low]));
            }
            _ => at += 1,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The file, and its pixels as libjpeg decodes them: FNV-1a of the bytes of red, green and blue.
    const PICTURES: [(&str, u64); 10] = [
        ("grey.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("grey_progressive.jpg", 0xa9ca_851e_396d_a86c),
        ("grey_refined.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("grey_restarts.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("444.jpg", 0xa2e1_50f4_e546_fe4f),
        ("422.jpg", 0xfd6f_685b_a383_5820),
        ("440.jpg", 0x415f_ded0_2db0_dd9a),
        ("420.jpg", 0x19b0_b636_a9aa_4c3a),
        ("420_progressive.jpg", 0x2b7c_7a79_de4c_299b),
        ("411_progressive.jpg", 0x9212_8246_36cb_1b2c),
    ];

    fn fixture(name: &str) -> Vec<u8> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/jpeg");
        std::fs::read(Path::new(folder).join(name)).unwrap()
    }

    #[test]
    fn every_kind_of_picture_has_the_pixels_that_libjpeg_gives_it() {
        for (name, expected) in PICTURES {
            let image = load(Path::new(name), &fixture(name)).unwrap().unwrap();
            assert_eq!((image.width, image.height), (37, 29), "{name}");
            let bytes = image.data.iter().map(|value| (value * 255.0).round() as u8);
            let hash = bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
            });
            assert_eq!(hash, expected, "{name}: {hash:#x}");
        }
    }

    #[test]
    fn a_jpeg_with_a_wrong_byte_is_read_or_refused_and_ends_nothing() {
        for (name, _) in PICTURES {
            let whole = fixture(name);
            let mut refused = 0;
            for at in 2..whole.len() {
                let mut bytes = whole.clone();
                bytes[at] = [0x00, 0xFF, whole[at] ^ 1, whole[at] ^ 0x80][at % 4];
                refused += usize::from(load(Path::new(name), &bytes).is_err());
            }
            assert!(refused > 0, "{name}: {refused}");
        }
    }

    #[test]
    fn a_picture_that_claims_more_than_its_file_can_hold_is_refused() {
        let mut bytes = fixture("420.jpg");
        let at = bytes.windows(2).position(|marker| marker == [0xFF, 0xC1]).unwrap();
        bytes[at + 5..at + 9].fill(0xFF);
        assert!(load(Path::new("photo.jpg"), &bytes).is_err());
    }

    #[test]
    fn a_damaged_jpeg_is_refused_by_name() {
        let path = Path::new("photo.jpg");
        // Start and end of an image with nothing between, and a frame header of no size.
        let empty = [0xFF, 0xD8, 0xFF, 0xD9];
        let no_size = [0xFF, 0xD8, 0xFF, 0xC0, 0, 11, 8, 0, 0, 0, 0, 1, 1, 0x11, 0, 0xFF, 0xD9];
        for bytes in [&empty[..], &no_size] {
            let message = load(path, bytes).unwrap_err().to_string();
            assert!(message.contains("photo.jpg") && message.contains("damaged"), "{message}");
        }
    }
}
