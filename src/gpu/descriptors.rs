//! Binding the buffers of a pass: descriptors are pushed into the recording or, where a device cannot, written to sets.

use std::sync::Arc;

use ash::{khr, vk};

use super::limits::{MAX_BUFFERS, whole_quads};
use super::pipeline::Objects;
use super::{Bound, GpuShared, Retired};
use crate::Result;

/// How a device takes descriptors.
pub(super) enum Descriptors {
    Pushed(khr::push_descriptor::Device),
    InSets,
}

impl Descriptors {
    /// Pushed where the device was created with the extension, as only then it tells the function's address.
    pub(super) fn new(instance: &ash::Instance, device: &ash::Device, may_be_pushed: bool) -> Self {
        let name = c"vkCmdPushDescriptorSetKHR".as_ptr();
        // SAFETY: the device is live, the name ends with NUL.
        let function = unsafe { (instance.fp_v1_0().get_device_proc_addr)(device.handle(), name) };
        match function.filter(|_| may_be_pushed) {
            Some(_) => Self::Pushed(khr::push_descriptor::Device::new(instance, device)),
            None => Self::InSets,
        }
    }

    pub(super) fn set_layout_flags(&self) -> vk::DescriptorSetLayoutCreateFlags {
        match self {
            Self::Pushed(_) => vk::DescriptorSetLayoutCreateFlags::PUSH_DESCRIPTOR_KHR,
            Self::InSets => vk::DescriptorSetLayoutCreateFlags::empty(),
        }
    }
}

/// The sets of one recording, none where descriptors are pushed, and what the last pass has bound.
#[derive(Debug)]
pub(super) struct Sets {
    shared: Arc<GpuShared>,
    pools: Vec<vk::DescriptorPool>,
    /// Sets left in the last pool.
    left: u32,
    /// Where the last pass was recorded, and its kernel, which stays bound with what was pushed for it.
    last: (vk::CommandBuffer, vk::Pipeline),
    last_bound: Vec<Bound>,
}

/// Sets of a pool, each of [`MAX_BUFFERS`] descriptors.
const SETS_OF_A_POOL: u32 = 64;

impl Sets {
    pub(super) fn new(shared: &Arc<GpuShared>) -> Self {
        let (last, last_bound) = (Default::default(), vec![]);
        Self { shared: Arc::clone(shared), pools: vec![], left: 0, last, last_bound }
    }

    /// Records into `commands` what the next dispatch binds: pipeline, buffers and parameters. A pass of the last one's
    /// kernel pushes only those buffers that differ.
    pub(super) fn bind(
        &mut self,
        commands: vk::CommandBuffer,
        pipeline: &Objects,
        params: &[u8],
        bound: &[Bound],
    ) -> Result<()> {
        let mut infos = [[vk::DescriptorBufferInfo::default()]; MAX_BUFFERS as usize];
        for (info, &Bound { raw, offset, size }) in infos.iter_mut().zip(bound) {
            let buffer = vk::DescriptorBufferInfo::default().buffer(raw).offset(offset);
            *info = [buffer.range(whole_quads(size))];
        }
        let mut writes = [vk::WriteDescriptorSet::default(); MAX_BUFFERS as usize];
        let is_same = self.last == (commands, pipeline.raw);
        let is_pushed = matches!(self.shared.descriptors, Descriptors::Pushed(_));
        let mut count = 0;
        for (at, (info, binding)) in infos.iter().zip(pipeline.interface.bindings).enumerate() {
            if is_same && is_pushed && self.last_bound.get(at) == bound.get(at) {
                continue;
            }
            writes[count] = vk::WriteDescriptorSet::default()
                .dst_binding(binding.index)
                .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                .buffer_info(info);
            count += 1;
        }
        let writes = &mut writes[..count];
        self.last = (commands, pipeline.raw);
        self.last_bound.clear();
        self.last_bound.extend_from_slice(bound);
        let (point, layout) = (vk::PipelineBindPoint::COMPUTE, pipeline.layout);
        let shared = Arc::clone(&self.shared);
        let device = &shared.device;
        // SAFETY: recording; pipeline and buffers are live and match the layout by construction.
        unsafe {
            if !is_same {
                device.cmd_bind_pipeline(commands, point, pipeline.raw);
            }
            match &shared.descriptors {
                Descriptors::Pushed(_) if writes.is_empty() => {}
                Descriptors::Pushed(functions) => {
                    functions.cmd_push_descriptor_set(commands, point, layout, 0, writes);
                }
                Descriptors::InSets => {
                    let set = self.next(pipeline.set_layout)?;
                    writes.iter_mut().for_each(|write| write.dst_set = set);
                    device.update_descriptor_sets(writes, &[]);
                    device.cmd_bind_descriptor_sets(commands, point, layout, 0, &[set], &[]);
                }
            }
            if !params.is_empty() {
                let stage = vk::ShaderStageFlags::COMPUTE;
                device.cmd_push_constants(commands, layout, stage, 0, params);
            }
        }
        Ok(())
    }

    /// An unwritten set.
    fn next(&mut self, layout: vk::DescriptorSetLayout) -> Result<vk::DescriptorSet> {
        let shared = &self.shared;
        if self.left == 0 {
            let sizes = [vk::DescriptorPoolSize::default()
                .ty(vk::DescriptorType::STORAGE_BUFFER)
                .descriptor_count(SETS_OF_A_POOL * MAX_BUFFERS)];
            let info =
                vk::DescriptorPoolCreateInfo::default().max_sets(SETS_OF_A_POOL).pool_sizes(&sizes);
            // SAFETY: the device is live; the pool is retired with this recording.
            let pool = unsafe { shared.device.create_descriptor_pool(&info, shared.callbacks()) }
                .map_err(|result| shared.error("vkCreateDescriptorPool", result))?;
            self.pools.push(pool);
            self.left = SETS_OF_A_POOL;
        }
        self.left -= 1;
        let layouts = [layout];
        let pool = self.pools.last().copied().unwrap_or_default();
        let info =
            vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
        // SAFETY: the pool is this recording's own and has room.
        let sets = unsafe { shared.device.allocate_descriptor_sets(&info) }
            .map_err(|result| shared.error("vkAllocateDescriptorSets", result))?;
        Ok(sets[0])
    }
}

impl Drop for Sets {
    fn drop(&mut self) {
        for pool in self.pools.drain(..) {
            self.shared.retire(Retired::Descriptors(pool));
        }
    }
}
