//! A kernel specialised for its constants and the device.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::io::Cursor;

use ash::vk;
use nightsplat_core::watch::Stage;

use super::{
    Gpu, GpuShared, Interface, Kernel, Properties, Statistic, lock, reconvergence, spirv,
    statistics,
};
use crate::{Error, Result};

/// A kernel ready to be dispatched.
#[derive(Debug)]
pub struct Pipeline<K: Kernel> {
    /// What it is specialised for.
    pub(super) constants: K::Constants,
    pub(super) objects: Objects,
}

/// The Vulkan objects of a kernel with its constants. A device compiles them once and keeps them to its end: trainers
/// and renderers that come later find them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Objects {
    pub(super) interface: &'static Interface,
    pub(super) raw: vk::Pipeline,
    pub(super) layout: vk::PipelineLayout,
    pub(super) set_layout: vk::DescriptorSetLayout,
}

/// By the address of a kernel's interface, and its constants.
pub(super) type CompiledKernels = HashMap<(usize, Vec<(u32, u32)>), Objects>;

impl Gpu {
    /// Specialises kernel `K` with `constants`.
    #[doc(hidden)]
    pub fn pipeline<K: Kernel>(&self, constants: &K::Constants) -> Result<Pipeline<K>> {
        let objects = self.objects(K::INTERFACE, K::constants(constants))?;
        let pipeline: Pipeline<K> = Pipeline { constants: *constants, objects };
        if let Some(file) = statistics::file() {
            let all = pipeline.statistics(self)?.unwrap_or_default();
            let kernel = K::INTERFACE.name;
            statistics::log(&file, kernel, constants, &self.shared.properties, &all)?;
        }
        Ok(pipeline)
    }

    /// Compiles a kernel, which the pipeline cache then has.
    pub(crate) fn compile(
        &self,
        interface: &'static Interface,
        constants: Vec<(u32, u32)>,
    ) -> Result<()> {
        self.objects(interface, constants).map(drop)
    }

    fn objects(
        &self,
        interface: &'static Interface,
        constants: Vec<(u32, u32)>,
    ) -> Result<Objects> {
        let _phase = tracing::info_span!("pipelines").entered();
        Stage::begin("compiling kernels", 1).next()?;
        let shared = &self.shared;
        let name = described(interface, &constants);
        #[cfg(debug_assertions)]
        shared.faults.compile(interface.name).map_err(|result| refused(shared, &name, result))?;
        let key = (std::ptr::from_ref(interface) as usize, constants.clone());
        if let Some(&known) = lock(&shared.pipelines).get(&key) {
            return Ok(known);
        }
        tracing::debug!("compiles {name}");
        // Unlocked, so that threads compile different kernels at the same time.
        let compiled = compiled(shared, interface, constants, &name)?;
        match lock(&shared.pipelines).entry(key) {
            // Another thread was faster.
            Entry::Occupied(known) => {
                // SAFETY: nothing uses what was compiled here.
                unsafe { shared.destroy_pipeline(&compiled) };
                Ok(*known.get())
            }
            Entry::Vacant(vacant) => Ok(*vacant.insert(compiled)),
        }
    }
}

/// Compiles the kernel called `name`.
fn compiled(
    shared: &GpuShared,
    interface: &'static Interface,
    constants: Vec<(u32, u32)>,
    name: &str,
) -> Result<Objects> {
    let fail = |call| move |result| shared.error(call, result);
    // SAFETY: every create info points at live locals, and what fails half-way is destroyed here.
    unsafe {
        let set_layout =
            set_layout(shared, interface).map_err(fail("vkCreateDescriptorSetLayout"))?;
        let layout = match pipeline_layout(shared, interface, set_layout) {
            Ok(layout) => layout,
            Err(result) => {
                shared.device.destroy_descriptor_set_layout(set_layout, shared.callbacks());
                return Err(shared.error("vkCreatePipelineLayout", result));
            }
        };
        match raw_pipeline(shared, interface, layout, constants, Default::default()) {
            Ok(raw) => {
                shared.name(raw, name);
                Ok(Objects { interface, raw, layout, set_layout })
            }
            Err(result) => {
                shared.device.destroy_pipeline_layout(layout, shared.callbacks());
                shared.device.destroy_descriptor_set_layout(set_layout, shared.callbacks());
                Err(refused(shared, name, result))
            }
        }
    }
}

impl<K: Kernel> Pipeline<K> {
    /// The statistics of the kernel by the driver of its device; `None` where the driver has none. Compiles it again.
    pub fn statistics(&self, gpu: &Gpu) -> Result<Option<Vec<Statistic>>> {
        let shared = &gpu.shared;
        let Some(functions) = &shared.executables else { return Ok(None) };
        let fail = |call| move |result| shared.error(call, result);
        let constants = K::constants(&self.constants);
        let flags = vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR;
        // SAFETY: the device and the layout are live; the pipeline is used by nothing else.
        unsafe {
            let raw = raw_pipeline(shared, K::INTERFACE, self.objects.layout, constants, flags)
                .map_err(fail("vkCreateComputePipelines"))?;
            let all = statistics::read(functions, raw);
            shared.device.destroy_pipeline(raw, shared.callbacks());
            Ok(Some(all.map_err(fail("vkGetPipelineExecutableStatisticsKHR"))?))
        }
    }
}

/// The error for a kernel that the driver does not compile.
fn refused(shared: &GpuShared, kernel: &str, result: vk::Result) -> Error {
    let is_memory = [
        vk::Result::ERROR_OUT_OF_HOST_MEMORY,
        vk::Result::ERROR_OUT_OF_DEVICE_MEMORY,
        vk::Result::ERROR_DEVICE_LOST,
    ];
    if is_memory.contains(&result) {
        return shared.error("vkCreateComputePipelines", result);
    }
    let Properties { name, driver, .. } = &shared.properties;
    Error::Kernel {
        device: format!("{name}, {driver},"),
        problem: format!("refuses ({result})"),
        kernel: kernel.to_owned(),
        remedy: String::new(),
    }
}

/// The kernel and its constants, by their ids: `blend_forward (2=3 3=16)`.
fn described(interface: &Interface, constants: &[(u32, u32)]) -> String {
    let values: Vec<String> = constants.iter().map(|(id, bits)| format!("{id}={bits}")).collect();
    format!("{} ({})", interface.name, values.join(" "))
}

/// # Safety
/// The device is live.
unsafe fn set_layout(
    shared: &GpuShared,
    interface: &Interface,
) -> Result<vk::DescriptorSetLayout, vk::Result> {
    let bindings: Vec<_> = interface
        .bindings
        .iter()
        .map(|binding| {
            vk::DescriptorSetLayoutBinding::default()
                .binding(binding.index)
                .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                .descriptor_count(1)
                .stage_flags(vk::ShaderStageFlags::COMPUTE)
        })
        .collect();
    let info = vk::DescriptorSetLayoutCreateInfo::default()
        .flags(shared.descriptors.set_layout_flags())
        .bindings(&bindings);
    // SAFETY: `info` points at live locals.
    unsafe { shared.device.create_descriptor_set_layout(&info, shared.callbacks()) }
}

/// # Safety
/// The device and the set layout are live.
unsafe fn pipeline_layout(
    shared: &GpuShared,
    interface: &Interface,
    set_layout: vk::DescriptorSetLayout,
) -> Result<vk::PipelineLayout, vk::Result> {
    let set_layouts = [set_layout];
    let ranges = [vk::PushConstantRange::default()
        .stage_flags(vk::ShaderStageFlags::COMPUTE)
        .size(interface.params_size as u32)];
    let ranges = if interface.params_size == 0 { &[][..] } else { &ranges[..] };
    let info = vk::PipelineLayoutCreateInfo::default()
        .set_layouts(&set_layouts)
        .push_constant_ranges(ranges);
    // SAFETY: `info` points at live locals.
    unsafe { shared.device.create_pipeline_layout(&info, shared.callbacks()) }
}

/// # Safety
/// The device and the layout are live.
unsafe fn raw_pipeline(
    shared: &GpuShared,
    interface: &Interface,
    layout: vk::PipelineLayout,
    mut constants: Vec<(u32, u32)>,
    flags: vk::PipelineCreateFlags,
) -> Result<vk::Pipeline, vk::Result> {
    let mut code = ash::util::read_spv(&mut Cursor::new(interface.spirv))
        .map_err(|_| vk::Result::ERROR_INITIALIZATION_FAILED)?;
    if !shared.properties.has_uniform_subgroup_control_flow {
        code = reconvergence::unasked(&code);
    }
    if let Some(id) = interface.subgroup_size_id {
        constants.push((id, shared.properties.subgroup_size));
    }
    let data: Vec<u32> = constants.iter().map(|&(_, bits)| bits).collect();
    let entries: Vec<_> = (0u32..)
        .zip(&constants)
        .map(|(i, &(id, _))| vk::SpecializationMapEntry { constant_id: id, offset: 4 * i, size: 4 })
        .collect();
    let specialization =
        vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::cast_slice(&data));
    let driver_specializes = shared.properties.driver_specializes;
    if !driver_specializes {
        code = spirv::frozen(&code, &constants);
    }
    let mut required = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default()
        .required_subgroup_size(shared.properties.subgroup_size);
    let mut stage = vk::PipelineShaderStageCreateInfo::default()
        .stage(vk::ShaderStageFlags::COMPUTE)
        .name(c"main");
    if driver_specializes {
        stage = stage.specialization_info(&specialization);
    }
    if let Some(version) = shared.modules.spirv_version {
        code[1] = version;
    }
    if interface.subgroup_size_id.is_some() {
        if shared.modules.has_subgroup_flag {
            stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS);
        }
        // Where a device cannot be told the subgroup size, its only size is the one it reports.
        if shared.properties.subgroup_size_is_selectable {
            stage = stage.push_next(&mut required);
        }
    }
    let info = vk::ShaderModuleCreateInfo::default().code(&code);
    // SAFETY: the create infos point at live locals; the module is not needed after the call.
    unsafe {
        let module = shared.device.create_shader_module(&info, shared.callbacks())?;
        let info = vk::ComputePipelineCreateInfo::default()
            .stage(stage.module(module))
            .layout(layout)
            .flags(flags);
        let pipelines = shared.device.create_compute_pipelines(
            shared.pipeline_cache,
            &[info],
            shared.callbacks(),
        );
        shared.device.destroy_shader_module(module, shared.callbacks());
        pipelines.map(|pipelines| pipelines[0]).map_err(|(_, result)| result)
    }
}

impl GpuShared {
    /// Destroys every kernel that was compiled.
    ///
    /// # Safety
    /// No submission uses one any more, and nothing records one.
    pub(super) unsafe fn destroy_pipelines(&self) {
        for objects in std::mem::take(&mut *lock(&self.pipelines)).values() {
            // SAFETY: as the caller promises.
            unsafe { self.destroy_pipeline(objects) };
        }
    }

    /// # Safety
    /// No submission uses the pipeline any more, and it is destroyed once.
    unsafe fn destroy_pipeline(&self, objects: &Objects) {
        let callbacks = self.callbacks();
        // SAFETY: as the caller promises.
        unsafe {
            self.device.destroy_pipeline(objects.raw, callbacks);
            self.device.destroy_pipeline_layout(objects.layout, callbacks);
            self.device.destroy_descriptor_set_layout(objects.set_layout, callbacks);
        }
    }

    /// Names an object for captures and validation messages.
    fn name<H: vk::Handle>(&self, object: H, name: &str) {
        let (Some(debug), Ok(name)) = (&self.debug, std::ffi::CString::new(name)) else { return };
        let info =
            vk::DebugUtilsObjectNameInfoEXT::default().object_handle(object).object_name(&name);
        // SAFETY: the object belongs to this device; a name that is refused is not missed.
        let _ = unsafe { debug.set_debug_utils_object_name(&info) };
    }
}
