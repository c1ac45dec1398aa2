//! The driver's statistics of compiled kernels: registers, spills, memory.

use std::ffi::CStr;
use std::fmt::Debug;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};

use ash::{khr, vk};
use serde::Serialize;
use serde_json::{Value, json};

use super::Properties;
use crate::{Error, Result};

/// The variable with the path of a file that takes a line of JSON for every pipeline: the kernel, its constants, and
/// its [`Resources`].
const STATISTICS_VARIABLE: &str = "NIGHTSPLAT_STATISTICS";

/// The device extension for statistics.
pub(super) const EXTENSION: &CStr = khr::pipeline_executable_properties::NAME;

/// One statistic of a compiled kernel; names differ by driver.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistic {
    /// Its name and description, in the driver's words.
    pub name: String,
    /// Its value.
    pub value: f64,
}

/// What a compiled kernel occupies, whichever driver tells; absent where it does not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Resources {
    /// Vector registers of a lane; live ones where the driver counts those.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registers: Option<f64>,
    /// Registers moved to memory or to other registers for want of space, with the moves back.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spills: Option<f64>,
    /// Memory for spills and for arrays that are not in registers, bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scratch: Option<f64>,
    /// Memory of a workgroup, bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared: Option<f64>,
    /// Instructions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instructions: Option<f64>,
}

impl Resources {
    /// The names are, in this order: RADV's, NVK's, ANV's, Turnip's, NVIDIA's, AMD's own driver's; without regard to
    /// case. What a driver tells in several numbers is added up.
    pub fn from_statistics(statistics: &[Statistic]) -> Self {
        let sum = |names: &[&str]| {
            let is_meant =
                |told: &&Statistic| names.iter().any(|name| told.name.eq_ignore_ascii_case(name));
            statistics.iter().filter(is_meant).map(|told| told.value).reduce(|a, b| a + b)
        };
        Self {
            registers: sum(&[
                "VGPRs",
                "Number of GPRs",
                "Max live registers",
                "Registers used",
                "Register Count",
                "numUsedVgprs",
            ]),
            spills: sum(&[
                "Spilled VGPRs",
                "Spilled SGPRs",
                "Spills to memory",
                "Fills from memory",
                "Spill Count",
                "Fill Count",
                "Spills",
                "Fills",
                "STP Count",
                "LDP Count",
            ]),
            // The upper half of NVIDIA's number is no part of it (580.159: 16 in every kernel).
            scratch: sum(&[
                "Scratch size",
                "SLM size",
                "Scratch Memory Size",
                "Local Memory Size",
                "scratchMemUsageInBytes",
            ])
            .map(|bytes| bytes % 2f64.powi(32)),
            shared: sum(&[
                "LDS size",
                "Workgroup Memory Size",
                "Shared Memory Size",
                "ldsUsageSizeInBytes",
            ]),
            instructions: sum(&["Instructions", "Instruction count"]),
        }
    }

    /// Whether registers did not suffice.
    pub fn spill(self) -> bool {
        [self.spills, self.scratch].into_iter().flatten().any(|count| count > 0.0)
    }
}

/// The file that the variable names, if it is set.
pub(super) fn file() -> Option<PathBuf> {
    std::env::var_os(STATISTICS_VARIABLE).filter(|value| !value.is_empty()).map(PathBuf::from)
}

/// Appends a line for a pipeline to the file.
pub(super) fn log(
    path: &Path,
    kernel: &str,
    constants: &impl Debug,
    properties: &Properties,
    statistics: &[Statistic],
) -> Result<()> {
    append(path, &line(kernel, constants, properties, statistics)).map_err(|error| {
        Error::output(path, format!("cannot be written ({error}); {STATISTICS_VARIABLE} names it"))
    })
}

/// The constants are those of the kernel, by name.
fn line(
    kernel: &str,
    constants: &impl Debug,
    properties: &Properties,
    statistics: &[Statistic],
) -> Value {
    let constants = format!("{constants:?}");
    let named = constants.split_once('{').map_or("", |(_, named)| named);
    let mut line = json!({
        "device": properties.name,
        "driver": properties.driver,
        "subgroup_size": properties.subgroup_size,
        "kernel": kernel,
        "constants": named.trim_end_matches('}').trim(),
    });
    if let (Some(line), Value::Object(resources)) =
        (line.as_object_mut(), json!(Resources::from_statistics(statistics)))
    {
        line.extend(resources);
    }
    line
}

/// In one write, as several threads compile.
fn append(path: &Path, line: &Value) -> std::io::Result<()> {
    let mut file = OpenOptions::new().create(true).append(true).open(path)?;
    file.write_all(format!("{line}\n").as_bytes())
}

/// The driver's statistics of a pipeline that was created with `CAPTURE_STATISTICS`.
///
/// # Safety
/// The pipeline is live.
pub(super) unsafe fn read(
    functions: &khr::pipeline_executable_properties::Device,
    raw: vk::Pipeline,
) -> Result<Vec<Statistic>, vk::Result> {
    let info = vk::PipelineInfoKHR::default().pipeline(raw);
    let mut all = vec![];
    // SAFETY: as the caller promises; the infos point at live locals.
    unsafe {
        let executables = functions.get_pipeline_executable_properties(&info)?;
        for index in 0..executables.len() as u32 {
            let info = vk::PipelineExecutableInfoKHR::default();
            let info = info.pipeline(raw).executable_index(index);
            let statistics = functions.get_pipeline_executable_statistics(&info)?;
            all.extend(statistics.iter().map(Statistic::from));
        }
    }
    Ok(all)
}

impl From<&vk::PipelineExecutableStatisticKHR<'_>> for Statistic {
    fn from(told: &vk::PipelineExecutableStatisticKHR<'_>) -> Self {
        type Format = vk::PipelineExecutableStatisticFormatKHR;
        // SAFETY: the format says which member the driver wrote.
        let value = unsafe {
            match told.format {
                Format::BOOL32 => told.value.b32.into(),
                Format::INT64 => told.value.i64 as f64,
                Format::UINT64 => told.value.u64 as f64,
                _ => told.value.f64,
            }
        };
        let name = told.name_as_c_str().map(|name| name.to_string_lossy().into_owned());
        Self { name: name.unwrap_or_default(), value }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(statistics: &[(&str, f64)]) -> Vec<Statistic> {
        let statistic = |&(name, value): &(&str, f64)| Statistic { name: name.to_owned(), value };
        statistics.iter().map(statistic).collect()
    }

    #[test]
    fn the_statistics_of_each_driver_are_recognised() {
        let radv = [
            ("SGPRs", 128.0),
            ("VGPRs", 80.0),
            ("Spilled SGPRs", 1.0),
            ("Spilled VGPRs", 2.0),
            ("LDS size", 512.0),
            ("Scratch size", 64.0),
            ("Instructions", 869.0),
            ("Branches", 14.0),
        ];
        let nvk = [("Instruction count", 1233.0), ("Number of GPRs", 138.0), ("SLM Size", 0.0)];
        let anv = [
            ("Instruction Count", 862.0),
            ("Spill Count", 3.0),
            ("Fill Count", 4.0),
            ("Scratch Memory Size", 1024.0),
            ("Max live registers", 84.0),
            ("Workgroup Memory Size", 256.0),
        ];
        let anv_of_26 = [("Instructions", 862.0), ("Spills", 3.0), ("Fills", 4.0)];
        let read = |statistics: &[(&str, f64)]| Resources::from_statistics(&told(statistics));
        let resources = |numbers: [Option<f64>; 5]| {
            let [registers, spills, scratch, shared, instructions] = numbers;
            Resources { registers, spills, scratch, shared, instructions }
        };
        assert_eq!(read(&radv), resources([80.0, 3.0, 64.0, 512.0, 869.0].map(Some)));
        let expected = resources([Some(138.0), None, Some(0.0), None, Some(1233.0)]);
        assert_eq!(read(&nvk), expected);
        assert_eq!(read(&anv), resources([84.0, 7.0, 1024.0, 256.0, 862.0].map(Some)));
        let expected = resources([None, Some(7.0), None, None, Some(862.0)]);
        assert_eq!(read(&anv_of_26), expected);
        let nvidia = [
            ("Register Count", 44.0),
            ("Local Memory Size", 16.0 * 2f64.powi(32) + 16.0),
            ("Shared Memory Size", 0.0),
        ];
        let expected = resources([Some(44.0), None, Some(16.0), Some(0.0), None]);
        assert_eq!(read(&nvidia), expected);
        assert_eq!(read(&[]), Resources::default());
    }

    #[test]
    fn a_kernel_spills_if_the_driver_moves_registers_or_takes_scratch() {
        let spills =
            |statistics: &[(&str, f64)]| Resources::from_statistics(&told(statistics)).spill();
        assert!(spills(&[("Spilled VGPRs", 1.0)]) && spills(&[("SLM Size", 4.0)]));
        assert!(!spills(&[("Spilled VGPRs", 0.0), ("VGPRs", 256.0)]) && !spills(&[]));
    }
}
