//! The cache of training photographs on the device; those that do not fit are in a spool file.
//!
//! The file contains the device's bytes, so the cache changes no bit of the model. It is unnamed if the system allows
//! it, and disappears with the run.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use crate::gpu::Gpu;
use crate::targets::pseudo_gt::EncodedPlanes;
use crate::{Error, Result};

/// The default share of photographs in the memory of the device and of the host.
const SHARE: f64 = 0.25;

/// Memory for the training photographs, on the device and decoded on the host: bytes, such as `512M` or `4G`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct CacheSize(pub u64);

/// Suffixes and their powers of 2.
const UNITS: [(char, u32); 4] = [('K', 10), ('M', 20), ('G', 30), ('T', 40)];

/// A smaller number needs a unit, bytes.
const MIN_BYTES: f64 = 1_048_576.0;

impl std::str::FromStr for CacheSize {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let upper = text.trim().to_ascii_uppercase();
        let plain = upper.trim_end_matches('B').trim_end_matches('I');
        let unit = UNITS.iter().find(|(letter, _)| plain.ends_with(*letter));
        let number = unit.map_or(plain, |(letter, _)| plain.trim_end_matches(*letter)).trim();
        let bytes = number
            .parse::<f64>()
            .map(|number| number * 2.0_f64.powi(unit.map_or(0, |(_, power)| *power).cast_signed()));
        // Written so that a NaN fails. A small number without a unit probably means gibibytes.
        match bytes {
            Ok(bytes) if plain == upper && unit.is_none() && bytes > 0.0 && bytes < MIN_BYTES => {
                Err(Error::Usage(format!("`{text}` is in bytes; write its unit, as in {text}G")))
            }
            Ok(bytes) if (0.0..1e18).contains(&bytes) => Ok(Self(bytes as u64)),
            _ => Err(Error::Usage(format!(
                "`{text}` is not a size of memory; write it with its unit, as in 512M, 4G or 1.5G"
            ))),
        }
    }
}

impl std::fmt::Display for CacheSize {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self(bytes) = *self;
        let unit = UNITS.iter().rev().find(|(_, power)| bytes > 0 && bytes % (1 << power) == 0);
        match unit {
            Some((letter, power)) => write!(out, "{}{letter}", bytes >> power),
            None => write!(out, "{bytes}B"),
        }
    }
}

impl TryFrom<String> for CacheSize {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<CacheSize> for String {
    fn from(size: CacheSize) -> Self {
        size.to_string()
    }
}

impl CacheSize {
    /// Bytes of decoded photographs that the host may keep: `size`, or a quarter of `most` or of the host's memory;
    /// `None` if unknown.
    pub(super) fn on_host(size: Option<Self>, most: Option<Self>) -> Option<u64> {
        let most = || most.map(|Self(bytes)| bytes).or_else(host_memory);
        size.map(|Self(bytes)| bytes).or_else(|| Some((SHARE * most()? as f64) as u64))
    }

    /// Bytes that the device may keep: `size`, or a quarter of `most` or of the device's memory.
    pub(super) fn on_device(size: Option<Self>, most: Option<Self>, gpu: &Gpu) -> u64 {
        let most = most.map_or(gpu.properties().memory, |Self(bytes)| bytes);
        size.map_or((SHARE * most as f64) as u64, |Self(bytes)| bytes)
    }
}

/// The host's memory in bytes; `None` if the system does not report it.
fn host_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? << 10)
}

/// The cache of photographs on the device.
#[derive(Debug)]
pub(super) struct Cache {
    gpu: Gpu,
    kept: Vec<CachedImage>,
    /// Resident photographs by the time of their last use.
    on_device: BTreeSet<(u64, usize)>,
    budget: u64,
    /// Bytes on the device.
    taken: u64,
    /// Counts requests.
    clock: u64,
    folder: Option<PathBuf>,
    /// Created when a photograph does not fit.
    spool: Option<Arc<Spool>>,
}

/// The index of a photograph in the cache.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CacheSlot(usize);

/// A photograph on the device, in the file, or both.
#[derive(Debug)]
pub(super) struct CachedImage {
    on_device: Option<Arc<EncodedPlanes>>,
    in_file: Option<InFile>,
    bytes: u64,
    /// The time of its last use.
    asked: u64,
}

impl Cache {
    /// A cache of `budget` bytes on the device, which spools to `folder` or to the system's temporary folder.
    pub(super) fn new(gpu: &Gpu, budget: u64, folder: Option<PathBuf>) -> Self {
        let (kept, on_device) = (vec![], BTreeSet::new());
        Self { gpu: gpu.clone(), kept, on_device, budget, taken: 0, clock: 0, folder, spool: None }
    }

    /// Adds a photograph, which stays on the device if it fits.
    pub(super) fn keep(&mut self, photograph: EncodedPlanes) -> Result<CacheSlot> {
        let index = self.kept.len();
        let bytes = photograph.bytes();
        self.kept.push(CachedImage {
            in_file: None,
            bytes,
            asked: 0,
            on_device: Some(Arc::new(photograph)),
        });
        self.on_device.insert((0, index));
        self.taken += bytes;
        if self.taken > self.budget {
            self.evict(index)?;
        }
        Ok(CacheSlot(index))
    }

    /// The size of a photograph on the device, in bytes.
    pub(super) fn bytes(&self, CacheSlot(index): CacheSlot) -> u64 {
        self.kept[index].bytes
    }

    /// A resident photograph.
    pub(super) fn on_device(&self, CacheSlot(index): CacheSlot) -> Result<&EncodedPlanes> {
        let absent = || Error::Usage("a training photograph is not on the device".to_owned());
        self.kept[index].on_device.as_deref().ok_or_else(absent)
    }

    /// A photograph, resident or not.
    pub(super) fn load(&self, CacheSlot(index): CacheSlot) -> Result<Arc<EncodedPlanes>> {
        match &self.kept[index] {
            CachedImage { on_device: Some(photograph), .. } => Ok(Arc::clone(photograph)),
            CachedImage { in_file: Some(in_file), .. } => Ok(Arc::new(in_file.load(&self.gpu)?)),
            _ => Err(Error::Usage("a photograph is missing from the cache".to_owned())),
        }
    }

    /// Whether all photographs stay resident.
    pub(super) fn holds_all(&self) -> bool {
        self.spool.is_none()
    }

    /// The most bytes that can be resident at once.
    pub(super) fn budget(&self) -> u64 {
        self.budget
    }

    /// Makes `wanted` resident until the next call, evicting the least recently used.
    pub(super) fn make_resident(&mut self, wanted: &[CacheSlot]) -> Result<()> {
        self.clock += 1;
        for &CacheSlot(index) in wanted {
            let kept = &mut self.kept[index];
            if self.on_device.remove(&(kept.asked, index)) {
                self.on_device.insert((self.clock, index));
            }
            kept.asked = self.clock;
        }
        for &CacheSlot(index) in wanted {
            let CachedImage { on_device: None, bytes, .. } = self.kept[index] else { continue };
            while self.taken + bytes > self.budget {
                let oldest = self.on_device.first().copied();
                let Some((_, idle)) = oldest.filter(|(asked, _)| *asked < self.clock) else {
                    break;
                };
                self.evict(idle)?;
            }
            let kept = &mut self.kept[index];
            if let Some(in_file) = &kept.in_file {
                kept.on_device = Some(Arc::new(in_file.load(&self.gpu)?));
                self.on_device.insert((self.clock, index));
                self.taken += bytes;
            }
        }
        Ok(())
    }

    /// Evicts a photograph; the first time, it is written to the spool file.
    fn evict(&mut self, index: usize) -> Result<()> {
        let kept = &mut self.kept[index];
        let Some(photograph) = kept.on_device.take() else { return Ok(()) };
        self.on_device.remove(&(kept.asked, index));
        if kept.in_file.is_none() {
            let spool = match &self.spool {
                Some(spool) => Arc::clone(spool),
                None => {
                    let folder = self.folder.clone().unwrap_or_else(std::env::temp_dir);
                    let gib = self.budget as f64 / f64::from(1 << 30);
                    tracing::info!(
                        "the photographs exceed the device's cache of {gib:.2} GiB; the rest is spooled to {}",
                        folder.display()
                    );
                    Arc::new(Spool::new(&folder)?)
                }
            };
            kept.in_file = Some(InFile::save(&self.gpu, &photograph, &spool)?);
            self.spool = Some(spool);
        }
        self.taken -= kept.bytes;
        Ok(())
    }
}

/// The position of a photograph in the spool file.
#[derive(Debug)]
struct InFile {
    spool: Arc<Spool>,
    name: String,
    offset: u64,
    code_bits: u32,
    value_count: usize,
    /// The number of words of codes, and of the table that follows them.
    lens: [usize; 2],
}

impl InFile {
    fn save(gpu: &Gpu, photograph: &EncodedPlanes, spool: &Arc<Spool>) -> Result<Self> {
        let EncodedPlanes { code_bits, value_count, codes, values } = photograph;
        let name = if codes.is_empty() { values.name() } else { codes.name() }.to_owned();
        let (codes, values) = (gpu.read(codes)?, gpu.read(&**values)?);
        let parts = [bytemuck::cast_slice(&codes), bytemuck::cast_slice(&values)];
        Ok(Self {
            spool: Arc::clone(spool),
            name,
            offset: spool.append(&parts)?,
            code_bits: *code_bits,
            value_count: *value_count,
            lens: [codes.len(), values.len()],
        })
    }

    fn load(&self, gpu: &Gpu) -> Result<EncodedPlanes> {
        let &Self { ref spool, ref name, offset, code_bits, value_count, lens } = self;
        let codes: Vec<u32> = spool.read(offset, lens[0])?;
        let values: Vec<f32> =
            spool.read(offset + size_of_val(codes.as_slice()) as u64, lens[1])?;
        Ok(EncodedPlanes {
            code_bits,
            value_count,
            codes: gpu.buffer(name, &codes)?,
            values: Arc::new(gpu.buffer(if codes.is_empty() { name } else { "palette" }, &values)?),
        })
    }
}

/// An append-only file.
#[derive(Debug)]
struct Spool {
    folder: PathBuf,
    file: Mutex<File>,
}

impl Spool {
    fn new(folder: &Path) -> Result<Self> {
        let file = tempfile::tempfile_in(folder).map_err(|error| unusable(folder, &error))?;
        Ok(Self { folder: folder.to_owned(), file: Mutex::new(file) })
    }

    /// Appends bytes and returns their offset.
    fn append(&self, parts: &[&[u8]]) -> Result<u64> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let mut append = || {
            let offset = file.seek(SeekFrom::End(0))?;
            parts.iter().try_for_each(|part| file.write_all(part))?;
            Ok(offset)
        };
        append().map_err(|error| unusable(&self.folder, &error))
    }

    fn read<T: bytemuck::Pod>(&self, offset: u64, len: usize) -> Result<Vec<T>> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let mut values = vec![T::zeroed(); len];
        file.seek(SeekFrom::Start(offset))
            .and_then(|_| file.read_exact(bytemuck::cast_slice_mut(&mut values)))
            .map_err(|error| unusable(&self.folder, &error))?;
        Ok(values)
    }
}

fn unusable(folder: &Path, error: &std::io::Error) -> Error {
    let problem = format!(
        "cannot hold the photographs that exceed the cache ({error}); raise `cache` or free disk space"
    );
    Error::output(folder, problem)
}

#[cfg(test)]
mod tests {
    use super::super::precision::Encoder;
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::targets::pseudo_gt::PseudoGt;
    use crate::train::PhotographBits;
    use nightsplat_photographs::tone::ToneSettings;

    #[test]
    fn sizes_are_read_with_and_without_units() {
        for (text, bytes, printed) in [
            ("4G", 4 << 30, "4G"),
            ("512m", 512 << 20, "512M"),
            ("1.5 GiB", 3 << 29, "1536M"),
            ("100kB", 100 << 10, "100K"),
            ("1000B", 1000, "1000B"),
            ("1048577", 1_048_577, "1048577B"),
            ("0", 0, "0B"),
        ] {
            let size: CacheSize = text.parse().unwrap();
            assert_eq!((size.0, size.to_string().as_str()), (bytes, printed), "{text}");
            assert_eq!(size.to_string().parse::<CacheSize>().unwrap(), size);
        }
        for text in ["", "G", "-1G", "much", "4X", "NaN", "4", "1000"] {
            assert!(text.parse::<CacheSize>().is_err(), "{text}");
        }
    }

    #[test]
    fn every_photograph_is_restored_bit_for_bit_whatever_the_cache_size() {
        let gpu = gpu();
        let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::default()).unwrap();
        let decoded = |photograph: &EncodedPlanes| {
            let mut scratch = gpu.uninit("decoded", 9000).unwrap();
            let mut plain = None;
            gpu.run("decode", |pass| {
                let decoded = pseudo_gt.record(pass, photograph, None, &mut scratch)?;
                plain = Some(pass.download(decoded)?);
                Ok(())
            })
            .unwrap();
            plain.unwrap().wait().unwrap()
        };
        // Few values are coded in 8 bits, more in 16, many are not coded.
        let values = |photograph: usize| -> Vec<f32> {
            let different = [7, 700, 100_000][photograph % 3];
            (0..9000).map(|i| ((i * 31 + photograph) % different) as f32 / 1e5).collect()
        };
        for budget in [0, 40_000, 1 << 30] {
            let mut cache = Cache::new(&gpu, budget, None);
            let mut encoder = Encoder::new(&gpu, PhotographBits::Exact);
            let kept = (0..7).map(|i| cache.keep(encoder.upload("low", &values(i)).unwrap()));
            let slots = kept.collect::<Result<Vec<_>>>().unwrap();
            assert_eq!(cache.holds_all(), budget == 1 << 30);
            for wanted in [&[0, 1][..], &[6], &[5, 2], &[3], &[0, 4], &[2]] {
                let of_wanted: Vec<CacheSlot> = wanted.iter().map(|&index| slots[index]).collect();
                cache.make_resident(&of_wanted).unwrap();
                for &index in wanted {
                    let brought = cache.on_device(slots[index]).unwrap();
                    assert!(decoded(brought) == values(index), "{budget}: {index}");
                }
                let kept = &cache.kept;
                let on_device: u64 =
                    kept.iter().filter(|one| one.on_device.is_some()).map(|one| one.bytes).sum();
                assert_eq!(on_device, cache.taken);
                let asked: u64 = wanted.iter().map(|&index| kept[index].bytes).sum();
                assert!(cache.taken <= budget.max(asked), "{} of {budget}", cache.taken);
            }
            for (index, &slot) in slots.iter().enumerate() {
                assert!(decoded(&cache.load(slot).unwrap()) == values(index));
            }
        }
    }
}
