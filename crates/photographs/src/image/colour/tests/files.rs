//! Small files in other colour spaces, written byte by byte with their profiles.

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use glam::{DMat3, DVec3};

pub(super) const D65: [f64; 2] = [0.3127, 0.3290];
const D50: [f64; 3] = [0.96422, 1.0, 0.82521];

/// Chromaticities of white, red, green and blue, as published.
pub(super) const SRGB: [[f64; 2]; 4] = [D65, [0.64, 0.33], [0.30, 0.60], [0.15, 0.06]];
pub(super) const P3: [[f64; 2]; 4] = [D65, [0.680, 0.320], [0.265, 0.690], [0.150, 0.060]];
pub(super) const ADOBE: [[f64; 2]; 4] = [D65, [0.64, 0.33], [0.21, 0.71], [0.15, 0.06]];
pub(super) const PROPHOTO: [[f64; 2]; 4] =
    [[0.3457, 0.3585], [0.7347, 0.2653], [0.1596, 0.8404], [0.0366, 0.0001]];

/// The curve of a colour space: sRGB's, or an exponent.
#[derive(Clone, Copy)]
pub(super) enum TransferFunction {
    Srgb,
    Power(f64),
}

impl TransferFunction {
    pub(super) fn encode(self, linear: f64) -> f64 {
        match self {
            Self::Srgb if linear <= 0.003_130_8 => 12.92 * linear,
            Self::Srgb => 1.055 * linear.powf(1.0 / 2.4) - 0.055,
            Self::Power(exponent) => linear.max(0.0).powf(1.0 / exponent),
        }
    }
}

fn xyz([x, y]: [f64; 2]) -> DVec3 {
    DVec3::new(x / y, 1.0, (1.0 - x - y) / y)
}

/// From linear light of primaries to XYZ at D50, by Bradford's matrix.
pub(super) fn to_d50([white, red, green, blue]: [[f64; 2]; 4]) -> DMat3 {
    let bradford = DMat3::from_cols_array(&[
        0.8951, -0.7502, 0.0389, 0.2664, 1.7135, -0.0685, -0.1614, 0.0367, 1.0296,
    ]);
    let primaries = DMat3::from_cols(xyz(red), xyz(green), xyz(blue));
    let scale = primaries.inverse() * xyz(white);
    let ratio = (bradford * DVec3::from_array(D50)) / (bradford * xyz(white));
    bradford.inverse()
        * DMat3::from_diagonal(ratio)
        * bradford
        * primaries
        * DMat3::from_diagonal(scale)
}

/// A linear sRGB colour encoded in another space.
pub(super) fn encoded(linear: [f64; 3], space: [[f64; 2]; 4], curve: TransferFunction) -> [f64; 3] {
    let seen = to_d50(space).inverse() * to_d50(SRGB) * DVec3::from_array(linear);
    seen.to_array().map(|value| curve.encode(value))
}

fn fixed(value: f64) -> [u8; 4] {
    ((value * 65536.0).round() as i32).to_be_bytes()
}

fn xyz_tag(value: DVec3) -> Vec<u8> {
    [b"XYZ \0\0\0\0".to_vec(), value.to_array().map(fixed).concat()].concat()
}

fn curve_tag(curve: TransferFunction) -> Vec<u8> {
    let (kind, numbers) = match curve {
        TransferFunction::Srgb => {
            (3_u16, vec![2.4, 1.0 / 1.055, 0.055 / 1.055, 1.0 / 12.92, 0.04045])
        }
        TransferFunction::Power(exponent) => (0, vec![exponent]),
    };
    let numbers: Vec<u8> = numbers.into_iter().flat_map(fixed).collect();
    [b"para\0\0\0\0".to_vec(), kind.to_be_bytes().to_vec(), vec![0; 2], numbers].concat()
}

/// An ICC profile with these tags.
fn profile(space: &[u8; 4], tags: &[(&[u8; 4], Vec<u8>)]) -> Vec<u8> {
    let mut table = (tags.len() as u32).to_be_bytes().to_vec();
    let mut body = vec![];
    for (name, data) in tags {
        let at = (128 + 4 + 12 * tags.len() + body.len()) as u32;
        table.extend([&name[..], &at.to_be_bytes(), &(data.len() as u32).to_be_bytes()].concat());
        body.extend_from_slice(data);
        body.resize(body.len().next_multiple_of(4), 0);
    }
    let mut head = vec![0; 128];
    let size = (128 + table.len() + body.len()) as u32;
    head[..4].copy_from_slice(&size.to_be_bytes());
    head[8..12].copy_from_slice(&0x0430_0000_u32.to_be_bytes());
    head[12..24].copy_from_slice(&[b"mntr", &space[..], b"XYZ "].concat());
    head[36..40].copy_from_slice(b"acsp");
    head[68..80].copy_from_slice(&D50.map(fixed).concat());
    [head, table, body].concat()
}

fn name_tag(name: &str) -> Vec<u8> {
    let text: Vec<u8> = name.encode_utf16().flat_map(u16::to_be_bytes).collect();
    let head = [1_u32, 12, 0x656E_5553, text.len() as u32, 28].map(u32::to_be_bytes).concat();
    [b"mluc\0\0\0\0".to_vec(), head, text].concat()
}

/// A profile of a matrix and a curve.
pub(super) fn matrix_profile(space: [[f64; 2]; 4], curve: TransferFunction) -> Vec<u8> {
    let columns = to_d50(space);
    profile(
        b"RGB ",
        &[
            (b"desc", name_tag("of a test")),
            (b"wtpt", xyz_tag(DVec3::from_array(D50))),
            (b"rXYZ", xyz_tag(columns.x_axis)),
            (b"gXYZ", xyz_tag(columns.y_axis)),
            (b"bXYZ", xyz_tag(columns.z_axis)),
            (b"rTRC", curve_tag(curve)),
            (b"gTRC", curve_tag(curve)),
            (b"bTRC", curve_tag(curve)),
        ],
    )
}

/// A grey profile with a curve.
pub(super) fn grey_profile(curve: TransferFunction) -> Vec<u8> {
    profile(b"GRAY", &[(b"desc", name_tag("grey")), (b"kTRC", curve_tag(curve))])
}

/// A profile for print.
pub(super) fn ink_profile() -> Vec<u8> {
    profile(b"CMYK", &[(b"desc", name_tag("Coated"))])
}

/// A profile of tables alone: curves of 256 steps, and a 2 x 2 x 2 lattice with the XYZ of its corners.
pub(super) fn table_profile(space: [[f64; 2]; 4], exponent: f64) -> Vec<u8> {
    let columns = to_d50(space);
    let mut tag = b"mft2\0\0\0\0\x03\x03\x02\0".to_vec();
    tag.extend(DMat3::IDENTITY.to_cols_array().into_iter().flat_map(fixed));
    let word = |value: f64| ((value * 65535.0).round().clamp(0.0, 65535.0) as u16).to_be_bytes();
    tag.extend([256_u16, 2].map(u16::to_be_bytes).concat());
    for _ in 0..3 {
        tag.extend((0..256).flat_map(|step| word((f64::from(step) / 255.0).powf(exponent))));
    }
    for corner in 0..8 {
        let linear = DVec3::new(
            f64::from(corner >> 2 & 1),
            f64::from(corner >> 1 & 1),
            f64::from(corner & 1),
        );
        // 1.0 in XYZ is 0x8000.
        tag.extend(
            (columns * linear)
                .to_array()
                .into_iter()
                .flat_map(|value| word(value * 32768.0 / 65535.0)),
        );
    }
    for _ in 0..3 {
        tag.extend([0.0, 1.0].into_iter().flat_map(word));
    }
    profile(
        b"RGB ",
        &[
            (b"desc", name_tag("tables")),
            (b"wtpt", xyz_tag(DVec3::from_array(D50))),
            (b"A2B0", tag),
        ],
    )
}

fn chunk(name: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let body = [&name[..], data].concat();
    let crc = !body.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 * (crc & 1)))
    });
    [&(data.len() as u32).to_be_bytes()[..], &body, &crc.to_be_bytes()].concat()
}

fn deflated(data: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(vec![], Compression::fast());
    encoder.write_all(data).unwrap();
    encoder.finish().unwrap()
}

/// A row of 16-bit colours as a PNG with these chunks.
pub(super) fn png(colours: &[[f64; 3]], chunks: &[(&[u8; 4], Vec<u8>)]) -> Vec<u8> {
    let head = [&(colours.len() as u32).to_be_bytes()[..], &1_u32.to_be_bytes(), &[16, 2, 0, 0, 0]]
        .concat();
    let mut file = [b"\x89PNG\r\n\x1a\n".to_vec(), chunk(b"IHDR", &head)].concat();
    chunks.iter().for_each(|(name, data)| file.extend(chunk(name, data)));
    let row = [vec![0], words(colours, u16::to_be_bytes)].concat();
    file.extend(chunk(b"IDAT", &deflated(&row)));
    file.extend(chunk(b"IEND", &[]));
    file
}

fn words(colours: &[[f64; 3]], bytes: fn(u16) -> [u8; 2]) -> Vec<u8> {
    let code = |value: &f64| (value.clamp(0.0, 1.0) * 65535.0).round() as u16;
    colours.as_flattened().iter().flat_map(|value| bytes(code(value))).collect()
}

/// The data of an iCCP chunk.
pub(super) fn iccp(profile: &[u8]) -> Vec<u8> {
    [b"name\0\0".to_vec(), deflated(profile)].concat()
}

/// The data of gAMA and cHRM chunks.
pub(super) fn hundred_thousandths(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| ((value * 1e5).round() as u32).to_be_bytes()).collect()
}

/// A row of 16-bit colours as a TIFF with a profile.
pub(super) fn tiff(colours: &[[f64; 3]], profile: &[u8]) -> Vec<u8> {
    let pixels = words(colours, u16::to_le_bytes);
    let (bits, pixels_at) = (8_u32, 8 + 6);
    let profile_at = pixels_at + pixels.len() as u32;
    let directory = profile_at + profile.len() as u32;
    let entries: [(u16, u16, u32, u32); 10] = [
        (256, 4, 1, colours.len() as u32),
        (257, 4, 1, 1),
        (258, 3, 3, bits),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, pixels_at),
        (277, 3, 1, 3),
        (278, 4, 1, 1),
        (279, 4, 1, pixels.len() as u32),
        (34675, 7, profile.len() as u32, profile_at),
    ];
    let mut file =
        [b"II*\0".to_vec(), directory.to_le_bytes().to_vec(), [16, 0].repeat(3)].concat();
    file.extend(pixels);
    file.extend_from_slice(profile);
    file.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in entries {
        file.extend(
            [
                &tag.to_le_bytes()[..],
                &kind.to_le_bytes(),
                &count.to_le_bytes(),
                &value.to_le_bytes(),
            ]
            .concat(),
        );
    }
    file.extend([0; 4]);
    file
}

/// Inserts segments after the start of a JPEG.
pub(super) fn with_segments(jpeg: &[u8], segments: &[(u8, Vec<u8>)]) -> Vec<u8> {
    let mut file = jpeg[..2].to_vec();
    for (marker, data) in segments {
        file.extend([0xFF, *marker]);
        file.extend((data.len() as u16 + 2).to_be_bytes());
        file.extend_from_slice(data);
    }
    file.extend_from_slice(&jpeg[2..]);
    file
}

/// A profile split into APP2 segments of a given size in bytes.
pub(super) fn profile_segments(profile: &[u8], bytes: usize) -> Vec<(u8, Vec<u8>)> {
    let parts = profile.chunks(bytes);
    let count = parts.len() as u8;
    let part = |(number, part): (u8, &[u8])| {
        (0xE2, [&b"ICC_PROFILE\0"[..], &[number, count], part].concat())
    };
    (1..).zip(parts).map(part).collect()
}

/// An Exif segment with a colour space and an interoperability index.
pub(super) fn exif(space: Option<u16>, index: Option<&[u8; 4]>) -> (u8, Vec<u8>) {
    let directory = |entries: &[(u16, u16, u32, [u8; 4])]| {
        let mut bytes = (entries.len() as u16).to_le_bytes().to_vec();
        for (tag, kind, count, value) in entries {
            bytes.extend(
                [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), value].concat(),
            );
        }
        [bytes, vec![0; 4]].concat()
    };
    // IFD 0, at 8, has one entry and 18 bytes; the Exif IFD follows, then the interoperability IFD.
    let mut below = vec![];
    let at = 26 + 6 + 12 * (u32::from(space.is_some()) + u32::from(index.is_some()));
    below.extend(space.map(|space| (0xA001, 3, 1, u32::from(space).to_le_bytes())));
    below.extend(index.map(|_| (0xA005, 4, 1, at.to_le_bytes())));
    let first = directory(&[(0x8769, 4, 1, 26_u32.to_le_bytes())]);
    let inter = index.map(|index| directory(&[(1, 2, 4, *index)])).unwrap_or_default();
    (0xE1, [b"Exif\0\0II*\0\x08\0\0\0".to_vec(), first, directory(&below), inter].concat())
}
