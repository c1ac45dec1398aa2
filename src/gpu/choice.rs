//! Device selection: the user's choice, and the devices that a scheduler's variables leave visible.
//!
//! Schedulers assign GPUs by `CUDA_VISIBLE_DEVICES`, `ROCR_VISIBLE_DEVICES` and `HIP_VISIBLE_DEVICES`, which Vulkan
//! ignores: without this module every job of a node would run on its first GPU.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::{DeviceReport, PciAddress};
use crate::{Error, Result};

/// Which device to use.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The first that meets all requirements: discrete before integrated, virtual, and software devices; only of those
    /// that `CUDA_VISIBLE_DEVICES`, `ROCR_VISIBLE_DEVICES` and `HIP_VISIBLE_DEVICES` leave, in their order.
    #[default]
    Best,
    /// By index in [`devices`](super::devices). This choice and those below ignore the variables.
    Index(usize),
    /// By a part of the name, case-insensitive.
    Name(String),
    /// By the first digits of `VkPhysicalDeviceIDProperties::deviceUUID`: lower-case hexadecimal, without dashes.
    Uuid(String),
    /// By PCI address.
    Pci(PciAddress),
    /// A software device.
    Cpu,
}

impl FromStr for DeviceChoice {
    type Err = Error;

    /// A number is an index; `uuid:`, `pci:` and `cpu` are those choices; an empty text is the best device; anything
    /// else is a part of the name.
    fn from_str(text: &str) -> Result<Self> {
        if let Some(uuid) = text.strip_prefix("uuid:") {
            let problem = || {
                Error::Usage(format!(
                    "`{text}` is no UUID: 32 hexadecimal digits, or the first of them"
                ))
            };
            return uuid_digits(uuid).map(Self::Uuid).ok_or_else(problem);
        }
        if let Some(address) = text.strip_prefix("pci:") {
            return address.parse().map(Self::Pci);
        }
        Ok(match (text, text.parse()) {
            ("", _) => Self::Best,
            ("cpu", _) => Self::Cpu,
            (_, Ok(index)) => Self::Index(index),
            (_, Err(_)) => Self::Name(text.to_owned()),
        })
    }
}

impl fmt::Display for DeviceChoice {
    /// Completes "there is no Vulkan device".
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Best => f.write_str("at all"),
            Self::Index(index) => write!(f, "number {index}"),
            Self::Name(name) => write!(f, "called `{name}`"),
            Self::Uuid(digits) => write!(f, "whose UUID begins with {digits}"),
            Self::Pci(address) => write!(f, "at {address} on the PCI bus"),
            Self::Cpu => f.write_str("in software"),
        }
    }
}

/// The digits of a UUID or of a prefix of one, with or without dashes and the `GPU-` of NVIDIA's tools.
fn uuid_digits(text: &str) -> Option<String> {
    let text = text.to_lowercase();
    let digits = text.strip_prefix("gpu-").unwrap_or(&text).replace('-', "");
    let is_uuid = (1..=32).contains(&digits.len()) && digits.chars().all(|c| c.is_ascii_hexdigit());
    is_uuid.then_some(digits)
}

/// The variables of schedulers, which Vulkan does not read.
#[derive(Clone, Debug, Default)]
pub(crate) struct SchedulerVariables {
    /// `CUDA_VISIBLE_DEVICES`: indices and UUIDs of NVIDIA devices.
    cuda: Option<String>,
    /// `CUDA_DEVICE_ORDER`: what the indices count.
    cuda_order: Option<String>,
    /// Whether the machine has no NVIDIA driver: shells set `CUDA_VISIBLE_DEVICES` where there is no such device.
    lacks_cuda: bool,
    /// `ROCR_VISIBLE_DEVICES`: indices and UUIDs of AMD devices.
    rocr: Option<String>,
    /// `HIP_VISIBLE_DEVICES`: indices into those that `ROCR_VISIBLE_DEVICES` leaves.
    hip: Option<String>,
}

/// The selected device.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct SelectedDevice {
    /// Its index.
    pub(crate) index: usize,
    /// The variables that selected it, if any, and what they count.
    pub(crate) reason: Option<String>,
    /// The variables' indices may mean other devices.
    pub(crate) is_doubtful: bool,
}

const NVIDIA: u32 = 0x10de;
const AMD: u32 = 0x1002;

impl SchedulerVariables {
    pub(crate) fn of_this_process() -> Self {
        let variable = |name| std::env::var(name).ok();
        Self {
            cuda: variable("CUDA_VISIBLE_DEVICES"),
            cuda_order: variable("CUDA_DEVICE_ORDER"),
            lacks_cuda: ["/dev/nvidiactl", "/dev/dxg", "/proc/driver/nvidia"]
                .iter()
                .all(|driver| !Path::new(driver).exists()),
            rocr: variable("ROCR_VISIBLE_DEVICES"),
            hip: variable("HIP_VISIBLE_DEVICES"),
        }
    }

    /// The device of a choice. Where it is the best and none meets all requirements, the first, so that an error can
    /// name what it lacks.
    pub(crate) fn pick(
        &self,
        choice: &DeviceChoice,
        devices: &[DeviceReport],
    ) -> Result<SelectedDevice> {
        let position = |is_meant: &dyn Fn(&DeviceReport) -> bool| devices.iter().position(is_meant);
        let index = match choice {
            DeviceChoice::Best => return self.best(devices),
            DeviceChoice::Index(index) => Some(*index).filter(|&index| index < devices.len()),
            DeviceChoice::Name(part) => {
                let part = part.to_lowercase();
                position(&|device| device.name.to_lowercase().contains(&part))
            }
            DeviceChoice::Uuid(digits) => position(&|device| has_uuid(device, digits)),
            DeviceChoice::Pci(address) => position(&|device| device.pci == Some(*address)),
            DeviceChoice::Cpu => {
                position(&|device| is_software(device) && device.missing().is_none())
                    .or_else(|| position(&is_software))
            }
        };
        let problem = || no_such_device(&format!("there is no Vulkan device {choice}"), devices);
        let index = index.ok_or_else(problem)?;
        Ok(SelectedDevice { index, reason: None, is_doubtful: false })
    }

    fn best(&self, devices: &[DeviceReport]) -> Result<SelectedDevice> {
        let set: Vec<_> = [
            ("CUDA_VISIBLE_DEVICES", &self.cuda),
            ("ROCR_VISIBLE_DEVICES", &self.rocr),
            ("HIP_VISIBLE_DEVICES", &self.hip),
        ]
        .into_iter()
        .filter_map(|(name, value)| Some(format!("{name}={}", value.as_ref()?.trim())))
        .collect();
        let set = set.join(" ");
        let (visible, is_doubtful) = match self.visible(devices) {
            Err(_)
                if self.lacks_cuda
                    && self.cuda.is_some()
                    && of_vendor(devices, NVIDIA).is_empty() =>
            {
                let list = self.cuda.as_deref().unwrap_or_default();
                tracing::warn!(
                    "CUDA_VISIBLE_DEVICES={list} is ignored: the machine has no NVIDIA driver; unset it"
                );
                return Self { cuda: None, ..self.clone() }.best(devices);
            }
            found => found?,
        };
        let suffices = |&&index: &&usize| devices[index].missing().is_none();
        let Some(&index) = visible.iter().find(suffices).or(visible.first()) else {
            return Err(no_such_device(&format!("{set} leaves no device"), devices));
        };
        let counted = if is_doubtful {
            ", counted along the PCI bus; CUDA counts the fastest first unless CUDA_DEVICE_ORDER=PCI_BUS_ID: \
                       set that, or name UUIDs"
        } else {
            ""
        };
        let reason = (!set.is_empty()).then(|| format!("{set}{counted}"));
        Ok(SelectedDevice { index, reason, is_doubtful })
    }

    /// The devices that the variables name, in their order, else all that they do not hide; and whether the variables
    /// may mean others.
    fn visible(&self, devices: &[DeviceReport]) -> Result<(Vec<usize>, bool)> {
        let nvidia =
            VisibleDevices::new("CUDA_VISIBLE_DEVICES", of_vendor(devices, NVIDIA), devices)
                .narrow(self.cuda.as_deref());
        let rocr = VisibleDevices::new("ROCR_VISIBLE_DEVICES", of_vendor(devices, AMD), devices)
            .narrow(self.rocr.as_deref());
        let amd = match (rocr, self.hip.as_deref()) {
            (Ok(rocr), Some(hip)) => {
                VisibleDevices { variable: "HIP_VISIBLE_DEVICES", ..rocr }.narrow(Some(hip))
            }
            (rocr, _) => rocr,
        };
        let vendors = [(NVIDIA, nvidia), (AMD, amd)];
        // Some schedulers set the variables of all vendors: one that names no device matters only where no other names
        // any.
        let is_answered = vendors.iter().any(|(_, named)| {
            named.as_ref().is_ok_and(|named| named.is_narrowed && !named.devices.is_empty())
        });
        let mut named = vec![];
        let mut hidden = vec![];
        let mut is_doubtful = false;
        for (vendor, of_vendor) in vendors {
            match of_vendor {
                Ok(of_vendor) if of_vendor.is_narrowed => {
                    is_doubtful |= vendor == NVIDIA && self.cuda_counts_otherwise(devices);
                    named.extend(of_vendor.devices);
                    hidden.push(vendor);
                }
                Ok(_) => {}
                Err(_) if is_answered && devices.iter().all(|device| device.vendor != vendor) => {}
                Err(problem) => return Err(problem),
            }
        }
        if named.is_empty() {
            let visible = |&index: &usize| !hidden.contains(&devices[index].vendor);
            return Ok(((0..devices.len()).filter(visible).collect(), false));
        }
        Ok((named, is_doubtful))
    }

    /// Whether an index may mean another device to CUDA: by default it counts the fastest first, which among equal
    /// devices is bus order.
    fn cuda_counts_otherwise(&self, devices: &[DeviceReport]) -> bool {
        let of_vendor: Vec<_> =
            of_vendor(devices, NVIDIA).into_iter().map(|index| &devices[index]).collect();
        let is_of_the_bus = self.cuda_order.as_deref() == Some("PCI_BUS_ID")
            || of_vendor.iter().all(|device| device.name == of_vendor[0].name);
        let has_numbers = self.cuda.iter().flat_map(|list| list.split(',')).any(is_number);
        let is_known = is_of_the_bus && of_vendor.iter().all(|device| device.pci.is_some());
        has_numbers && of_vendor.len() > 1 && !is_known
    }
}

/// The visible devices of a vendor.
struct VisibleDevices<'a> {
    variable: &'static str,
    devices: Vec<usize>,
    /// The variable.
    is_narrowed: bool,
    all: &'a [DeviceReport],
}

impl<'a> VisibleDevices<'a> {
    fn new(variable: &'static str, devices: Vec<usize>, all: &'a [DeviceReport]) -> Self {
        Self { variable, devices, is_narrowed: false, all }
    }

    /// Those of the devices that the variable lists; all where it is not set.
    fn narrow(self, list: Option<&str>) -> Result<Self> {
        let Some(list) = list.map(str::trim) else { return Ok(self) };
        let is_none = ["", "-1", "NoDevFiles"].contains(&list);
        let names = list.split(',').map(str::trim).filter(|_| !is_none);
        let devices = names.map(|name| self.device(list, name)).collect::<Result<_>>()?;
        Ok(Self { devices, is_narrowed: true, ..self })
    }

    fn device(&self, list: &str, name: &str) -> Result<usize> {
        let found = if is_number(name) {
            name.parse().ok().and_then(|number: usize| self.devices.get(number).copied())
        } else {
            let digits = uuid_digits(name).filter(|_| !name.starts_with("MIG-"));
            let is_meant = |index: &&usize| {
                digits.as_ref().is_some_and(|digits| has_uuid(&self.all[**index], digits))
            };
            self.devices.iter().find(is_meant).copied()
        };
        found.ok_or_else(|| {
            let problem = format!(
                "{}={list} names {name}, which Vulkan does not have (a container needs \
                 NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics; --device picks another)",
                self.variable
            );
            no_such_device(&problem, self.all)
        })
    }
}

/// A vendor's devices in bus order; those without a known address last.
fn of_vendor(devices: &[DeviceReport], vendor: u32) -> Vec<usize> {
    let mut indices: Vec<_> = (0..devices.len()).filter(|&i| devices[i].vendor == vendor).collect();
    indices.sort_by_key(|&index| (devices[index].pci.is_none(), devices[index].pci));
    indices
}

fn is_number(name: &str) -> bool {
    name.trim().parse::<u32>().is_ok()
}

fn is_software(device: &DeviceReport) -> bool {
    device.kind == "software"
}

fn has_uuid(device: &DeviceReport, digits: &str) -> bool {
    device.uuid.replace('-', "").starts_with(digits)
}

fn no_such_device(problem: &str, devices: &[DeviceReport]) -> Error {
    let names: Vec<_> = devices.iter().map(|device| &*device.name).collect();
    Error::NoDevice(format!("{problem}; there are: {}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{DeviceLimits, RequirementReport};

    fn device(name: &str, kind: &'static str, vendor: u32, bus: Option<u32>) -> DeviceReport {
        let digit = name.bytes().next().unwrap();
        let pci = bus.map(|bus| PciAddress { domain: 0, bus, device: 0, function: 0 });
        DeviceReport {
            name: name.to_owned(),
            kind,
            api_version: "1.3.0".to_owned(),
            vendor,
            device: 0,
            driver: String::new(),
            driver_version: 0,
            uuid: format!("{digit:02x}000000-0000-0000-0000-0000000000{digit:02x}"),
            pci,
            subgroup_size: 32,
            subgroup_sizes: vec![32],
            memory: 0,
            limits: DeviceLimits::default(),
            cooperative_matrix: None,
            requirements: vec![RequirementReport { name: "all", why: "", met: name != "Lame" }],
        }
    }

    /// Two of NVIDIA's whose order in Vulkan is not that of the bus, two of AMD's, and lavapipe.
    fn node() -> Vec<DeviceReport> {
        vec![
            device("Nine", "discrete", NVIDIA, Some(9)),
            device("Four", "discrete", NVIDIA, Some(4)),
            device("Radeon", "discrete", AMD, Some(7)),
            device("Vega", "integrated", AMD, Some(5)),
            device("llvmpipe", "software", 0x10005, None),
        ]
    }

    fn variables(cuda: Option<&str>, rocr: Option<&str>, hip: Option<&str>) -> SchedulerVariables {
        let [cuda, rocr, hip] = [cuda, rocr, hip].map(|value| value.map(str::to_owned));
        let cuda_order = Some("PCI_BUS_ID".to_owned());
        SchedulerVariables { cuda, cuda_order, lacks_cuda: false, rocr, hip }
    }

    /// The name of the selected device, or the error message.
    fn best(variables: &SchedulerVariables, devices: &[DeviceReport]) -> String {
        match variables.pick(&DeviceChoice::Best, devices) {
            Ok(picked) => devices[picked.index].name.clone(),
            Err(problem) => problem.to_string(),
        }
    }

    #[test]
    fn a_device_is_chosen_by_index_name_uuid_address_and_kind() {
        let node = node();
        for (text, name) in [
            ("", "Nine"),
            ("3", "Vega"),
            ("radeo", "Radeon"),
            ("uuid:46000000-0000-0000-0000-000000000046", "Four"),
            ("uuid:GPU-46", "Four"),
            ("uuid:460000000000", "Four"),
            ("pci:0000:07:00.0", "Radeon"),
            ("pci:00000000:07:00.0", "Radeon"),
            ("pci:5:0", "Vega"),
            ("cpu", "llvmpipe"),
        ] {
            let choice: DeviceChoice = text.parse().unwrap();
            // A choice by name does not depend on a scheduler's variables.
            for variables in [SchedulerVariables::default(), variables(Some("0"), None, None)] {
                let picked = variables.pick(&choice, &node).unwrap();
                let is_free = choice != DeviceChoice::Best || variables.cuda.is_none();
                let wanted = if is_free { name } else { "Four" };
                assert_eq!(node[picked.index].name, wanted, "{text}");
            }
        }
    }

    #[test]
    fn a_choice_without_a_device_is_refused_with_the_list_of_devices() {
        let node = node();
        for (text, expected) in [
            ("5", "number 5"),
            ("arc", "called `arc`"),
            ("uuid:ff", "whose UUID begins with ff"),
            ("pci:0000:08:00.0", "at 0000:08:00.0 on the PCI bus"),
        ] {
            let choice: DeviceChoice = text.parse().unwrap();
            let problem = SchedulerVariables::default().pick(&choice, &node).unwrap_err();
            let message = problem.to_string();
            assert!(message.contains(expected) && message.contains("Vega, llvmpipe"), "{message}");
        }
        let gpus = &node[..4];
        let problem = SchedulerVariables::default().pick(&DeviceChoice::Cpu, gpus).unwrap_err();
        assert!(problem.to_string().contains("no Vulkan device in software"), "{problem}");
        for text in [
            "uuid:",
            "uuid:xyz",
            "uuid:012345678901234567890123456789012",
            "pci:",
            "pci:1",
            "pci:1:2:3:4",
            "pci:g:0",
        ] {
            assert!(matches!(text.parse::<DeviceChoice>(), Err(Error::Usage(_))), "{text}");
        }
    }

    #[test]
    fn a_schedulers_list_selects_among_the_devices_of_its_vendor() {
        let node = node();
        for (cuda, rocr, hip, name) in [
            (None, None, None, "Nine"),
            // Numbers count in bus order, and the first of the list is used.
            (Some("0"), None, None, "Four"),
            (Some("1"), None, None, "Nine"),
            (Some("1,0"), None, None, "Nine"),
            (Some("GPU-46"), None, None, "Four"),
            (Some("GPU-46000000-0000-0000-0000-000000000046,1"), None, None, "Four"),
            (None, Some("0"), None, "Vega"),
            (None, None, Some("1"), "Radeon"),
            // HIP counts the devices left by ROCR.
            (None, Some("1"), Some("0"), "Radeon"),
            // An empty list of one vendor leaves the other's devices.
            (Some(""), None, None, "Radeon"),
            (Some("-1"), None, None, "Radeon"),
            (Some("NoDevFiles"), Some(""), None, "llvmpipe"),
            (Some(""), Some("0"), None, "Vega"),
        ] {
            assert_eq!(best(&variables(cuda, rocr, hip), &node), name, "{cuda:?} {rocr:?} {hip:?}");
        }
    }

    #[test]
    fn a_list_of_unknown_devices_is_refused_unless_another_vendors_is_valid() {
        let node = node();
        for (cuda, rocr) in [
            (Some("2"), None),
            (Some("GPU-ff"), None),
            (Some("MIG-46"), None),
            (Some("0,2"), None),
            (Some("x"), None),
            (None, Some("2")),
        ] {
            let message = best(&variables(cuda, rocr, None), &node);
            assert!(message.contains("which Vulkan does not have"), "{cuda:?} {rocr:?}: {message}");
            assert!(message.contains("there are: Nine"), "{message}");
        }
        let software = &node[4..];
        assert!(
            best(&variables(Some("0"), None, None), software).contains("CUDA_VISIBLE_DEVICES=0")
        );
        assert_eq!(best(&variables(Some(""), None, None), software), "llvmpipe");
        let lacking = |cuda, rocr| SchedulerVariables {
            lacks_cuda: true,
            ..variables(Some(cuda), rocr, None)
        };
        let picked = lacking("0", None).pick(&DeviceChoice::Best, software).unwrap();
        assert_eq!((picked.index, picked.reason), (0, None));
        assert!(best(&lacking("9", None), &node).contains("which Vulkan does not have"));
        assert!(best(&lacking("0", Some("7")), software).contains("ROCR_VISIBLE_DEVICES=7"));
        // A scheduler that sets the variables of every vendor.
        assert_eq!(best(&variables(Some("1"), Some("1"), None), &node[..2]), "Nine");
        assert_eq!(best(&variables(Some("1"), Some("1"), None), &node[2..]), "Radeon");
        let all_hidden = best(&variables(Some(""), Some(""), None), &node[..4]);
        assert!(
            all_hidden.contains("CUDA_VISIBLE_DEVICES= ROCR_VISIBLE_DEVICES= leaves no device"),
            "{all_hidden}"
        );
    }

    #[test]
    fn indices_are_doubtful_only_if_cuda_may_count_differently() {
        let different = node();
        let same = [4, 9].map(|bus| device("Same", "discrete", NVIDIA, Some(bus)));
        let placeless = [None, None].map(|bus| device("Same", "discrete", NVIDIA, bus));
        let cuda = |list: &str, order: Option<&str>| SchedulerVariables {
            cuda: Some(list.to_owned()),
            cuda_order: order.map(str::to_owned),
            ..Default::default()
        };
        for (variables, devices, is_doubtful) in [
            (cuda("1", None), &different[..], true),
            (cuda("1", Some("FASTEST_FIRST")), &different[..], true),
            (cuda("1", Some("PCI_BUS_ID")), &different[..], false),
            (cuda("GPU-46", None), &different[..], false),
            (cuda("1", None), &same[..], false),
            (cuda("1", Some("PCI_BUS_ID")), &placeless[..], true),
            (cuda("0", None), &different[..1], false),
        ] {
            let picked = variables.pick(&DeviceChoice::Best, devices).unwrap();
            assert_eq!(picked.is_doubtful, is_doubtful, "{variables:?}");
            let reason = picked.reason.unwrap();
            assert!(reason.starts_with("CUDA_VISIBLE_DEVICES="), "{reason}");
            assert_eq!(reason.contains("fastest first"), is_doubtful, "{reason}");
        }
    }

    #[test]
    fn without_a_sufficient_device_the_first_is_selected_for_the_error() {
        let devices =
            [device("Lame", "discrete", NVIDIA, Some(1)), device("Swift", "software", 0, None)];
        assert_eq!(best(&SchedulerVariables::default(), &devices), "Swift");
        assert_eq!(best(&variables(Some("0"), None, None), &devices), "Lame");
    }
}
