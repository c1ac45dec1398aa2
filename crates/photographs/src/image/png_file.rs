//! PNG row by row: the whole takes no memory that its rows do not need.

use std::io::Cursor;

use ::image::error::{DecodingError, ImageFormatHint};
use ::image::{ImageError, ImageFormat};
use png::{BitDepth, ColorType, Decoder, Transformations};

use super::budget::{self, Permit};
use super::levels::SampleFormat;
use super::rows::Rows;

/// The magic number of PNG files.
pub(super) const MAGIC: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

/// Decodes the rows of an image; `false` where they are not read here.
pub(super) fn read(bytes: &[u8], rows: &mut Rows<'_>) -> Result<bool, ImageError> {
    let limits = budget::limits().max_alloc.unwrap_or_default();
    let limits = png::Limits { bytes: usize::try_from(limits).unwrap_or(usize::MAX) };
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_ignore_text_chunk(true);
    // `colour` reads it, and limits it.
    decoder.set_ignore_iccp_chunk(true);
    decoder.set_transformations(Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(error)?;
    let (colours, depth) = reader.output_color_type();
    let format = match depth {
        BitDepth::Eight => SampleFormat::Eight,
        BitDepth::Sixteen => SampleFormat::Sixteen,
        _ => return Ok(false),
    };
    if colours == ColorType::Indexed {
        return Ok(false);
    }
    rows.begin(reader.info().size(), format, colours.samples());
    let mut push = |row: &[u8]| match format {
        SampleFormat::Sixteen => {
            rows.push16(|at| u16::from_be_bytes([row[2 * at], row[2 * at + 1]]))
        }
        _ => rows.push8(row),
    };
    if reader.info().interlaced {
        let _permit = Permit::wait(reader.output_buffer_size() as u64);
        let mut whole = vec![0; reader.output_buffer_size()];
        let line = reader.next_frame(&mut whole).map_err(error)?.line_size;
        let _ = whole.chunks_exact(line.max(1)).try_for_each(push);
        return Ok(true);
    }
    while let Some(row) = reader.next_row().map_err(error)? {
        if push(row.data()).is_break() {
            break;
        }
    }
    Ok(true)
}

/// Width and height that the header declares; `None` where it is damaged. Nothing else is read or unpacked.
pub(super) fn size(bytes: &[u8]) -> Option<(u32, u32)> {
    let header = bytes.strip_prefix(&MAGIC)?.get(4..)?.strip_prefix(b"IHDR")?;
    let side = |at: usize| Some(u32::from_be_bytes(header.get(at..at + 4)?.try_into().ok()?));
    Some((side(0)?, side(4)?)).filter(|&(width, height)| width > 0 && height > 0)
}

/// As the decoder of whole images has it.
fn error(error: png::DecodingError) -> ImageError {
    match error {
        png::DecodingError::IoError(error) => ImageError::IoError(error),
        other => {
            let format = ImageFormatHint::Exact(ImageFormat::Png);
            ImageError::Decoding(DecodingError::new(format, other))
        }
    }
}
