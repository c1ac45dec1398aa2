//! A host that reads renders in its own fragment shaders: two views in one command buffer.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::io::Cursor;

use ash::vk;
use ash::vk::Handle as _;
use nightsplat::gpu::{HostFrame, ImageFormat, ImageState};
use nightsplat::splats::device::Upload;
use nightsplat::splats::render::{RenderSettings, Renderer};

use crate::host::{Host, Picture, with_host};
use crate::images::{OPTIONS, SIZE, cameras, gaussians};

/// The host's pipeline that reads a buffer where it draws.
struct Reader<'a> {
    device: &'a ash::Device,
    pool: vk::DescriptorPool,
    set_layout: vk::DescriptorSetLayout,
    layout: vk::PipelineLayout,
    pipeline: vk::Pipeline,
    view: vk::ImageView,
    set: vk::DescriptorSet,
}

impl<'a> Reader<'a> {
    fn new(host: &'a Host, picture: &Picture) -> Self {
        let device = &host.device;
        let bindings = [vk::DescriptorSetLayoutBinding::default()
            .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
            .descriptor_count(1)
            .stage_flags(vk::ShaderStageFlags::FRAGMENT)];
        let sizes = [vk::DescriptorPoolSize::default()
            .ty(vk::DescriptorType::STORAGE_BUFFER)
            .descriptor_count(1)];
        let range = vk::ImageSubresourceRange::default()
            .aspect_mask(vk::ImageAspectFlags::COLOR)
            .level_count(1)
            .layer_count(1);
        let view = vk::ImageViewCreateInfo::default()
            .image(picture.image)
            .view_type(vk::ImageViewType::TYPE_2D)
            .format(vk::Format::R8G8B8A8_UNORM)
            .subresource_range(range);
        // SAFETY: every create info points at live locals.
        unsafe {
            let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
            let set_layout = device.create_descriptor_set_layout(&info, None).unwrap();
            let set_layouts = [set_layout];
            let info = vk::PipelineLayoutCreateInfo::default().set_layouts(&set_layouts);
            let layout = device.create_pipeline_layout(&info, None).unwrap();
            let info = vk::DescriptorPoolCreateInfo::default().max_sets(1).pool_sizes(&sizes);
            let pool = device.create_descriptor_pool(&info, None).unwrap();
            let info = vk::DescriptorSetAllocateInfo::default()
                .descriptor_pool(pool)
                .set_layouts(&set_layouts);
            let set = device.allocate_descriptor_sets(&info).unwrap()[0];
            let view = device.create_image_view(&view, None).unwrap();
            let pipeline = pipeline(device, layout);
            Self { device, pool, set_layout, layout, pipeline, view, set }
        }
    }

    fn bind(&self, buffer: vk::Buffer) {
        let info = [vk::DescriptorBufferInfo::default().buffer(buffer).range(vk::WHOLE_SIZE)];
        let write = vk::WriteDescriptorSet::default()
            .dst_set(self.set)
            .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
            .buffer_info(&info);
        // SAFETY: set and buffer are live; no submission uses the set yet.
        unsafe { self.device.update_descriptor_sets(&[write], &[]) }
    }

    /// Draws what the bound buffer holds into the picture, a colour attachment.
    fn draw(&self, commands: vk::CommandBuffer) {
        let [width, height] = SIZE;
        let attachment = [vk::RenderingAttachmentInfo::default()
            .image_view(self.view)
            .image_layout(vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL)
            .load_op(vk::AttachmentLoadOp::LOAD)
            .store_op(vk::AttachmentStoreOp::STORE)];
        let area = vk::Rect2D::default().extent(vk::Extent2D { width, height });
        let rendering = vk::RenderingInfo::default()
            .render_area(area)
            .layer_count(1)
            .color_attachments(&attachment);
        let point = vk::PipelineBindPoint::GRAPHICS;
        // SAFETY: recording; everything is live.
        unsafe {
            self.device.cmd_begin_rendering(commands, &rendering);
            self.device.cmd_bind_pipeline(commands, point, self.pipeline);
            let sets = [self.set];
            self.device.cmd_bind_descriptor_sets(commands, point, self.layout, 0, &sets, &[]);
            self.device.cmd_draw(commands, 3, 1, 0, 0);
            self.device.cmd_end_rendering(commands);
        }
    }

    fn destroy(self) {
        // SAFETY: every submission that uses them was waited for.
        unsafe {
            self.device.destroy_pipeline(self.pipeline, None);
            self.device.destroy_pipeline_layout(self.layout, None);
            self.device.destroy_descriptor_pool(self.pool, None);
            self.device.destroy_descriptor_set_layout(self.set_layout, None);
            self.device.destroy_image_view(self.view, None);
        }
    }
}

/// # Safety
/// Device and layout are live.
unsafe fn pipeline(device: &ash::Device, layout: vk::PipelineLayout) -> vk::Pipeline {
    let module = |code: &[u8]| {
        let words = ash::util::read_spv(&mut Cursor::new(code)).unwrap();
        let info = vk::ShaderModuleCreateInfo::default().code(&words);
        // SAFETY: the info points at live locals.
        unsafe { device.create_shader_module(&info, None) }.unwrap()
    };
    let vertex = module(include_bytes!("../fixtures/host/read_render.vert.spv"));
    let fragment = module(include_bytes!("../fixtures/host/read_render.frag.spv"));
    let stage = |stage, module| {
        vk::PipelineShaderStageCreateInfo::default().stage(stage).module(module).name(c"main")
    };
    let stages = [
        stage(vk::ShaderStageFlags::VERTEX, vertex),
        stage(vk::ShaderStageFlags::FRAGMENT, fragment),
    ];
    let (input, assembly) = (
        vk::PipelineVertexInputStateCreateInfo::default(),
        vk::PipelineInputAssemblyStateCreateInfo::default()
            .topology(vk::PrimitiveTopology::TRIANGLE_LIST),
    );
    let [width, height] = SIZE;
    let viewports = [vk::Viewport {
        width: width as f32,
        height: height as f32,
        max_depth: 1.0,
        ..Default::default()
    }];
    let scissors = [vk::Rect2D::default().extent(vk::Extent2D { width, height })];
    let viewport =
        vk::PipelineViewportStateCreateInfo::default().viewports(&viewports).scissors(&scissors);
    let raster = vk::PipelineRasterizationStateCreateInfo::default().line_width(1.0);
    let samples = vk::PipelineMultisampleStateCreateInfo::default()
        .rasterization_samples(vk::SampleCountFlags::TYPE_1);
    let attachments = [vk::PipelineColorBlendAttachmentState::default()
        .color_write_mask(vk::ColorComponentFlags::RGBA)];
    let blend = vk::PipelineColorBlendStateCreateInfo::default().attachments(&attachments);
    let formats = [vk::Format::R8G8B8A8_UNORM];
    let mut rendering =
        vk::PipelineRenderingCreateInfo::default().color_attachment_formats(&formats);
    let info = vk::GraphicsPipelineCreateInfo::default()
        .stages(&stages)
        .vertex_input_state(&input)
        .input_assembly_state(&assembly)
        .viewport_state(&viewport)
        .rasterization_state(&raster)
        .multisample_state(&samples)
        .color_blend_state(&blend)
        .layout(layout)
        .push_next(&mut rendering);
    // SAFETY: the info points at live locals; the modules are not needed afterwards.
    unsafe {
        let cache = vk::PipelineCache::null();
        let pipelines = device.create_graphics_pipelines(cache, &[info], None).unwrap();
        device.destroy_shader_module(vertex, None);
        device.destroy_shader_module(fragment, None);
        pipelines[0]
    }
}

#[test]
fn a_second_render_waits_for_the_fragments_that_read_the_first() {
    with_host(|host, gpu| {
        let picture = host.picture(ImageFormat::Rgba8Unorm, SIZE).unwrap();
        let reader = Reader::new(host, &picture);
        let on_device = gaussians().upload(gpu).unwrap();
        let settings = RenderSettings { shape: 0.into(), ..RenderSettings::default() };
        let mut renderer = Renderer::new(gpu, settings).unwrap();
        let cameras = cameras();
        renderer.reserve(on_device.layout.count, &cameras).unwrap();
        reader.bind(vk::Buffer::from_raw(renderer.render().handle()));
        let commands = host.begin();
        host.barrier(commands, &picture, ImageState::UNDEFINED, ImageState::COLOR_ATTACHMENT);
        for camera in &cameras {
            let readers = vk::PipelineStageFlags2::FRAGMENT_SHADER.as_raw();
            let frame = HostFrame { commands: commands.as_raw(), number: 1, readers };
            // SAFETY: the command buffer is recording, outside a render pass.
            let recorded = unsafe {
                gpu.record_into(&frame, |pass| renderer.forward(pass, &on_device, camera, &OPTIONS))
            };
            recorded.unwrap();
            let attachment = ImageState::COLOR_ATTACHMENT;
            host.barrier(commands, &picture, attachment, attachment);
            reader.draw(commands);
        }
        host.barrier(commands, &picture, ImageState::COLOR_ATTACHMENT, ImageState::TRANSFER_SOURCE);
        host.submit_frame(commands, 1);
        host.wait_frame(1);
        let pixels = host.read_layer(&picture, 0, (SIZE[0] * SIZE[1]) as usize);
        assert!(pixels.iter().any(|pixel| pixel & 0xff > 100), "nothing is seen");
        reader.destroy();
        host.free_picture(picture);
    });
}
