//! The grammar of a JPEG file (ITU-T T.81, annex B), as far as libjpeg reads it.
//!
//! libjpeg reports errors by unwinding through C, which terminates a host that aborts on panics. Each rule here
//! corresponds to such an error and is checked first. In coded data libjpeg only warns ([`super::warnings`]).

use super::MAGIC;

/// Definitions in the segments read so far.
#[derive(Default)]
struct Definitions {
    quantization: [bool; 4],
    /// Huffman tables: those of DC coefficients, then those of AC coefficients.
    codes: [[bool; 4]; 2],
    frame: Option<FrameHeader>,
}

struct FrameHeader {
    is_progressive: bool,
    components: Vec<Component>,
}

struct Component {
    id: u8,
    /// Columns and rows of blocks in a minimum coded unit, which covers the same pixels in all components.
    sampling: [usize; 2],
    quantization: u8,
    has_scan: bool,
}

/// Whether libjpeg reads the file from its first to its last marker without an error.
pub(super) fn is_sound(bytes: &[u8]) -> bool {
    Definitions::default().read(bytes).is_some()
}

impl Definitions {
    fn read(&mut self, bytes: &[u8]) -> Option<()> {
        let mut rest = bytes.strip_prefix(&MAGIC)?;
        loop {
            // Bytes that are not a marker are coded data, or skipped like it.
            let at = rest.windows(2).position(|pair| matches!(pair, [0xFF, 0x01..=0xFE]))?;
            let marker = rest[at + 1];
            rest = &rest[at + 2..];
            match marker {
                0xD9 => {
                    let frame = self.frame.as_ref()?;
                    return frame.components.iter().all(|c| c.has_scan).then_some(());
                }
                // TEM and RST have no segment.
                0x01 | 0xD0..=0xD7 => continue,
                _ => {}
            }
            let length = u16::from_be_bytes(*rest.first_chunk()?);
            let (segment, after) = rest.split_at_checked(length.into())?;
            let segment = segment.get(2..)?;
            rest = after;
            match marker {
                0xC0..=0xC2 => self.start_frame(segment, marker == 0xC2, bytes.len())?,
                0xC4 => self.define_codes(segment)?,
                0xDB => self.define_quantization(segment)?,
                0xDA => self.start_scan(segment)?,
                0xDD if segment.len() == 2 => {}
                // DNL, APP and COM are not read.
                0xDC | 0xE0..=0xEF | 0xFE => {}
                _ => return None,
            }
        }
    }

    /// DQT.
    fn define_quantization(&mut self, mut segment: &[u8]) -> Option<()> {
        while let [number, rest @ ..] = segment {
            *self.quantization.get_mut(usize::from(number & 15))? = true;
            segment = rest.get(if number >> 4 == 0 { 64 } else { 128 }..)?;
        }
        Some(())
    }

    /// DHT.
    fn define_codes(&mut self, mut segment: &[u8]) -> Option<()> {
        while let [number, rest @ ..] = segment {
            let (counts, rest) = rest.split_first_chunk::<16>()?;
            let count = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(count)?;
            let class = usize::from(number >> 4);
            // The codes of one length follow those of shorter ones; the code of all ones is reserved.
            let mut next = 0;
            for (length, &count) in (1..).zip(counts) {
                next = 2 * next + u32::from(count);
                if next >= 1 << length {
                    return None;
                }
            }
            // A DC symbol is the number of bits of a difference.
            if count > 256 || class == 0 && symbols.iter().any(|&bits| bits > 11) {
                return None;
            }
            *self.codes.get_mut(class)?.get_mut(usize::from(number & 15))? = true;
            segment = rest;
        }
        Some(())
    }

    /// SOF: size and components of the image.
    fn start_frame(&mut self, segment: &[u8], is_progressive: bool, bytes: usize) -> Option<()> {
        let [8, y1, y0, x1, x0, count, components @ ..] = segment else { return None };
        let size = [[*x1, *x0], [*y1, *y0]].map(|side| usize::from(u16::from_be_bytes(side)));
        let (specifications, []) = components.as_chunks() else { return None };
        let components: Vec<Component> = specifications
            .iter()
            .map(|&[id, factors, quantization]| Component {
                id,
                sampling: [factors >> 4, factors & 15].map(usize::from),
                quantization,
                has_scan: false,
            })
            .collect();
        let most = |axis: usize| components.iter().map(|c| c.sampling[axis]).max();
        let sampling = [most(0)?, most(1)?];
        // Upsampling factors are whole numbers.
        let is_whole =
            |factor: usize, most: usize| (1..=4).contains(&factor) && most.is_multiple_of(factor);
        let has_own_id = |(i, c): (usize, &Component)| components[..i].iter().all(|o| o.id != c.id);
        if self.frame.is_some()
            || components.len() != usize::from(*count)
            || !matches!(count, 1 | 3 | 4)
            || size.iter().any(|side| !(1..=65_500).contains(side))
            || components.iter().any(|c| (0..2).any(|i| !is_whole(c.sampling[i], sampling[i])))
            || !components.iter().enumerate().all(has_own_id)
        {
            return None;
        }
        let units: usize = (0..2).map(|i| size[i].div_ceil(8 * sampling[i])).product();
        let blocks = |component: &Component| units * component.blocks();
        // A block takes at least a bit: a larger declared size would only waste memory. And libjpeg sums the DC
        // differences of a progressive image, of 11 bits each, in 32 bits.
        if components.iter().map(blocks).sum::<usize>() > 8 * bytes
            || is_progressive && components.iter().any(|component| blocks(component) > 1 << 20)
        {
            return None;
        }
        self.frame = Some(FrameHeader { is_progressive, components });
        Some(())
    }

    /// SOS: the components and coefficients of the coded data that follows.
    fn start_scan(&mut self, segment: &[u8]) -> Option<()> {
        let FrameHeader { is_progressive, components } = self.frame.as_mut()?;
        let (&count, rest) = segment.split_first()?;
        let (selected, &[first, last, bits]) = rest.split_at_checked(2 * usize::from(count))?
        else {
            return None;
        };
        let (before, bits) = (bits >> 4, bits & 15);
        let is_band =
            if first == 0 { last == 0 } else { (first..64).contains(&last) && count == 1 };
        let is_refinement = before == bits + 1;
        if *is_progressive && !(is_band && bits <= 13 && (before == 0 || is_refinement)) {
            return None;
        }
        let reads =
            if *is_progressive { [first == 0 && before == 0, first > 0] } else { [true; 2] };
        let mut blocks = 0;
        let mut after = components.iter_mut();
        for &[id, codes] in selected.as_chunks().0 {
            // In the order of the frame.
            let component = after.find(|component| component.id == id)?;
            let numbers = [codes >> 4, codes & 15].map(usize::from);
            let is_quantized = self.quantization.get(usize::from(component.quantization));
            if !*is_progressive && component.has_scan
                || is_quantized != Some(&true)
                || (0..2).any(|class| {
                    reads[class] && self.codes[class].get(numbers[class]) != Some(&true)
                })
            {
                return None;
            }
            component.has_scan = true;
            blocks += component.blocks();
        }
        if count > 1 && !(1..=10).contains(&blocks) {
            return None;
        }
        Some(())
    }
}

impl Component {
    /// Blocks in a minimum coded unit.
    fn blocks(&self) -> usize {
        self.sampling.iter().product()
    }
}
