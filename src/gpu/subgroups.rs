//! The subgroup size of the kernels, where the device leaves a choice.

use super::limits::{SUBGROUP_SIZES, WORKGROUP};
/// The variable with another size than the built-in one of the device.
pub const SUBGROUP_VARIABLE: &str = "NIGHTSPLAT_SUBGROUP";

const AMD: u32 = 0x1002;
const INTEL: u32 = 0x8086;
const QUALCOMM: u32 = 0x5143;
/// The fewest lanes that are built in: Intel's compilers offer no fewer.
const LEAST_BUILT_IN: u32 = 8;

/// The subgroup sizes of a device.
#[derive(Clone, Copy, Debug)]
pub(super) struct SubgroupSizes {
    /// The default size.
    pub(super) default: u32,
    /// Kernels can require another.
    pub(super) are_selectable: bool,
    pub(super) least: u32,
    pub(super) most: u32,
    /// The most subgroups of a workgroup.
    pub(super) workgroup_limit: u32,
}

impl SubgroupSizes {
    /// All sizes that kernels can be compiled for. Where none can be required, but the device has several, the
    /// self-test finds the one that it uses.
    pub(super) fn all(self) -> Vec<u32> {
        let powers = (0..u32::BITS).map(|power| 1 << power);
        let fit = |&size: &u32| {
            SUBGROUP_SIZES.contains(&size)
                && (self.least..=self.most).contains(&size)
                && WORKGROUP / size <= self.workgroup_limit
        };
        powers.filter(fit).collect()
    }

    /// AMD's drivers report 64, which RDNA issues as two successive halves of 32. With half as many lanes that wait for
    /// the last splat of a tile, 32 is the better choice for divergent kernels (AMD, RDNA whitepaper, 2019). GCN and
    /// CDNA only have 64.
    ///
    /// Intel's register file is divided among the lanes of a thread: with 32, and mostly with 16, the state of blending
    /// and of the backward passes does not fit, and hundreds of registers are spilled (compiled by Mesa 25 for Arc).
    /// Adreno reports 128, where a lane has half the registers of 64.
    ///
    /// Otherwise, and where no size can be required, the driver's choice is used.
    fn built_in(self, vendor: u32) -> u32 {
        let all = self.all();
        let wanted = match vendor {
            AMD => Some(32),
            INTEL => all.iter().copied().find(|&size| size >= LEAST_BUILT_IN),
            QUALCOMM => Some(64),
            _ => None,
        };
        wanted.filter(|size| self.are_selectable && all.contains(size)).unwrap_or(self.default)
    }
}

/// The lanes of the kernels: the built-in number, or the requested one.
pub(super) fn lanes(
    sizes: SubgroupSizes,
    vendor: u32,
    wanted: Option<&str>,
) -> Result<u32, String> {
    let Some(wanted) = wanted else { return Ok(sizes.built_in(vendor)) };
    let all = sizes.all();
    wanted.parse().ok().filter(|size| all.contains(size)).ok_or_else(|| {
        let all: Vec<String> = all.iter().map(u32::to_string).collect();
        format!("`{wanted}` is no size of its subgroups, which are of {} lanes", all.join(" or "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const NVIDIA: u32 = 0x10de;
    const APPLE: u32 = 0x106b;

    fn sizes(default: u32, [least, most]: [u32; 2]) -> SubgroupSizes {
        SubgroupSizes { default, are_selectable: true, least, most, workgroup_limit: 32 }
    }

    #[test]
    fn the_built_in_size_is_the_drivers_except_for_rdna_intel_and_adreno() {
        for (vendor, sizes, expected) in [
            (NVIDIA, sizes(32, [32, 32]), 32),
            (AMD, sizes(64, [32, 64]), 32),
            (AMD, sizes(64, [64, 64]), 64),
            (AMD, SubgroupSizes { are_selectable: false, ..sizes(64, [32, 64]) }, 64),
            (INTEL, sizes(32, [8, 32]), 8),
            (INTEL, sizes(32, [16, 32]), 16),
            (INTEL, SubgroupSizes { workgroup_limit: 16, ..sizes(32, [8, 32]) }, 16),
            (INTEL, SubgroupSizes { are_selectable: false, ..sizes(32, [8, 32]) }, 32),
            (QUALCOMM, sizes(128, [64, 128]), 64),
            (QUALCOMM, sizes(128, [128, 128]), 128),
            (APPLE, SubgroupSizes { are_selectable: false, ..sizes(32, [4, 32]) }, 32),
        ] {
            assert_eq!(lanes(sizes, vendor, None), Ok(expected), "{vendor:x} {sizes:?}");
        }
    }

    #[test]
    fn a_requested_size_must_be_one_of_the_devices() {
        let intel = sizes(32, [8, 32]);
        assert_eq!(lanes(intel, INTEL, Some("16")), Ok(16));
        assert_eq!(SubgroupSizes { workgroup_limit: 16, ..intel }.all(), [16, 32]);
        for wanted in ["48", "64", "4", "0", "-8", "all"] {
            let problem = lanes(intel, INTEL, Some(wanted)).unwrap_err();
            assert!(problem.contains(wanted) && problem.contains("8 or 16 or 32"), "{problem}");
        }
        let fixed = SubgroupSizes { are_selectable: false, ..sizes(32, [32, 32]) };
        assert!(lanes(fixed, INTEL, Some("16")).is_err());
        assert_eq!(lanes(fixed, INTEL, Some("32")), Ok(32));
        // The self-test tells whether it is the one.
        let doubtful = SubgroupSizes { are_selectable: false, ..sizes(64, [4, 64]) };
        assert_eq!(lanes(doubtful, AMD, Some("32")), Ok(32));
    }
}
