//! `nightsplat doctor`: which devices there are, and whether they will do.

use std::io::Write;

use anyhow::Result;
use serde::Serialize;

use crate::Error;
use crate::gpu::{CooperativeMatrix, DeviceReport, devices};

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
    devices: &'a [DeviceReport],
    /// Index of the device that is used unless `--device` picks another.
    chosen: Option<usize>,
}

/// Prints the report.
///
/// # Errors
/// There is no Vulkan, or no device that meets every requirement (which is printed nevertheless).
pub fn run(args: &DoctorArgs) -> Result<()> {
    let devices = devices()?;
    let chosen = chosen(&devices);
    let text = if args.json {
        serde_json::to_string_pretty(&Output { devices: &devices, chosen })?
    } else {
        table(&devices, chosen)
    };
    writeln!(std::io::stdout().lock(), "{}", text.trim_end())?;
    let lacking = devices.first().and_then(|device| Some((device.name.clone(), device.missing()?)));
    match (chosen, lacking) {
        (None, Some((device, feature))) => {
            Err(Error::MissingFeature { device, feature: feature.to_owned() }.into())
        }
        _ => Ok(()),
    }
}

/// The first that lacks nothing, as [`DeviceChoice::Best`](crate::gpu::DeviceChoice::Best) has it.
fn chosen(devices: &[DeviceReport]) -> Option<usize> {
    devices.iter().position(|device| device.missing().is_none())
}

fn table(devices: &[DeviceReport], chosen: Option<usize>) -> String {
    let mut text = String::new();
    for (index, device) in devices.iter().enumerate() {
        let DeviceReport { name, kind, api_version, subgroup_size, memory, .. } = device;
        let requirements = &device.requirements;
        let gib = *memory as f64 / f64::from(1 << 30);
        text += &format!(
            "{index}  {name}\n   {kind}, Vulkan {api_version}, subgroups of {subgroup_size}, {gib:.1} GiB\n"
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
    match chosen {
        Some(index) => text + &format!("device {index} is used unless --device picks another"),
        None => text + "no device will do",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::RequirementReport;

    fn device(name: &str, is_recent: bool) -> DeviceReport {
        let requirement = |name, met| RequirementReport { name, why: "it is needed", met };
        DeviceReport {
            name: name.to_owned(),
            kind: "discrete",
            api_version: "1.3.0".to_owned(),
            subgroup_size: 32,
            memory: 3 << 29,
            cooperative_matrix: is_recent.then_some(CooperativeMatrix { m: 8, n: 16, k: 32 }),
            requirements: vec![requirement("Vulkan 1.3", true), requirement("shiny", is_recent)],
        }
    }

    #[test]
    fn the_first_device_that_lacks_nothing_is_chosen_and_what_others_lack_is_shown() {
        let devices = [device("Abacus", false), device("Babbage", true), device("Curta", true)];
        assert_eq!(chosen(&devices), Some(1));
        let table = table(&devices, chosen(&devices));
        assert!(
            table.starts_with("0  Abacus\n   discrete, Vulkan 1.3.0, subgroups of 32, 1.5 GiB\n")
        );
        assert!(
            table.contains("   yes  Vulkan 1.3  it is needed\n   no   shiny       it is needed\n")
        );
        assert!(table.contains("also 8x16x32 matrices") && table.contains("no 16-bit matrices"));
        assert!(table.ends_with("device 1 is used unless --device picks another"));
    }

    #[test]
    fn where_no_device_will_do_none_is_chosen() {
        let devices = [device("Abacus", false)];
        assert_eq!(chosen(&devices), None);
        assert!(table(&devices, None).ends_with("no device will do"));
    }
}
