//! A host application with its own Vulkan lends its device, and gets it back unchanged.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::ffi::CStr;

use ash::vk::Handle as _;
use ash::{ext, khr, vk};
use nightsplat::gpu::{HostDevice, HostFrame};

use crate::common::prelude::*;
use crate::host::{Host, Memory};
use crate::images::{OPTIONS, cameras, gaussians};

#[test]
fn a_borrowed_device_renders_the_same_and_is_returned_unchanged() {
    // A device without the extension has its descriptors in sets; the bits are the same.
    lend_and_take_back(vk::API_VERSION_1_3, &[]);
    if gpu().properties().has_push_descriptors {
        lend_and_take_back(vk::API_VERSION_1_3, &[khr::push_descriptor::NAME]);
    }
}

#[test]
fn instances_of_older_vulkan_do_with_the_extensions_that_became_vulkan_1_3() {
    const SYNCHRONIZATION: &CStr = khr::synchronization2::NAME;
    const SUBGROUPS: &CStr = ext::subgroup_size_control::NAME;
    lend_and_take_back(vk::API_VERSION_1_2, &[SYNCHRONIZATION, SUBGROUPS]);
    lend_and_take_back(
        vk::API_VERSION_1_1,
        &[
            SYNCHRONIZATION,
            SUBGROUPS,
            khr::timeline_semaphore::NAME,
            ext::scalar_block_layout::NAME,
            khr::shader_float_controls::NAME,
            khr::spirv_1_4::NAME,
        ],
    );
}

fn lend_and_take_back(version: u32, extensions: &'static [&'static CStr]) {
    let expected = render(&gpu());
    assert!(expected.data.iter().any(|&value| value > 0.5), "nothing is seen");

    let host = Host::of_version(version, extensions);
    let mut memory = host.memory(expected.data.len());
    host.fill(&memory, 0xcafe_f00d);

    // SAFETY: the handles are the host's own and outlive `lent`; nothing else uses the queue meanwhile.
    let lent = unsafe { Gpu::from_host(host.lend()) }.unwrap();
    assert_same("our own submissions", &render(&lent), &expected);
    assert_eq!(memory.read(), vec![0xcafe_f00d; expected.data.len()], "the host's memory changed");
    render_into(&host, &lent, &mut memory);
    let data = memory.read().into_iter().map(f32::from_bits).collect();
    assert_same(
        "recorded into the host's command buffer",
        &Image { data, ..expected.clone() },
        &expected,
    );
    drop(lent);

    host.fill(&memory, 0x1234_5678);
    assert_eq!(memory.read(), vec![0x1234_5678; expected.data.len()], "the device is not alive");
    host.free(memory);
    // Objects that the library did not destroy would be reported when the host destroys its device.
    host.destroy();
}

#[test]
fn a_host_without_a_loader_function_is_refused() {
    let host = HostDevice::default();
    // SAFETY: the first handle, which is null, is refused before any is used.
    let message = unsafe { Gpu::from_host(host) }.unwrap_err().to_string();
    assert!(message.contains("get_instance_proc_addr"), "{message}");
}

fn assert_same(what: &str, actual: &Image, expected: &Image) {
    let bits = |image: &Image| image.data.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    let differing = bits(actual).iter().zip(bits(expected)).filter(|(a, b)| **a != *b).count();
    assert_eq!(actual.data.len(), expected.data.len(), "{what}");
    assert_eq!(differing, 0, "{what}: values differ");
}

// ---------------------------------------------------------------------------
// The scene

fn renderer(gpu: &Gpu) -> Renderer {
    let settings = RenderSettings { shape: 0.into(), ..RenderSettings::default() };
    let mut renderer = Renderer::new(gpu, settings).unwrap();
    renderer.reserve(gaussians().count, [&cameras()[0]]).unwrap();
    renderer
}

fn render(gpu: &Gpu) -> Image {
    let on_device = gaussians().upload(gpu).unwrap();
    renderer(gpu).render_image(&on_device, &cameras()[0], &OPTIONS).unwrap()
}

/// Renders within a command buffer that the host begins, continues with a copy to its memory, and submits.
fn render_into(host: &Host, gpu: &Gpu, memory: &mut Memory) {
    let on_device = gaussians().upload(gpu).unwrap();
    // A separate renderer, so that no earlier render is mistaken for this one.
    let mut renderer = renderer(gpu);
    host.submit(|commands| {
        let readers = vk::PipelineStageFlags2::ALL_TRANSFER.as_raw();
        let frame = HostFrame { commands: commands.as_raw(), number: 1, readers };
        // SAFETY: the command buffer is recording.
        let recorded = unsafe {
            gpu.record_into(&frame, |pass| {
                // The library cannot tell when the copy is done.
                let message = pass.download(&on_device.parameters).unwrap_err().to_string();
                assert!(message.contains("`parameters`"), "{message}");
                renderer.forward(pass, &on_device, &cameras()[0], &OPTIONS)
            })
        };
        recorded.unwrap();
        let region = [vk::BufferCopy { size: memory.size(), ..Default::default() }];
        let render = vk::Buffer::from_raw(renderer.render().handle());
        // SAFETY: both buffers are live and hold `size` bytes.
        unsafe { host.device.cmd_copy_buffer(commands, render, memory.buffer, &region) };
    });
    gpu.frames_done(1);
}
