//! Colour metadata of files, in the order of precedence of each format.
//!
//! - JPEG: the ICC profile of its APP2 segments (ICC.1:2022, annex B.4), then Exif.
//! - PNG: `cICP`, `iCCP`, `sRGB`, then `gAMA` and `cHRM` (PNG third edition, 12.1 and 13.13), then Exif.
//! - TIFF, WebP: the ICC profile, then Exif.

use std::collections::BTreeMap;
use std::io::{Cursor, Read};

use ::exif::{Context, Exif, In, Reader, Tag, Value};
use ::image::{ImageDecoder, ImageFormat};
use flate2::read::ZlibDecoder;

use super::super::jpeg;
use super::super::source::reader;

/// One statement about the colours of a file.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Statement {
    /// They are sRGB.
    Srgb,
    /// An ICC profile.
    Profile(Vec<u8>),
    /// Code points of H.273: primaries, transfer characteristics, matrix coefficients, and 1 for full range.
    CodePoints([u8; 4]),
    /// Chromaticities, and the exponent that decodes to linear light; sRGB's if omitted.
    Primaries { chromaticities: Option<Chromaticities>, exponent: Option<f64> },
    /// Adobe RGB (1998).
    AdobeRgb,
    /// Metadata that cannot be used, in words.
    Unknown(String),
}

/// CIE x and y of white, red, green and blue.
pub(in super::super) type Chromaticities = [[f64; 2]; 4];

/// Limit for a profile, bytes; a longer one is none.
pub(super) const MAX_BYTES: u64 = 1 << 24;

const PNG: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

/// The statements of a file, in order of precedence; empty if there are none.
pub(super) fn statements(bytes: &[u8]) -> Vec<Statement> {
    let mut statements = if bytes.starts_with(&jpeg::MAGIC) {
        jpeg_profile(bytes).into_iter().collect()
    } else if bytes.starts_with(&PNG) {
        of_png(bytes)
    } else {
        webp_profile(bytes).map(Statement::Profile).into_iter().collect()
    };
    // Nothing overrides sRGB, the default.
    let is_settled = statements.last() == Some(&Statement::Srgb);
    if !is_settled && let Ok(exif) = Reader::new().read_from_container(&mut Cursor::new(bytes)) {
        statements.extend(tiff_profile(&exif));
        statements.extend(of_exif(&exif));
    }
    statements
}

/// The profile in the APP2 segments of a JPEG, which are numbered parts of it.
fn jpeg_profile(bytes: &[u8]) -> Option<Statement> {
    const APP2: u8 = 0xE2;
    let mut parts = BTreeMap::new();
    let mut count = 0;
    for (marker, segment) in jpeg::segments(bytes) {
        if marker == APP2
            && let Some([number, of, part @ ..]) = segment.strip_prefix(b"ICC_PROFILE\0")
        {
            parts.entry(*number).or_insert(part);
            count = usize::from(*of);
        }
    }
    if parts.is_empty() {
        return None;
    }
    let is_whole = parts.keys().copied().map(usize::from).eq(1..=count);
    let profile = || Statement::Profile(parts.values().copied().collect::<Vec<_>>().concat());
    let cut = || Statement::Unknown("an ICC profile with missing parts".to_owned());
    Some(if is_whole { profile() } else { cut() })
}

fn webp_profile(bytes: &[u8]) -> Option<Vec<u8>> {
    let reader = reader(Cursor::new(bytes)).ok()?;
    if reader.format() != Some(ImageFormat::WebP) {
        return None;
    }
    reader.into_decoder().ok()?.icc_profile().ok()?
}

/// The profile of a TIFF, whose tags are read like Exif.
fn tiff_profile(exif: &Exif) -> Option<Statement> {
    const PROFILE: Tag = Tag(Context::Tiff, 0x8773);
    match &exif.get_field(PROFILE, In::PRIMARY)?.value {
        Value::Undefined(bytes, _) | Value::Byte(bytes) => Some(Statement::Profile(bytes.clone())),
        _ => Some(Statement::Unknown("a damaged ICC profile".to_owned())),
    }
}

/// The chunks of a PNG before its pixels.
fn of_png(bytes: &[u8]) -> Vec<Statement> {
    let mut chunks: BTreeMap<&[u8], &[u8]> = BTreeMap::new();
    let mut rest = &bytes[PNG.len()..];
    while let Some((head, after)) = rest.split_first_chunk::<8>() {
        let [a, b, c, d, name @ ..] = head;
        let length = u32::from_be_bytes([*a, *b, *c, *d]) as usize;
        let Some((data, after)) = after.split_at_checked(length) else { break };
        if name == b"IDAT" {
            break;
        }
        chunks.entry(&head[4..]).or_insert(data);
        rest = after.get(4..).unwrap_or_default();
    }
    let chunk = |name: &[u8]| chunks.get(name).copied();
    let mut statements = vec![];
    statements.extend(chunk(b"cICP").map(|data| match data.try_into() {
        Ok(points) => Statement::CodePoints(points),
        Err(_) => Statement::Unknown("a cICP chunk of another length".to_owned()),
    }));
    statements.extend(chunk(b"iCCP").map(inflated));
    if chunk(b"sRGB").is_some() {
        statements.push(Statement::Srgb);
        return statements;
    }
    let exponent = chunk(b"gAMA").map(|data| match numbers(data)[..] {
        [gamma] if gamma > 0.0 => Ok(1.0 / gamma),
        _ => Err(Statement::Unknown("an invalid gAMA chunk".to_owned())),
    });
    let chromaticities = chunk(b"cHRM").map(|data| match numbers(data)[..] {
        [wx, wy, rx, ry, gx, gy, bx, by] => Ok([[wx, wy], [rx, ry], [gx, gy], [bx, by]]),
        _ => Err(Statement::Unknown("a cHRM chunk of another length".to_owned())),
    });
    match (exponent.transpose(), chromaticities.transpose()) {
        (Ok(None), Ok(None)) => {}
        (Ok(exponent), Ok(chromaticities)) => {
            statements.push(Statement::Primaries { chromaticities, exponent });
        }
        (Err(unknown), _) | (_, Err(unknown)) => statements.push(unknown),
    }
    statements
}

/// The profile of an iCCP chunk: a name, a zero, the method 0, and zlib data.
fn inflated(data: &[u8]) -> Statement {
    let compressed = data.iter().position(|&byte| byte == 0).and_then(|at| data.get(at + 2..));
    let mut profile = vec![];
    let read = ZlibDecoder::new(compressed.unwrap_or_default())
        .take(MAX_BYTES + 1)
        .read_to_end(&mut profile);
    match read {
        Ok(_) => Statement::Profile(profile),
        Err(_) => Statement::Unknown("a damaged ICC profile".to_owned()),
    }
}

/// Big-endian words in units of 1/100000.
fn numbers(data: &[u8]) -> Vec<f64> {
    let (words, _) = data.as_chunks::<4>();
    words.iter().map(|&word| f64::from(u32::from_be_bytes(word)) / 1e5).collect()
}

/// Colour information in Exif, or in the tags of a TIFF.
fn of_exif(exif: &Exif) -> Option<Statement> {
    const SRGB: u32 = 1;
    const ADOBE_RGB: u32 = 2;
    const UNCALIBRATED: u32 = 0xFFFF;
    const TRANSFER_FUNCTION: Tag = Tag(Context::Tiff, 0x012D);
    let field = |tag| exif.get_field(tag, In::PRIMARY).map(|field| &field.value);
    let space = field(Tag::ColorSpace).and_then(|value| value.get_uint(0));
    let is_optional_file = matches!(field(Tag::InteroperabilityIndex),
        Some(Value::Ascii(text)) if text.first().is_some_and(|text| text.starts_with(b"R03")));
    match space {
        Some(SRGB) => return Some(Statement::Srgb),
        Some(ADOBE_RGB) => return Some(Statement::AdobeRgb),
        // DCF 2.0: an optional file is in Adobe RGB.
        _ if is_optional_file => return Some(Statement::AdobeRgb),
        _ => {}
    }
    let chromaticities = || {
        let [white, primaries] = [Tag::WhitePoint, Tag::PrimaryChromaticities].map(field);
        let [wx, wy] = *rationals(white?) else { return None };
        let [rx, ry, gx, gy, bx, by] = *rationals(primaries?) else { return None };
        Some([[wx, wy], [rx, ry], [gx, gy], [bx, by]])
    };
    let exponent = field(Tag::Gamma).and_then(|value| rationals(value).first().copied());
    match (space, chromaticities(), field(TRANSFER_FUNCTION)) {
        (_, Some(_), Some(_)) => Some(Statement::Unknown("a TransferFunction tag".to_owned())),
        (_, chromaticities @ Some(_), None) => {
            Some(Statement::Primaries { chromaticities, exponent })
        }
        (Some(UNCALIBRATED), None, _) => {
            Some(Statement::Unknown("Exif's \"uncalibrated\" without a profile".to_owned()))
        }
        (Some(other), None, _) => Some(Statement::Unknown(format!("Exif's colour space {other}"))),
        (None, None, _) => None,
    }
}

fn rationals(value: &Value) -> Box<[f64]> {
    match value {
        Value::Rational(numbers) => numbers.iter().map(::exif::Rational::to_f64).collect(),
        _ => Box::default(),
    }
}
