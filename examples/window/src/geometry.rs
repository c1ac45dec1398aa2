//! The host's own drawing: boxes of flat colour, with a depth test.

use std::error::Error;
use std::io::Cursor;

use nightsplat::Camera;
use nightsplat::ash::{util, vk};
use nightsplat::glam::{DMat4, DVec4};

use super::device::Device;
use super::scene::Block;
use super::swapchain::{DEPTH_FORMAT, Picture, Swapchain};

const SKY: [f32; 4] = [0.06, 0.07, 0.23, 1.0];
/// Reversed: 1 at the near plane, 0 at infinity.
const FAR: f32 = 0.0;
/// A matrix and three vectors.
const BOX_FLOATS: usize = 16 + 3 * 4;

/// The pipeline.
pub(crate) struct Geometry {
    layout: vk::PipelineLayout,
    pipeline: vk::Pipeline,
}

impl Geometry {
    pub(crate) fn new(device: &Device, format: vk::Format) -> Result<Self, Box<dyn Error>> {
        let raw = &device.raw;
        let pushed = [vk::PushConstantRange::default()
            .stage_flags(vk::ShaderStageFlags::VERTEX)
            .size(4 * BOX_FLOATS as u32)];
        let layout = vk::PipelineLayoutCreateInfo::default().push_constant_ranges(&pushed);
        let words = |bytes: &[u8]| util::read_spv(&mut Cursor::new(bytes));
        let vertex = words(include_bytes!("box.vert.spv"))?;
        let fragment = words(include_bytes!("box.frag.spv"))?;
        // SAFETY: the device is live, the shaders are those beside this file.
        unsafe {
            let layout = raw.create_pipeline_layout(&layout, None)?;
            let module = |words: &[u32]| {
                raw.create_shader_module(&vk::ShaderModuleCreateInfo::default().code(words), None)
            };
            let modules = [module(&vertex)?, module(&fragment)?];
            let pipeline = pipeline(device, layout, modules, format);
            modules.into_iter().for_each(|module| raw.destroy_shader_module(module, None));
            Ok(Self { layout, pipeline: pipeline? })
        }
    }

    /// Clears colour and depth and draws the boxes. Leaves both images as attachments.
    pub(crate) fn record(
        &self,
        device: &Device,
        commands: vk::CommandBuffer,
        (swapchain, picture): (&Swapchain, &Picture),
        (camera, near): (&Camera, f64),
        blocks: &[Block],
    ) {
        const COLOR: (vk::PipelineStageFlags2, vk::AccessFlags2) = (
            vk::PipelineStageFlags2::COLOR_ATTACHMENT_OUTPUT,
            vk::AccessFlags2::COLOR_ATTACHMENT_WRITE,
        );
        // Tests that come early and late.
        const DEPTH: (vk::PipelineStageFlags2, vk::AccessFlags2) = (
            vk::PipelineStageFlags2::from_raw(
                vk::PipelineStageFlags2::EARLY_FRAGMENT_TESTS.as_raw()
                    | vk::PipelineStageFlags2::LATE_FRAGMENT_TESTS.as_raw(),
            ),
            vk::AccessFlags2::DEPTH_STENCIL_ATTACHMENT_WRITE,
        );
        let [none, color_layout, depth_layout] = [
            vk::ImageLayout::UNDEFINED,
            vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL,
            vk::ImageLayout::DEPTH_STENCIL_ATTACHMENT_OPTIMAL,
        ];
        // The frame before may still test; the submission waits for the window's image at the colour output.
        let color = [(none, COLOR.0, vk::AccessFlags2::NONE), (color_layout, COLOR.0, COLOR.1)];
        let depth = [(none, DEPTH.0, DEPTH.1), (depth_layout, DEPTH.0, DEPTH.1)];
        device.change(commands, picture.image, vk::ImageAspectFlags::COLOR, color);
        device.change(commands, swapchain.depth, vk::ImageAspectFlags::DEPTH, depth);

        let cleared = vk::RenderingAttachmentInfo::default()
            .load_op(vk::AttachmentLoadOp::CLEAR)
            .store_op(vk::AttachmentStoreOp::STORE);
        let color = [cleared
            .image_view(picture.view)
            .image_layout(color_layout)
            .clear_value(vk::ClearValue { color: vk::ClearColorValue { float32: SKY } })];
        let far = vk::ClearDepthStencilValue { depth: FAR, stencil: 0 };
        let depth = cleared
            .image_view(swapchain.depth_view)
            .image_layout(depth_layout)
            .clear_value(vk::ClearValue { depth_stencil: far });
        let [width, height] = swapchain.size;
        let area = [vk::Extent2D { width, height }.into()];
        let viewport = [vk::Viewport {
            width: width as f32,
            height: height as f32,
            max_depth: 1.0,
            ..vk::Viewport::default()
        }];
        let info = vk::RenderingInfo::default()
            .render_area(area[0])
            .layer_count(1)
            .color_attachments(&color)
            .depth_attachment(&depth);
        let (raw, clip_from_world) = (&device.raw, clip_from_world(camera, near));
        // SAFETY: the command buffer is recording; everything bound is live until the frame is done.
        unsafe {
            raw.cmd_begin_rendering(commands, &info);
            raw.cmd_bind_pipeline(commands, vk::PipelineBindPoint::GRAPHICS, self.pipeline);
            raw.cmd_set_viewport(commands, 0, &viewport);
            raw.cmd_set_scissor(commands, 0, &area);
            for block in blocks {
                let stages = vk::ShaderStageFlags::VERTEX;
                let bytes = pushed(clip_from_world, block);
                raw.cmd_push_constants(commands, self.layout, stages, 0, &bytes);
                raw.cmd_draw(commands, 36, 1, 0, 0);
            }
            raw.cmd_end_rendering(commands);
        }
    }

    pub(crate) fn destroy(self, device: &Device) {
        // SAFETY: no frame that draws with it is in flight.
        unsafe {
            device.raw.destroy_pipeline(self.pipeline, None);
            device.raw.destroy_pipeline_layout(self.layout, None);
        }
    }
}

/// Depth is `near / z`: reversed, without a far plane.
fn clip_from_world(camera: &Camera, near: f64) -> DMat4 {
    let (size, center) = ([camera.width, camera.height].map(f64::from), camera.principal_point);
    let clip_from_view = DMat4::from_cols(
        DVec4::new(2.0 * camera.focal.x / size[0], 0.0, 0.0, 0.0),
        DVec4::new(0.0, 2.0 * camera.focal.y / size[1], 0.0, 0.0),
        DVec4::new(2.0 * center.x / size[0] - 1.0, 2.0 * center.y / size[1] - 1.0, 0.0, 1.0),
        DVec4::new(0.0, 0.0, near, 0.0),
    );
    clip_from_view * DMat4::from(camera.view_from_world)
}

/// The push constants of a box.
fn pushed(clip_from_world: DMat4, block: &Block) -> Vec<u8> {
    let Block { center, half_size, color } = block;
    let padded = |vector: [f32; 3]| [vector[0], vector[1], vector[2], 0.0];
    let matrix = clip_from_world.as_mat4().to_cols_array();
    let vectors = [center.as_vec3(), half_size.as_vec3(), *color].map(|it| padded(it.into()));
    let floats = matrix.into_iter().chain(vectors.into_iter().flatten());
    floats.flat_map(f32::to_le_bytes).collect()
}

/// # Safety
/// The modules are those of the shaders beside this file.
unsafe fn pipeline(
    device: &Device,
    layout: vk::PipelineLayout,
    [vertex, fragment]: [vk::ShaderModule; 2],
    format: vk::Format,
) -> Result<vk::Pipeline, vk::Result> {
    let stage = vk::PipelineShaderStageCreateInfo::default().name(c"main");
    let stages = [
        stage.stage(vk::ShaderStageFlags::VERTEX).module(vertex),
        stage.stage(vk::ShaderStageFlags::FRAGMENT).module(fragment),
    ];
    let input = vk::PipelineVertexInputStateCreateInfo::default();
    let assembly = vk::PipelineInputAssemblyStateCreateInfo::default()
        .topology(vk::PrimitiveTopology::TRIANGLE_LIST);
    let viewports =
        vk::PipelineViewportStateCreateInfo::default().viewport_count(1).scissor_count(1);
    let filled = vk::PipelineRasterizationStateCreateInfo::default().line_width(1.0);
    let samples = vk::PipelineMultisampleStateCreateInfo::default()
        .rasterization_samples(vk::SampleCountFlags::TYPE_1);
    let depth = vk::PipelineDepthStencilStateCreateInfo::default()
        .depth_test_enable(true)
        .depth_write_enable(true)
        .depth_compare_op(vk::CompareOp::GREATER);
    let opaque = [vk::PipelineColorBlendAttachmentState::default()
        .color_write_mask(vk::ColorComponentFlags::RGBA)];
    let blending = vk::PipelineColorBlendStateCreateInfo::default().attachments(&opaque);
    let set_later = [vk::DynamicState::VIEWPORT, vk::DynamicState::SCISSOR];
    let set_later = vk::PipelineDynamicStateCreateInfo::default().dynamic_states(&set_later);
    let formats = [format];
    let mut rendering = vk::PipelineRenderingCreateInfo::default()
        .color_attachment_formats(&formats)
        .depth_attachment_format(DEPTH_FORMAT);
    let info = [vk::GraphicsPipelineCreateInfo::default()
        .stages(&stages)
        .vertex_input_state(&input)
        .input_assembly_state(&assembly)
        .viewport_state(&viewports)
        .rasterization_state(&filled)
        .multisample_state(&samples)
        .depth_stencil_state(&depth)
        .color_blend_state(&blending)
        .dynamic_state(&set_later)
        .layout(layout)
        .push_next(&mut rendering)];
    // SAFETY: every pointer is of a live local.
    let made =
        unsafe { device.raw.create_graphics_pipelines(vk::PipelineCache::null(), &info, None) };
    made.map(|pipelines| pipelines[0]).map_err(|(_, error)| error)
}
