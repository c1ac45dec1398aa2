//! `nightsplat doctor`: the Vulkan devices and whether they can train.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Result;
use serde::Serialize;

use super::{finish, print};
use crate::Error;
use crate::gpu::{
    CooperativeMatrix, DeviceChoice, DeviceReport, Gpu, SUBGROUP_VARIABLE, SchedulerVariables,
    devices,
};
use nightsplat_pose::how_to_install;

/// List the Vulkan devices and check what training requires of them.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct DoctorArgs {
    /// Print JSON instead of text
    #[arg(long)]
    pub json: bool,
    /// Compile every kernel on the device with this index, and print each before
    #[arg(long, hide = true, value_name = "INDEX")]
    pub compile: Option<usize>,
}

/// What `--json` prints.
#[derive(Serialize)]
struct DoctorOutput<'a> {
    devices: Vec<ListedDevice<'a>>,
    /// Index of the default device.
    chosen: Option<usize>,
    /// The variables of a scheduler that selected it.
    reason: Option<String>,
    /// The paths of programs that some commands run; null if not found.
    programs: BTreeMap<&'static str, Option<PathBuf>>,
    verdict: String,
}

#[derive(Serialize)]
struct ListedDevice<'a> {
    #[serde(flatten)]
    report: &'a DeviceReport,
    /// The names of unmet requirements.
    missing: Vec<&'static str>,
    /// `passed`, or the problem; null for a device that lacks a requirement.
    self_test: Option<String>,
}

/// Prints the report.
pub fn run(args: &DoctorArgs) -> Result<()> {
    if let Some(index) = args.compile {
        return compile(index);
    }
    let devices = devices()?;
    let tested = devices.iter().enumerate().map(|(index, device)| self_tested(index, device));
    let mut tested: Vec<_> = tested.collect();
    let picked = SchedulerVariables::of_this_process().pick(&DeviceChoice::Best, &devices);
    let reason = picked.as_ref().ok().and_then(|picked| picked.reason.clone());
    let self_tests: Vec<_> = tested.iter().map(described).collect();
    let checked = picked.and_then(|picked| match devices[picked.index].missing() {
        None => match tested[picked.index].take() {
            Some(Err(error)) => Err(error),
            _ => Ok(picked.index),
        },
        Some(feature) => {
            let (device, feature) = (devices[picked.index].name.clone(), feature.to_owned());
            Err(Error::MissingFeature { device, feature })
        }
    });
    let chosen = checked.as_ref().ok().copied();
    let programs: BTreeMap<_, _> =
        PROGRAMS.iter().map(|(name, _)| (*name, on_path(name))).collect();
    let verdict = verdict(chosen.map(|index| &devices[index]), reason.as_deref());
    let text = if args.json {
        let listed = |(report, self_test)| ListedDevice {
            report,
            missing: DeviceReport::all_missing(report).collect(),
            self_test,
        };
        let devices = devices.iter().zip(self_tests).map(listed).collect();
        serde_json::to_string_pretty(&DoctorOutput { devices, chosen, reason, programs, verdict })?
    } else {
        table(&devices, &self_tests) + &program_lines(&programs) + &verdict
    };
    print(text.trim_end())?;
    checked?;
    if !args.json {
        finish("", "nightsplat demo, or nightsplat diagnose photos");
    }
    Ok(())
}

/// Opens a device that meets the requirements, which tests it.
fn self_tested(index: usize, device: &DeviceReport) -> Option<crate::Result<()>> {
    device.missing().is_none().then(|| Gpu::open(&DeviceChoice::Index(index))?.self_test())
}

fn described(tested: &Option<crate::Result<()>>) -> Option<String> {
    let tested = tested.as_ref()?;
    Some(tested.as_ref().map_or_else(ToString::to_string, |()| "passed".to_owned()))
}

/// Compiles every kernel. A driver that crashes ends the process, and the last line names the kernel.
fn compile(index: usize) -> Result<()> {
    let mut printed = Ok(());
    let mut name = |kernel: &str| printed = print(kernel);
    name("self_test");
    Gpu::new(&DeviceChoice::Index(index))?.compile_all(name)?;
    Ok(printed?)
}

/// Programs that commands run, and for what.
const PROGRAMS: [(&str, &str); 2] =
    [("colmap", "camera poses (nightsplat pose)"), ("ffmpeg", "video (pose CLIP, render --video)")];

/// The path of a program on `PATH`.
fn on_path(program: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let name = format!("{program}{}", std::env::consts::EXE_SUFFIX);
    std::env::split_paths(&path).map(|folder| folder.join(&name)).find(|file| file.is_file())
}

fn program_lines(programs: &BTreeMap<&'static str, Option<PathBuf>>) -> String {
    let line = |(name, purpose): &(&'static str, &str)| match programs.get(name) {
        Some(Some(path)) => format!("{name}  {}, for {purpose}\n", path.display()),
        _ => format!("{name}  not found; install it for {purpose}: {}\n", how_to_install(name)),
    };
    PROGRAMS.iter().map(line).collect::<String>() + "\n"
}

/// A line on the default device.
fn verdict(chosen: Option<&DeviceReport>, reason: Option<&str>) -> String {
    let Some(DeviceReport { name, kind, .. }) = chosen else {
        return "not ready: no device meets the requirements".to_owned();
    };
    let reason = reason.map_or_else(String::new, |reason| format!(" ({reason})"));
    let speed = match *kind {
        "software" => "; a software device: minutes per scene, more with large photographs",
        _ => "",
    };
    format!("ready: trains on {name}{reason}{speed}; --device selects another")
}

/// What the self-test is about.
const SELF_TEST: &str = "subgroups, memory and functions do what the kernels rely on";

fn table(devices: &[DeviceReport], self_tests: &[Option<String>]) -> String {
    let mut text = String::new();
    for (index, (device, self_test)) in devices.iter().zip(self_tests).enumerate() {
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
            "{index}  {name}\n   {kind}, Vulkan {api_version}, subgroups of {subgroup_size}{others}, {gib:.1} \
             GiB\n   uuid:{uuid}{pci}\n"
        );
        let width = requirements.iter().map(|requirement| requirement.name.len()).max();
        let width = width.unwrap_or(0);
        for requirement in requirements {
            let met = if requirement.met { "yes" } else { "no" };
            text += &format!("   {met:3}  {:width$}  {}\n", requirement.name, requirement.why);
        }
        if let Some(found) = self_test {
            let met = if found == "passed" { "yes" } else { "no" };
            let why = if found == "passed" { SELF_TEST } else { found };
            text += &format!("   {met:3}  {:width$}  {why}\n", "self-test");
        }
        // Optional.
        text += &match device.cooperative_matrix {
            Some(CooperativeMatrix { m, n, k }) => {
                format!("   also {m}x{n}x{k} cooperative matrices of 16 bits, for --denoiser-precision half\n")
            }
            None => "   no 16-bit cooperative matrices: --denoiser-precision half falls back to single\n".to_owned(),
        };
        text += "\n";
    }
    text
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
            device: 2,
            driver: "beads 1.0".to_owned(),
            driver_version: 1,
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
    fn the_table_says_what_each_device_is_and_lacks_and_the_verdict_which_is_used() {
        let devices = [device("Abacus", false), device("Babbage", true), device("Curta", true)];
        let passed = || Some("passed".to_owned());
        let text = table(&devices, &[None, passed(), Some("exp is wrong".to_owned())]);
        assert!(text.contains("   yes  self-test   subgroups"), "{text}");
        assert!(text.contains("   no   self-test   exp is wrong\n"), "{text}");
        assert!(text.starts_with(
            "0  Abacus\n   discrete, Vulkan 1.3.0, subgroups of 32, 1.5 GiB\n   uuid:00-11\n"
        ));
        assert!(text.contains("   uuid:00-11, pci:0000:65:01.2\n"), "{text}");
        assert!(text.contains("subgroups of 32 (NIGHTSPLAT_SUBGROUP: or 16), 1.5 GiB"), "{text}");
        assert!(
            text.contains("   yes  Vulkan 1.3  it is needed\n   no   shiny       it is needed\n")
        );
        assert!(
            text.contains("also 8x16x32 cooperative") && text.contains("no 16-bit cooperative")
        );
        let printed = verdict(Some(&devices[1]), None);
        assert_eq!(printed, "ready: trains on Babbage; --device selects another");
        let printed = verdict(Some(&devices[2]), Some("CUDA_VISIBLE_DEVICES=1"));
        assert!(printed.contains("Curta (CUDA_VISIBLE_DEVICES=1)"), "{printed}");
        let software = DeviceReport { kind: "software", ..device("Abacus", true) };
        assert!(verdict(Some(&software), None).contains("minutes per scene"));
        assert!(verdict(None, None).starts_with("not ready"));
    }

    #[test]
    fn a_missing_program_is_listed_with_its_use_and_how_to_install_it() {
        let printed = program_lines(&BTreeMap::from([("ffmpeg", Some("/usr/bin/ffmpeg".into()))]));
        assert!(printed.contains("colmap  not found; install it for camera poses"), "{printed}");
        assert!(
            printed.contains("apt install colmap")
                && printed.contains("ffmpeg  /usr/bin/ffmpeg, for")
        );
    }
}
