//! `nightsplat doctor`: which devices there are, and whether they will do.

use std::io::Write;

use anyhow::Result;

use crate::Error;
use crate::gpu::{DeviceReport, devices};

/// List the Vulkan devices, what training requires, and whether each device offers it.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct DoctorArgs {}

/// Prints the report.
///
/// # Errors
/// There is no Vulkan, or no device that meets every requirement.
pub fn run(_: &DoctorArgs) -> Result<()> {
    let reports = devices()?;
    let mut out = std::io::stdout().lock();
    for (index, report) in reports.iter().enumerate() {
        let DeviceReport { name, kind, api_version, subgroup_size, memory, requirements } = report;
        let gib = *memory as f64 / f64::from(1 << 30);
        writeln!(
            out,
            "{index}  {name}\n   {kind}, Vulkan {api_version}, subgroups of {subgroup_size}, {gib:.1} GiB"
        )?;
        let width = requirements.iter().map(|(name, ..)| name.len()).max().unwrap_or(0);
        for (requirement, why, met) in requirements {
            let met = if *met { "yes" } else { "no" };
            writeln!(out, "   {met:3}  {requirement:width$}  {why}")?;
        }
        writeln!(out)?;
    }
    if let Some(index) = reports.iter().position(|report| missing(report).is_none()) {
        writeln!(out, "device {index} is used unless --device picks another")?;
        return Ok(());
    }
    let first = reports.first().and_then(|report| Some((report.name.clone(), missing(report)?)));
    let (device, feature) = first.unwrap_or_default();
    Err(Error::MissingFeature { device, feature: feature.to_owned() }.into())
}

/// The first requirement that the device does not meet.
fn missing(report: &DeviceReport) -> Option<&'static str> {
    report.requirements.iter().find(|(.., met)| !met).map(|&(name, ..)| name)
}
