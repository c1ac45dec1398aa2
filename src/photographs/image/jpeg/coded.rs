//! The coded data of a JPEG's scans (ITU-T T.81, annexes F and G): whether it holds every block of the picture.
//!
//! libjpeg makes up what is missing, in grey, and says nothing. So each scan's Huffman codes are walked without decoding a
//! pixel; a scan that ends early or holds a code that there is not is damage.

/// The codes of a DHT segment.
pub(super) struct Codes {
    /// Length and symbol by the next [`SHORT`] bits; length 0 where the code is longer or none.
    short: Vec<(u8, u8)>,
    /// By length: the code behind the last one, aligned to 16 bits, and where its symbols begin less the first code.
    ends: [(u32, i32); 17],
    symbols: Vec<u8>,
}

const SHORT: u32 = 9;

impl Codes {
    /// `counts` of codes by length from 1, and their symbols in order.
    pub(super) fn new(counts: &[u8; 16], symbols: &[u8]) -> Self {
        let mut codes =
            Self { short: vec![(0, 0); 1 << SHORT], ends: [(0, 0); 17], symbols: symbols.to_vec() };
        let (mut next, mut place) = (0_u32, 0);
        for (length, &count) in (1..=16).zip(counts) {
            next *= 2;
            codes.ends[length as usize].1 = place as i32 - next as i32;
            for &symbol in &symbols[place..place + usize::from(count)] {
                if length <= SHORT {
                    let first = (next << (SHORT - length)) as usize;
                    codes.short[first..first + (1 << (SHORT - length))]
                        .fill((length as u8, symbol));
                }
                next += 1;
            }
            place += usize::from(count);
            codes.ends[length as usize].0 = next << (16 - length);
        }
        codes
    }
}

/// The bits of coded data up to the next marker.
struct Bits<'a> {
    rest: &'a [u8],
    /// The next bits, from the highest.
    held: u64,
    count: u32,
}

impl<'a> Bits<'a> {
    fn new(rest: &'a [u8]) -> Self {
        Self { rest, held: 0, count: 0 }
    }

    fn fill(&mut self) {
        while self.count <= 56 {
            let length = match self.rest {
                [0xFF, 0x00, ..] => 2,
                [0xFF, ..] | [] => return,
                _ => 1,
            };
            self.held |= u64::from(self.rest[0]) << (56 - self.count);
            self.count += 8;
            self.rest = &self.rest[length..];
        }
    }

    fn skip(&mut self, bits: u32) -> Option<()> {
        if self.count < bits {
            self.fill();
        }
        self.count = self.count.checked_sub(bits)?;
        self.held <<= bits;
        Some(())
    }

    /// The next bits as a number.
    fn take(&mut self, bits: u32) -> Option<u32> {
        if bits == 0 {
            return Some(0);
        }
        self.fill();
        let value = (self.held >> (64 - bits)) as u32;
        self.skip(bits).map(|()| value)
    }

    fn symbol(&mut self, codes: &Codes) -> Option<u8> {
        if self.count < 16 {
            self.fill();
        }
        let (length, symbol) = codes.short[(self.held >> (64 - SHORT)) as usize];
        if length > 0 {
            return self.skip(length.into()).map(|()| symbol);
        }
        let next = (self.held >> 48) as u32;
        let length = (SHORT + 1..=16).find(|&length| next < codes.ends[length as usize].0)?;
        let place = codes.ends[length as usize].1 + (next >> (16 - length)) as i32;
        self.skip(length)?;
        codes.symbols.get(usize::try_from(place).ok()?).copied()
    }

    /// Goes on behind the restart marker that has to come now.
    fn restart(&mut self) -> Option<()> {
        // What fills the last byte is no data.
        self.fill();
        while self.rest.starts_with(&[0xFF, 0xFF]) {
            self.rest = &self.rest[1..];
        }
        match self.rest {
            [0xFF, 0xD0..=0xD7, rest @ ..] => {
                *self = Self::new(rest);
                Some(())
            }
            _ => None,
        }
    }
}

/// What a scan brings of each block.
#[derive(Clone, Copy)]
pub(super) enum Part {
    /// All of it.
    Whole,
    /// Its mean, but for the last bits.
    Mean,
    /// A bit more of its mean.
    MeanBit,
    /// Coefficients of a band, but for the last bits.
    Band(u32, u32),
    /// A bit more of those.
    BandBit(u32, u32),
}

/// A component in a scan.
pub(super) struct Coded<'a> {
    /// Blocks of it in a unit.
    pub(super) blocks: usize,
    /// The codes of the means, and of the other coefficients; where the part needs none, none.
    pub(super) codes: [Option<&'a Codes>; 2],
}

/// Whether the data begins with `units` of the scan's blocks. `seen` says of each block of a progressive picture which
/// coefficients are not zero so far.
pub(super) fn is_whole(
    data: &[u8],
    part: Part,
    components: &[Coded<'_>],
    units: usize,
    restart_interval: usize,
    seen: &mut [u64],
) -> bool {
    walk(data, part, components, units, restart_interval, seen).is_some()
}

fn walk(
    data: &[u8],
    part: Part,
    components: &[Coded<'_>],
    units: usize,
    restart_interval: usize,
    seen: &mut [u64],
) -> Option<()> {
    let mut bits = Bits::new(data);
    // Blocks that an end-of-band run still covers.
    let mut run = 0;
    for unit in 0..units {
        if restart_interval > 0 && unit > 0 && unit % restart_interval == 0 {
            bits.restart()?;
            run = 0;
        }
        for component in components {
            for _ in 0..component.blocks {
                let [mean, others] = component.codes;
                match part {
                    Part::Whole => {
                        let length = bits.symbol(mean?)?;
                        bits.skip(length.into())?;
                        coefficients(&mut bits, others?)?;
                    }
                    Part::Mean => {
                        let length = bits.symbol(mean?)?;
                        bits.skip(length.into())?;
                    }
                    Part::MeanBit => bits.skip(1)?,
                    Part::Band(first, last) => {
                        band(&mut bits, others?, [first, last], &mut run, seen.get_mut(unit)?)?;
                    }
                    Part::BandBit(first, last) => {
                        band_bit(&mut bits, others?, [first, last], &mut run, seen.get_mut(unit)?)?;
                    }
                }
            }
        }
    }
    Some(())
}

/// The coefficients of a block but its mean.
fn coefficients(bits: &mut Bits<'_>, codes: &Codes) -> Option<()> {
    let mut k = 1;
    while k < 64 {
        let symbol = bits.symbol(codes)?;
        let (zeros, length) = (u32::from(symbol >> 4), u32::from(symbol & 15));
        if length == 0 {
            if zeros < 15 {
                return Some(());
            }
            k += 16;
            continue;
        }
        k += zeros + 1;
        bits.skip(length)?;
    }
    // libjpeg takes a run of zeros beyond the last coefficient.
    Some(())
}

/// The first bits of a band.
fn band(
    bits: &mut Bits<'_>,
    codes: &Codes,
    [first, last]: [u32; 2],
    run: &mut u32,
    seen: &mut u64,
) -> Option<()> {
    if *run > 0 {
        *run -= 1;
        return Some(());
    }
    let mut k = first;
    while k <= last {
        let symbol = bits.symbol(codes)?;
        let (zeros, length) = (u32::from(symbol >> 4), u32::from(symbol & 15));
        if length == 0 {
            if zeros < 15 {
                *run = (1 << zeros) - 1 + bits.take(zeros)?;
                return Some(());
            }
            k += 16;
            continue;
        }
        k += zeros;
        bits.skip(length)?;
        *seen |= 1_u64.checked_shl(k).unwrap_or(0);
        k += 1;
    }
    Some(())
}

/// One bit more of a band: of each coefficient that is not zero, and where new ones are.
fn band_bit(
    bits: &mut Bits<'_>,
    codes: &Codes,
    [first, last]: [u32; 2],
    run: &mut u32,
    seen: &mut u64,
) -> Option<()> {
    let mut k = first;
    while *run == 0 && k <= last {
        let symbol = bits.symbol(codes)?;
        let (mut zeros, is_new) = (u32::from(symbol >> 4), symbol & 15 != 0);
        if is_new {
            bits.skip(1)?;
        } else if zeros < 15 {
            *run = (1 << zeros) + bits.take(zeros)?;
            break;
        }
        while k <= last {
            if *seen >> k & 1 == 1 {
                bits.skip(1)?;
            } else if zeros == 0 {
                break;
            } else {
                zeros -= 1;
            }
            k += 1;
        }
        if is_new && k <= last {
            *seen |= 1 << k;
        }
        k += 1;
    }
    if *run > 0 {
        let known = (k..=last).filter(|&k| *seen >> k & 1 == 1).count();
        bits.skip_many(known)?;
        *run -= 1;
    }
    Some(())
}

impl Bits<'_> {
    fn skip_many(&mut self, bits: usize) -> Option<()> {
        (0..bits).try_for_each(|_| self.skip(1))
    }
}
