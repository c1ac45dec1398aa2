//! What is fastest on this device, measured by `nightsplat bench --tune`: a small file in the user's cache folder.

use std::fmt;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

use nightsplat_core::output::write_whole;
use serde::{Deserialize, Serialize};

use super::limits::WORKGROUP;
use super::{Gpu, Properties};
use crate::{Error, Result};

/// The variable with the path of another file, or `off`: no file.
pub const TUNE_VARIABLE: &str = "NIGHTSPLAT_TUNE";

/// The pixels that a workgroup of the rasteriser renders, and how. In files: two, three or five numbers, in the order
/// of the fields; without the last ones, a subgroup has the tile to itself, and the device decides on the backward
/// pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<u32>", into = "Vec<u32>")]
pub struct Tile {
    /// Width and height, in pixels.
    pub size: [u32; 2],
    /// The number of subgroups, each of which has a part, one above the other: 1, 2 or 4.
    pub subgroups: u32,
    /// `None`: as suits the device.
    pub backward: Option<BackwardForm>,
}

/// How the backward pass blends the run of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BackwardForm {
    /// The splats of a segment of the run, which are blended side by side: a multiple of the device's lanes, or 0 for
    /// one segment.
    pub segment: u32,
    /// Where the gradients of a splat are summed over the pixels of a subgroup.
    pub sums: RecordSums,
}

/// Where values are summed over the lanes of a subgroup. In files: 0 or 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordSums {
    /// By shuffles of registers.
    Shuffles = 0,
    /// In shared memory, for at most 32 lanes of a GPU that has 48 kB of it.
    SharedMemory = 1,
}

impl RecordSums {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Shuffles, Self::SharedMemory];
}

impl Tile {
    /// The height of all parts.
    fn part(self) -> Option<[u32; 2]> {
        let [width, height] = self.size;
        let divides = [1, 2, 4].contains(&self.subgroups) && height.is_multiple_of(self.subgroups);
        divides.then(|| [width, height / self.subgroups])
    }
}

/// A tile of one subgroup.
impl From<[u32; 2]> for Tile {
    fn from(size: [u32; 2]) -> Self {
        Self { size, subgroups: 1, backward: None }
    }
}

impl TryFrom<Vec<u32>> for Tile {
    type Error = String;

    fn try_from(numbers: Vec<u32>) -> Result<Self, String> {
        match numbers[..] {
            [width, height] => Ok([width, height].into()),
            [width, height, subgroups] => Ok(Self { subgroups, ..[width, height].into() }),
            [width, height, subgroups, segment, sums @ 0..2] => {
                let backward = Some(BackwardForm { segment, sums: RecordSums::ALL[sums as usize] });
                Ok(Self { size: [width, height], subgroups, backward })
            }
            _ => Err("a tile is its width and height in pixels, how many subgroups share it, the splats of a segment, \
                      and 1 for sums in shared memory or 0"
                .to_owned()),
        }
    }
}

impl From<Tile> for Vec<u32> {
    fn from(Tile { size: [width, height], subgroups, backward }: Tile) -> Self {
        match backward {
            Some(BackwardForm { segment, sums }) => {
                vec![width, height, subgroups, segment, sums as u32]
            }
            None if subgroups == 1 => vec![width, height],
            None => vec![width, height, subgroups],
        }
    }
}

/// `16x8`, `16x16x4` of four subgroups, or `16x16x4 in segments of 128, summed by shuffles`.
impl fmt::Display for Tile {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let numbers = Vec::from(Self { backward: None, ..*self });
        let numbers: Vec<_> = numbers.iter().map(u32::to_string).collect();
        out.write_str(&numbers.join("x"))?;
        let Some(BackwardForm { segment, sums }) = self.backward else { return Ok(()) };
        match segment {
            0 => out.write_str(" in one segment")?,
            splats => write!(out, " in segments of {splats}")?,
        }
        out.write_str(match sums {
            RecordSums::Shuffles => ", summed by shuffles",
            RecordSums::SharedMemory => ", summed in shared memory",
        })
    }
}

/// How the intersections of a view are sorted by tile and depth. The order is the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sorting {
    /// All Gaussians by depth, then all intersections by tile.
    #[default]
    Whole,
    /// Each tile by itself.
    Tiles,
}

impl fmt::Display for Sorting {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Whole => "sorted as a whole",
            Self::Tiles => "sorted by tile",
        })
    }
}

/// The fastest tile for renders of `channels` values per pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TunedTile {
    /// Values per pixel.
    pub channels: usize,
    /// The tile.
    pub tile: Tile,
    /// The sort that is faster with it.
    #[serde(default)]
    pub sorting: Sorting,
}

/// What is fastest on a device.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tuning {
    /// A tile for each number of channels.
    pub tiles: Vec<TunedTile>,
    /// The number of strips that a view is divided into for SSIM, as far as the limits of their rows allow.
    pub ssim_strips: Option<NonZeroU32>,
}

/// The measurements, with device and driver.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TuningFile {
    device: String,
    driver: String,
    tiles: Vec<TunedTile>,
    #[serde(default)]
    ssim_strips: Option<NonZeroU32>,
}

impl Properties {
    /// Whether subgroups can share such tiles: each part has 1 to 32 rows of lanes, lanes fill rows of pixels or the
    /// reverse, all lanes fit a workgroup, the subgroups stay converged while others leave their loops, a segment has
    /// whole subgroups of splats, and sums fit where they are made: in shared memory, those of four subgroups of 32
    /// lanes take 37 kB with the splats that wait there. A software device runs one subgroup after the other.
    #[doc(hidden)]
    pub fn suits_tile(&self, tile: impl Into<Tile>) -> bool {
        let tile = tile.into();
        let lanes = u64::from(self.subgroup_size);
        tile.part().is_some_and(|[width, height]| {
            let lanes_fill_rows = lanes.is_multiple_of(width.max(1).into());
            let rows_fill_lanes = u64::from(width).is_multiple_of(lanes);
            let pixels = u64::from(width) * u64::from(height);
            let is_workgroup = lanes * u64::from(tile.subgroups) <= u64::from(WORKGROUP);
            let keeps_subgroups = self.has_uniform_subgroup_control_flow || self.is_cpu;
            let holds_sums = lanes <= 32 && self.max_shared_memory >= 48 << 10 && !self.is_cpu;
            let suits_form = |BackwardForm { segment, sums }: BackwardForm| {
                u64::from(segment).is_multiple_of(lanes)
                    && (sums == RecordSums::Shuffles || holds_sums)
            };
            (lanes_fill_rows || rows_fill_lanes)
                && pixels.is_multiple_of(lanes)
                && (1..=32).contains(&(pixels / lanes))
                && is_workgroup
                && (tile.subgroups == 1 || keeps_subgroups)
                && tile.backward.is_none_or(suits_form)
        })
    }
}

impl Gpu {
    /// What was fastest on this device and driver; nothing without measurements, or where the device is lent or opened
    /// for validation.
    fn tuning(&self) -> &Tuning {
        let measured = || {
            self.tuning_path().map_or_else(Tuning::default, |path| load(path, self.properties()))
        };
        self.shared.tuning.get_or_init(measured)
    }

    /// The tile that was fastest for the nearest number of channels.
    pub(crate) fn tuned_tile(&self, channels: usize) -> Option<TunedTile> {
        let far = |tuned: &&TunedTile| tuned.channels.abs_diff(channels);
        self.tuning().tiles.iter().min_by_key(far).copied()
    }

    /// See [`Tuning::ssim_strips`].
    pub(crate) fn tuned_ssim_strips(&self) -> Option<NonZeroU32> {
        self.tuning().ssim_strips
    }

    /// Saves the measurements for later runs; returns the file, or `None` where there is none.
    pub(crate) fn keep_tuning(&self, tuning: &Tuning) -> Result<Option<PathBuf>> {
        let Some(path) = self.tuning_path() else { return Ok(None) };
        let Properties { name, driver, .. } = self.properties();
        let Tuning { tiles, ssim_strips } = tuning.clone();
        let file = TuningFile { device: name.clone(), driver: driver.clone(), tiles, ssim_strips };
        let folder = path.parent().map_or(Ok(()), std::fs::create_dir_all);
        folder.map_err(|error| Error::output(path, format!("cannot be created ({error})")))?;
        write_whole(path, format!("{:#}\n", serde_json::json!(file)).as_bytes())?;
        Ok(Some(path.to_owned()))
    }

    fn tuning_path(&self) -> Option<&Path> {
        self.shared.owned.as_ref()?.tuning_path.as_deref()
    }
}

/// The file of this type of device; it records the driver.
pub(super) fn path(cache: Option<PathBuf>, vendor: u32, device: u32) -> Option<PathBuf> {
    match std::env::var_os(TUNE_VARIABLE).filter(|value| !value.is_empty()) {
        Some(value) if value == "off" => None,
        Some(value) => Some(value.into()),
        None => Some(cache?.join(format!("{vendor:x}-{device:x}.tiles.json"))),
    }
}

/// What the file says; nothing, with a line in the log, where that is not of this device.
fn load(path: &Path, properties: &Properties) -> Tuning {
    let tuning = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Tuning::default(),
        Err(error) => Err(format!("cannot be read ({error})")),
        Ok(bytes) => parsed(&bytes, properties),
    };
    tuning.unwrap_or_else(|problem| {
        let remedy = "`nightsplat bench --tune` measures again";
        tracing::warn!("{}: {problem}; it is ignored: {remedy}", path.display());
        Tuning::default()
    })
}

fn parsed(bytes: &[u8], properties: &Properties) -> Result<Tuning, String> {
    let damaged = |problem: String| format!("is damaged ({problem})");
    let TuningFile { device, driver, tiles, ssim_strips } =
        serde_json::from_slice(bytes).map_err(|error| damaged(error.to_string()))?;
    let Properties { name, driver: this_driver, subgroup_size, .. } = properties;
    if (&device, &driver) != (name, this_driver) {
        return Err(format!("was measured on {device}, {driver}; this is {name}, {this_driver}"));
    }
    let unsuitable = tiles.iter().find(|tuned| !properties.suits_tile(tuned.tile));
    unsuitable.map_or(Ok(()), |TunedTile { tile, .. }| {
        Err(damaged(format!("{tile} tiles do not suit {subgroup_size} lanes")))
    })?;
    Ok(Tuning { tiles, ssim_strips })
}

#[cfg(test)]
impl Properties {
    /// Those of a device that is not there.
    pub(crate) fn of_a_test() -> Self {
        Self {
            name: "Abacus 3000".to_owned(),
            driver: "beads 1.0".to_owned(),
            vendor: 0,
            memory: 0,
            subgroup_size: 8,
            subgroup_size_is_selectable: true,
            max_storage_buffer_range: 1 << 27,
            max_buffer_size: 1 << 30,
            max_workgroups: 65_535,
            max_shared_memory: 48 << 10,
            max_loop_iterations: u32::MAX,
            timestamp_bits: 64,
            timestamp_period: 1.0,
            is_cpu: false,
            cooperative_matrix: None,
            has_push_descriptors: true,
            has_uniform_subgroup_control_flow: true,
            driver_specializes: false,
            has_pipeline_statistics: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn properties() -> Properties {
        Properties::of_a_test()
    }

    fn shared(size: [u32; 2], subgroups: u32) -> Tile {
        Tile { subgroups, ..size.into() }
    }

    #[test]
    fn a_tile_has_1_to_32_rows_of_lanes() {
        let suits = |size: [u32; 2]| properties().suits_tile(size);
        assert!(suits([8, 1]) && suits([16, 16]) && suits([32, 8]));
        assert!(!suits([0, 8]) && !suits([3, 3]) && !suits([32, 16]) && !suits([u32::MAX; 2]));
        assert!(
            suits([24, 8]) && suits([4, 8]) && !suits([12, 8]),
            "lanes begin in the middle of a row"
        );
    }

    #[test]
    fn subgroups_share_a_tile_in_equal_parts() {
        let suits = |size, subgroups| properties().suits_tile(shared(size, subgroups));
        assert!(suits([16, 16], 2) && suits([16, 16], 4) && suits([16, 32], 2) && suits([8, 2], 2));
        assert!(!suits([16, 6], 4) && !suits([4, 4], 4) && !suits([16, 128], 4));
        assert!(!suits([16, 16], 0) && !suits([15, 24], 3) && !suits([16, 16], 8));
        let diverging = Properties { has_uniform_subgroup_control_flow: false, ..properties() };
        assert!(!diverging.suits_tile(shared([16, 16], 2)));
        assert!(diverging.suits_tile([16, 16]));
        let wide = Properties { subgroup_size: 128, ..properties() };
        assert!(wide.suits_tile(shared([16, 16], 2)));
        assert!(!wide.suits_tile(shared([32, 16], 4)), "512 lanes");
        let in_form = |device: &Properties, segment, sums| {
            let backward = Some(BackwardForm { segment, sums });
            device.suits_tile(Tile { backward, ..[16, 16].into() })
        };
        let in_segments = |segment| in_form(&properties(), segment, RecordSums::SharedMemory);
        assert!(in_segments(0) && in_segments(64) && !in_segments(60));
        let small = Properties { max_shared_memory: 32 << 10, ..properties() };
        for device in [&wide, &small] {
            assert_eq!(RecordSums::ALL.map(|sums| in_form(device, 128, sums)), [true, false]);
        }
    }

    #[test]
    fn a_tile_is_read_as_it_is_written() {
        for (tile, text) in [
            (Tile::from([16, 8]), "[16,8]"),
            (shared([16, 16], 4), "[16,16,4]"),
            (
                Tile {
                    backward: Some(BackwardForm { segment: 0, sums: RecordSums::SharedMemory }),
                    ..[16, 8].into()
                },
                "[16,8,1,0,1]",
            ),
        ] {
            assert_eq!(serde_json::to_string(&tile).unwrap(), text);
            assert_eq!(serde_json::from_str::<Tile>(text).unwrap(), tile);
        }
        assert_eq!(shared([16, 16], 4).to_string(), "16x16x4");
        for wrong in ["[16]", "[16,8,1,0]", "[16,8,1,0,2]"] {
            assert!(serde_json::from_str::<Tile>(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn only_an_intact_file_of_this_device_and_driver_is_used() {
        let tuning = |tile: [u32; 2]| {
            let tiles = vec![TunedTile { channels: 3, tile: tile.into(), sorting: Sorting::Tiles }];
            Tuning { tiles, ssim_strips: NonZeroU32::new(1536) }
        };
        let text = |device: &str, driver: &str, tile| {
            let Tuning { tiles, ssim_strips } = tuning(tile);
            let (device, driver) = (device.to_owned(), driver.to_owned());
            serde_json::json!(TuningFile { device, driver, tiles, ssim_strips }).to_string()
        };
        let read = |text: &str| parsed(text.as_bytes(), &properties());
        let whole = text("Abacus 3000", "beads 1.0", [16, 4]);
        assert_eq!(read(&whole).unwrap(), tuning([16, 4]));
        let older = whole.replace(r#","ssim_strips":1536"#, "");
        assert_eq!(read(&older).unwrap(), Tuning { ssim_strips: None, ..tuning([16, 4]) });
        let refused = |text: &str, part: &str| {
            let problem = read(text).unwrap_err();
            assert!(problem.contains(part) && !problem.contains('\n'), "{problem}");
        };
        refused(&text("Abacus 2000", "beads 1.0", [16, 4]), "measured on Abacus 2000, beads 1.0");
        refused(&text("Abacus 3000", "beads 0.9", [16, 4]), "this is Abacus 3000, beads 1.0");
        refused(&text("Abacus 3000", "beads 1.0", [5, 5]), "5x5 tiles do not suit 8 lanes");
        refused(&whole.replace("1536", "0"), "damaged");
        refused(&whole[..whole.len() / 2], "damaged");
        refused("", "damaged");
    }
}
