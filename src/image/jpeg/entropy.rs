//! From a scan's bits to coefficients (ITU T.81, annexes F and G).

use super::{Component, Picture, next_marker};

/// The place of each coefficient in its block, in the order of the file.
pub(super) const ZIGZAG: [usize; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20,
    13, 6, 7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59,
    52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// A canonical Huffman code: by length, the first code, how many there are and where their symbols begin.
#[derive(Clone, Debug)]
pub(super) struct Huffman {
    lengths: [(u32, u32, usize); 16],
    symbols: Vec<u8>,
}

impl Huffman {
    pub(super) fn new(counts: &[u8; 16], symbols: &[u8]) -> Self {
        let (mut code, mut begin) = (0, 0);
        let lengths = counts.map(|count| {
            let length = (code, u32::from(count), begin);
            code = (code + u32::from(count)) << 1;
            begin += usize::from(count);
            length
        });
        Self { lengths, symbols: symbols.to_vec() }
    }

    fn symbol(&self, bits: &mut Bits<'_>) -> Option<u8> {
        let ahead = bits.peek(16);
        for (length, &(first, count, begin)) in (1..).zip(&self.lengths) {
            let code = ahead >> (16 - length);
            if code >= first && code - first < count {
                bits.skip(length);
                return self.symbols.get(begin + (code - first) as usize).copied();
            }
        }
        None
    }
}

/// The bits of a scan, the first of a byte on top. Zeros follow where the data ends.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    held: u64,
    held_count: u32,
    /// How many of those held are not in the file.
    missing: u32,
}

impl Bits<'_> {
    /// The next bits, 16 at most.
    fn peek(&mut self, count: u32) -> u32 {
        while self.held_count <= 32 {
            let byte = match self.bytes.get(self.at..).unwrap_or_default() {
                [0xFF, 0x00, ..] => {
                    self.at += 2;
                    0xFF
                }
                [0xFF, ..] | [] => {
                    self.missing += 8;
                    0
                }
                [byte, ..] => {
                    self.at += 1;
                    *byte
                }
            };
            self.held = self.held << 8 | u64::from(byte);
            self.held_count += 8;
        }
        (self.held >> (self.held_count - count)) as u32 & ((1 << count) - 1)
    }

    fn skip(&mut self, count: u32) {
        self.held_count -= count;
    }

    fn take(&mut self, count: u32) -> i32 {
        let bits = self.peek(count);
        self.skip(count);
        bits as i32
    }

    /// A number of so many bits, whose first says its sign.
    fn signed(&mut self, count: u8) -> Option<i32> {
        let count = u32::from(count);
        if count > 15 {
            return None;
        }
        let bits = self.take(count);
        Some(if bits < (1 << count) >> 1 { bits - (1 << count) + 1 } else { bits })
    }

    /// Forgets what is left of the bits; none where more of them were taken than there are.
    fn end(&mut self) -> Option<()> {
        let is_whole = self.missing <= self.held_count;
        (self.held_count, self.missing) = (0, 0);
        is_whole.then_some(())
    }
}

/// The tables of Huffman codes, for DC and AC.
pub(super) type Codes = [[Option<Huffman>; 4]; 2];

/// What a scan brings of some components.
#[derive(Debug)]
pub(super) struct Scan {
    /// Indices of its components, with the tables for DC and AC.
    pub(super) components: Vec<(usize, [usize; 2])>,
    /// The first and the last coefficient, in the order of the file.
    pub(super) band: [usize; 2],
    /// The lowest bit of an earlier scan, 0 where there was none, and that of this one.
    pub(super) bits: [u32; 2],
    /// Units between two restart markers; 0: there are none.
    pub(super) restart_interval: usize,
}

/// What one block leaves behind for the next.
struct State {
    dc: [i32; 4],
    /// Blocks to come that have nothing more in this band.
    empty_blocks: i32,
}

impl Scan {
    /// Decodes the data at `at`, which moves to the marker behind it; none where it is damaged.
    pub(super) fn read(
        &self,
        picture: &mut Picture,
        codes: &Codes,
        bytes: &[u8],
        at: &mut usize,
    ) -> Option<()> {
        let mut bits = Bits { bytes, at: *at, held: 0, held_count: 0, missing: 0 };
        let mut state = State { dc: [0; 4], empty_blocks: 0 };
        // A scan of one component goes block by block through what is seen of it, others by units of all components.
        let single = self.components.len() == 1;
        let [columns, rows] =
            if single { picture.components[self.components[0].0].blocks } else { picture.units };
        for unit in 0..columns * rows {
            if self.restart_interval > 0 && unit > 0 && unit % self.restart_interval == 0 {
                bits.end()?;
                let expected = 0xD0 + (unit / self.restart_interval - 1) as u8 % 8;
                if next_marker(bytes, &mut bits.at)? != expected {
                    return None;
                }
                state = State { dc: [0; 4], empty_blocks: 0 };
            }
            for (slot, &(index, tables)) in self.components.iter().enumerate() {
                let Component { sampling, stride, coefficients, .. } =
                    &mut picture.components[index];
                let [width, height] = if single { [1, 1] } else { *sampling };
                let [dc, ac] = [0, 1].map(|kind| codes[kind][tables[kind]].as_ref());
                for offset in 0..width * height {
                    let column = unit % columns * width + offset % width;
                    let row = unit / columns * height + offset / width;
                    let block = &mut coefficients[row * *stride + column];
                    match (picture.is_progressive, self.band[0], self.bits[0]) {
                        (false, ..) => {
                            state.first_dc(slot, block, &mut bits, dc?, 0)?;
                            state.first_ac(block, &mut bits, ac?, [1, 63], 0)?;
                        }
                        (_, 0, 0) => state.first_dc(slot, block, &mut bits, dc?, self.bits[1])?,
                        (_, 0, _) => block[0] |= (bits.take(1) << self.bits[1]) as i16,
                        (_, _, 0) => {
                            state.first_ac(block, &mut bits, ac?, self.band, self.bits[1])?;
                        }
                        _ => state.refine_ac(block, &mut bits, ac?, self.band, self.bits[1])?,
                    }
                }
            }
        }
        *at = bits.at;
        bits.end()
    }
}

impl State {
    fn first_dc(
        &mut self,
        slot: usize,
        block: &mut [i16; 64],
        bits: &mut Bits<'_>,
        code: &Huffman,
        low: u32,
    ) -> Option<()> {
        let count = code.symbol(bits)?;
        self.dc[slot] = self.dc[slot].wrapping_add(bits.signed(count)?);
        block[0] = (self.dc[slot] << low) as i16;
        Some(())
    }

    fn first_ac(
        &mut self,
        block: &mut [i16; 64],
        bits: &mut Bits<'_>,
        code: &Huffman,
        [mut place, last]: [usize; 2],
        low: u32,
    ) -> Option<()> {
        if self.empty_blocks > 0 {
            self.empty_blocks -= 1;
            return Some(());
        }
        while place <= last {
            let symbol = code.symbol(bits)?;
            let (zeros, count) = (symbol >> 4, symbol & 15);
            if count == 0 && zeros < 15 {
                // Sequential files end one block at a time: their symbol has no bits behind it.
                self.empty_blocks = (1 << zeros) - 1 + bits.take(zeros.into());
                break;
            }
            place += usize::from(zeros);
            if count > 0 {
                *block.get_mut(*ZIGZAG.get(place)?)? = (bits.signed(count)? << low) as i16;
            }
            place += 1;
        }
        Some(())
    }

    fn refine_ac(
        &mut self,
        block: &mut [i16; 64],
        bits: &mut Bits<'_>,
        code: &Huffman,
        [mut place, last]: [usize; 2],
        low: u32,
    ) -> Option<()> {
        let bit = 1i16 << low;
        let refine = |value: &mut i16, bits: &mut Bits<'_>| {
            if bits.take(1) == 1 && *value & bit == 0 {
                *value = value.wrapping_add(if *value < 0 { -bit } else { bit });
            }
        };
        while self.empty_blocks == 0 && place <= last {
            let symbol = code.symbol(bits)?;
            let (mut zeros, count) = (symbol >> 4, symbol & 15);
            let value = match count {
                0 if zeros < 15 => {
                    self.empty_blocks = (1 << zeros) + bits.take(zeros.into());
                    break;
                }
                0 => 0,
                1 if bits.take(1) == 1 => bit,
                1 => -bit,
                _ => return None,
            };
            // Over the zeros before it; what is no zero gets its bit on the way.
            while place <= last {
                let old = &mut block[ZIGZAG[place]];
                if *old != 0 {
                    refine(old, bits);
                } else if zeros == 0 {
                    *old = value;
                    break;
                } else {
                    zeros -= 1;
                }
                place += 1;
            }
            place += 1;
        }
        if self.empty_blocks > 0 {
            let rest = ZIGZAG[place..=last].iter();
            rest.for_each(|&place| {
                if block[place] != 0 {
                    refine(&mut block[place], bits);
                }
            });
            self.empty_blocks -= 1;
        }
        Some(())
    }
}
