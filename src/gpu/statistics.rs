//! The driver's statistics of compiled kernels: registers, spills, memory.

use std::ffi::CStr;

use ash::{khr, vk};

use super::{Kernel, Pipeline, pipeline};
use crate::Result;

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

impl<K: Kernel> Pipeline<K> {
    /// The driver's statistics of a kernel; empty where the driver has none. Compiles the kernel again.
    ///
    /// # Errors
    /// The driver refuses the kernel.
    pub fn statistics(&self) -> Result<Option<Vec<Statistic>>> {
        let shared = &self.objects.shared;
        let Some(functions) = &shared.executables else { return Ok(None) };
        let fail = |call| move |result| shared.error(call, result);
        // SAFETY: the device and the layout are live, the infos point at live locals, the pipeline is never used.
        unsafe {
            let flags = vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR;
            let raw = pipeline::raw_pipeline(
                shared,
                K::INTERFACE,
                self.objects.layout,
                K::constants(&self.constants),
                flags,
            )
            .map_err(fail("vkCreateComputePipelines"))?;
            let info = vk::PipelineInfoKHR::default().pipeline(raw);
            let told =
                functions.get_pipeline_executable_properties(&info).and_then(|executables| {
                    let mut told = vec![];
                    for index in 0..executables.len() as u32 {
                        let info = vk::PipelineExecutableInfoKHR::default();
                        let info = info.pipeline(raw).executable_index(index);
                        told.extend(functions.get_pipeline_executable_statistics(&info)?);
                    }
                    Ok(told)
                });
            shared.device.destroy_pipeline(raw, None);
            let told = told.map_err(fail("vkGetPipelineExecutableStatisticsKHR"))?;
            Ok(Some(told.iter().map(Statistic::from).collect()))
        }
    }
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
