//! `nightsplat doctor`: which devices there are, and whether they will do.

use std::io::Write;

use anyhow::Result;
use serde::Serialize;

use crate::Error;
use crate::gpu::{
    CooperativeMatrix, DeviceChoice, DeviceReport, SUBGROUP_VARIABLE, SchedulerVariables, devices,
};

/// List the Vulkan devices, what training requires, and whether each device offers it.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct DoctorArgs {
    /// Print the list as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Output<'a> {
    devices: Vec<Listed<'a>>,
    /// Index of the device that is used unless `--device` picks another.
    chosen: Option<usize>,
    /// The variables of a scheduler that picked it.
    reason: Option<String>,
}

#[derive(Serialize)]
struct Listed<'a> {
    #[serde(flatten)]
    report: &'a DeviceReport,
    /// The names of the requirements that it does not meet.
    missing: Vec<&'static str>,
}

/// Prints the report.
///
/// # Errors
/// There is no Vulkan, or no device that meets every requirement, or a scheduler's variables name none (what there is, is
/// printed nevertheless).
pub fn run(args: &DoctorArgs) -> Result<()> {
    let devices = devices()?;
    let picked = SchedulerVariables::of_this_process().pick(&DeviceChoice::Best, &devices);
    let reason = picked.as_ref().ok().and_then(|picked| picked.reason.clone());
    let checked = picked.and_then(|picked| match devices[picked.index].missing() {
        None => Ok(picked.index),
        Some(feature) => {
            let (device, feature) = (devices[picked.index].name.clone(), feature.to_owned());
            Err(Error::MissingFeature { device, feature })
        }
    });
    let chosen = checked.as_ref().ok().copied();
    let text = if args.json {
        let listed =
            |report| Listed { report, missing: DeviceReport::all_missing(report).collect() };
        let devices = devices.iter().map(listed).collect();
        serde_json::to_string_pretty(&Output { devices, chosen, reason })?
    } else {
        table(&devices, chosen, reason.as_deref())
    };
    writeln!(std::io::stdout().lock(), "{}", text.trim_end())?;
    checked?;
    Ok(())
}

fn table(devices: &[DeviceReport], chosen: Option<usize>, reason: Option<&str>) -> String {
    let mut text = String::new();
    for (index, device) in devices.iter().enumerate() {
        let DeviceReport { name, kind, api_version, uuid, pci, subgroup_size, memory, .. } = device;
        let others = device.subgroup_sizes.iter().filter(|size| *size != subgroup_size);
        let others = others.map(ToString::to_string).collect::<Vec<_>>().join(", ");
        let others = match others.as_str() {
            "" => String::new(),
            others => format!(" ({SUBGROUP_VARIABLE}: or {others})"),
        };
        let pci = pci.map_or_else(String::new, |address| format!(", pci:{address}"));
        let requirements = &device.requirements;
        let gib = *memory as f64 / f64::from(1 << 30);
        text += &format!(
            "{index}  {name}\n   {kind}, Vulkan {api_version}, subgroups of {subgroup_size}{others}, {gib:.1} GiB\n   uuid:{uuid}{pci}\n"
        );
        let width = requirements.iter().map(|requirement| requirement.name.len()).max();
        let width = width.unwrap_or(0);
        for requirement in requirements {
            let met = if requirement.met { "yes" } else { "no" };
            text += &format!("   {met:3}  {:width$}  {}\n", requirement.name, requirement.why);
        }
        // An option, not a requirement.
        text += &match device.cooperative_matrix {
            Some(CooperativeMatrix { m, n, k }) => {
                format!("   also {m}x{n}x{k} matrices of 16 bits, for --denoiser-precision half\n")
            }
            None => "   no 16-bit matrices: --denoiser-precision half is single\n".to_owned(),
        };
        text += "\n";
    }
    let reason = reason.map_or_else(String::new, |reason| format!(" ({reason})"));
    match chosen {
        Some(index) => {
            text + &format!("device {index} is used{reason} unless --device picks another")
        }
        None => text + "no device will do",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{DeviceLimits, RequirementReport};

    fn device(name: &str, is_recent: bool) -> DeviceReport {
        let requirement = |name, met| RequirementReport { name, why: "it is needed", met };
        DeviceReport {
            name: name.to_owned(),
            kind: "discrete",
            api_version: "1.3.0".to_owned(),
            vendor: 1,
            uuid: "00-11".to_owned(),
            pci: is_recent.then_some("65:1.2".parse().unwrap()),
            subgroup_size: 32,
            subgroup_sizes: if is_recent { vec![16, 32] } else { vec![32] },
            memory: 3 << 29,
            limits: DeviceLimits::default(),
            cooperative_matrix: is_recent.then_some(CooperativeMatrix { m: 8, n: 16, k: 32 }),
            requirements: vec![requirement("Vulkan 1.3", true), requirement("shiny", is_recent)],
        }
    }

    #[test]
    fn the_table_says_what_each_device_is_and_lacks_and_which_is_used() {
        let devices = [device("Abacus", false), device("Babbage", true), device("Curta", true)];
        let text = table(&devices, Some(1), None);
        assert!(text.starts_with(
            "0  Abacus\n   discrete, Vulkan 1.3.0, subgroups of 32, 1.5 GiB\n   uuid:00-11\n"
        ));
        assert!(text.contains("   uuid:00-11, pci:0000:65:01.2\n"), "{text}");
        assert!(text.contains("subgroups of 32 (NIGHTSPLAT_SUBGROUP: or 16), 1.5 GiB"), "{text}");
        assert!(
            text.contains("   yes  Vulkan 1.3  it is needed\n   no   shiny       it is needed\n")
        );
        assert!(text.contains("also 8x16x32 matrices") && text.contains("no 16-bit matrices"));
        assert!(text.ends_with("device 1 is used unless --device picks another"));
        let by_a_scheduler = table(&devices, Some(2), Some("CUDA_VISIBLE_DEVICES=1"));
        assert!(
            by_a_scheduler.ends_with(
                "device 2 is used (CUDA_VISIBLE_DEVICES=1) unless --device picks another"
            )
        );
    }

    #[test]
    fn where_no_device_will_do_none_is_chosen() {
        assert!(table(&[device("Abacus", false)], None, None).ends_with("no device will do"));
    }
}
