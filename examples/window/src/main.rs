//! A host application with a window: its own geometry and splats in one picture, each in front of the other.
//!
//! In its folder, `cargo run --release -- MODEL.ply`; drag to turn, scroll to approach. The options `--frames N` and
//! `--screenshot FILE.ppm` end by themselves; `USAGE` below has the others.
//!
//! What the host does for the library, in each frame, is [`Splats::record`]. The rest is what any Vulkan application
//! does: `device.rs` has device and queue, `swapchain.rs` the images, `geometry.rs` the host's own pipeline, `scene.rs`
//! boxes and camera.

mod device;
mod geometry;
mod scene;
mod shot;
mod swapchain;

use std::error::Error;
use std::path::PathBuf;

use nightsplat::ash::vk;
use nightsplat::ash::vk::Handle as _;
use nightsplat::{
    Camera, DepthConvention, DeviceGaussians, Gpu, HostFrame, ImageState, Model, Purpose,
    RenderOptions, RenderSettings, Renderer, SceneDepth, Target, Upload,
};
use winit::application::ApplicationHandler;
use winit::dpi::{PhysicalPosition, PhysicalSize};
use winit::event::{ElementState, MouseButton, MouseScrollDelta, WindowEvent};
use winit::event_loop::{ActiveEventLoop, EventLoop};
use winit::window::{Window, WindowId};

use device::Device;
use geometry::Geometry;
use scene::{Orbit, Scene};
use shot::Shot;
use swapchain::{Picture, Swapchain};

const USAGE: &str = "usage: window MODEL [--frames N] [--screenshot FILE.ppm] [--size WxH] [--resize WxH] [--srgb] \
                     [--y-down] [--no-geometry] [--validate]";

/// Frames that the device works on while the next one is recorded.
const IN_FLIGHT: u64 = 2;

type Outcome<T> = Result<T, Box<dyn Error>>;

fn main() -> Outcome<()> {
    let options = Options::parse()?;
    let model = Model::load(&options.model)?;
    let scene = Scene::around(model.gaussians.means(), options.is_y_down);
    let mut app = App {
        options,
        model,
        scene,
        orbit: Orbit::default(),
        is_dragging: false,
        cursor: PhysicalPosition::default(),
        running: None,
        messages: 0,
        failed: None,
    };
    EventLoop::new()?.run_app(&mut app)?;
    match app {
        App { failed: Some(error), .. } => Err(error),
        App { messages: 0, .. } => Ok(()),
        App { messages, .. } => Err(format!("{messages} validation messages").into()),
    }
}

#[derive(Debug, Default)]
struct Options {
    model: PathBuf,
    /// The number after which it ends.
    frames: Option<u64>,
    screenshot: Option<PathBuf>,
    size: [u32; 2],
    /// Another size, half-way through the frames.
    resize: Option<[u32; 2]>,
    /// Linear light is blended, instead of display-referred values.
    is_srgb: bool,
    is_y_down: bool,
    has_no_geometry: bool,
    validates: bool,
}

impl Options {
    fn parse() -> Outcome<Self> {
        let mut options = Self { size: [960, 720], ..Self::default() };
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            let mut value = || words.next().ok_or(USAGE);
            match word.as_str() {
                "--frames" => options.frames = Some(value()?.parse()?),
                "--screenshot" => options.screenshot = Some(value()?.into()),
                "--size" => options.size = size(&value()?)?,
                "--resize" => options.resize = Some(size(&value()?)?),
                "--srgb" => options.is_srgb = true,
                "--y-down" => options.is_y_down = true,
                "--no-geometry" => options.has_no_geometry = true,
                "--validate" => options.validates = true,
                _ if word.starts_with('-') => return Err(USAGE.into()),
                _ => options.model = word.into(),
            }
        }
        if options.model.as_os_str().is_empty() { Err(USAGE.into()) } else { Ok(options) }
    }
}

fn size(word: &str) -> Outcome<[u32; 2]> {
    let (width, height) = word.split_once('x').ok_or(USAGE)?;
    Ok([width.parse()?, height.parse()?])
}

// ---------------------------------------------------------------------------
// The library in the host

struct Splats {
    gpu: Gpu,
    on_device: DeviceGaussians,
    renderer: Renderer,
    options: RenderOptions,
}

impl Splats {
    /// Submits nothing and waits for nothing: the upload is part of the first recording, which must be submitted.
    fn new(device: &Device, model: &Model) -> Outcome<Self> {
        // SAFETY: the handles are the host's own and outlive `gpu`.
        let gpu = unsafe { Gpu::from_host(device.lend()) }?;
        let on_device = model.gaussians.upload(&gpu)?;
        let settings = RenderSettings { purpose: Purpose::Show, ..model.render_settings() };
        let renderer = Renderer::new(&gpu, settings)?;
        let sh_degree = model.gaussians.shape.sh_degree;
        let options = RenderOptions { sh_degree, background: [0.0; 3] };
        Ok(Self { gpu, on_device, renderer, options })
    }

    /// Records the splats into the host's command buffer, which is submitted once, in the order of recording.
    ///
    /// Its geometry is in the colour image as in the depth image, with `near` as the plane at depth 1. One call does
    /// both directions: splats beyond the geometry are hidden, and those in front are blended over it.
    fn record(
        &mut self,
        (commands, number): (vk::CommandBuffer, u64),
        (swapchain, picture): (&Swapchain, &Picture),
        (camera, near): (&Camera, f64),
        after: ImageState,
    ) -> Outcome<()> {
        // The states are those that the host's last barrier leads to, and that its next one begins from.
        let color = swapchain.lend_color(picture, ImageState::COLOR_ATTACHMENT, after);
        let color = color.ok_or("the library does not draw into this format")?;
        let depth = swapchain.lend_depth();
        let convention = DepthConvention::Reversed { near: near as f32, far: None };
        let target = Target {
            color: Some(&color),
            scene: Some(SceneDepth { image: &depth, convention }),
            is_over: true,
            ..Target::default()
        };
        // What the frame uses is kept until the timeline reaches its number, whatever the host drops meanwhile.
        let frame = HostFrame { commands: commands.as_raw(), number, readers: 0 };
        let Self { gpu, on_device, renderer, options } = self;
        // SAFETY: the command buffer is recording, outside a render pass.
        let recorded = unsafe {
            gpu.record_into(&frame, |pass| {
                renderer.draw(pass, &*on_device, &[*camera], options, &target)
            })
        };
        Ok(recorded?)
    }
}

// ---------------------------------------------------------------------------
// The application

/// A command buffer, with the semaphore that says that the window's image is free.
struct Slot {
    commands: vk::CommandBuffer,
    acquired: vk::Semaphore,
}

/// Everything that there is while there is a window.
struct Running {
    splats: Splats,
    geometry: Geometry,
    swapchain: Option<Swapchain>,
    slots: [Slot; IN_FLIGHT as usize],
    /// The number of the last frame.
    number: u64,
    is_srgb: bool,
    device: Device,
    window: Window,
}

impl Running {
    fn new(events: &ActiveEventLoop, options: &Options, model: &Model) -> Outcome<Self> {
        let [width, height] = options.size;
        let attributes = Window::default_attributes()
            .with_title("nightsplat in a window")
            .with_inner_size(PhysicalSize::new(width, height));
        let window = events.create_window(attributes)?;
        let device = Device::new(&window, options.validates)?;
        let swapchain = Swapchain::new(&device, options.size, options.is_srgb, None)?;
        let geometry = Geometry::new(&device, swapchain.format)?;
        let splats = Splats::new(&device, model)?;
        let allocate = vk::CommandBufferAllocateInfo::default()
            .command_pool(device.pool)
            .command_buffer_count(1);
        let slot = || {
            // SAFETY: the device is live.
            let (commands, acquired) = unsafe {
                let acquired = device.raw.create_semaphore(&Default::default(), None)?;
                (device.raw.allocate_command_buffers(&allocate)?[0], acquired)
            };
            Ok::<_, vk::Result>(Slot { commands, acquired })
        };
        let (slots, is_srgb) = ([slot()?, slot()?], options.is_srgb);
        let swapchain = Some(swapchain);
        Ok(Self { splats, geometry, swapchain, slots, number: 0, is_srgb, device, window })
    }

    /// Draws and presents one frame; its picture as a PPM file where `is_shot`, else nothing. `None`: the window has
    /// another size now, and nothing was drawn.
    fn frame(
        &mut self,
        scene: &Scene,
        orbit: &Orbit,
        has_geometry: bool,
        is_shot: bool,
    ) -> Outcome<Option<Vec<u8>>> {
        let number = self.number + 1;
        // The frame before the last used this slot.
        self.device.wait_frame(number.saturating_sub(IN_FLIGHT))?;
        let PhysicalSize { width, height } = self.window.inner_size();
        let Some(swapchain) = &self.swapchain else { return Ok(None) };
        if swapchain.size != [width, height] {
            self.resize()?;
            return Ok(None);
        }
        let Slot { commands, acquired } = self.slots[(number % IN_FLIGHT) as usize];
        let Device { raw, swapchains, .. } = &self.device;
        // SAFETY: the slot is free, and all objects are live until the frame is done.
        unsafe {
            let (chain, none) = (swapchain.raw, vk::Fence::null());
            let index = match swapchains.acquire_next_image(chain, u64::MAX, acquired, none) {
                Ok((index, _)) => index,
                Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => {
                    self.resize()?;
                    return Ok(None);
                }
                Err(error) => return Err(error.into()),
            };
            let picture = swapchain.pictures[index as usize];
            let once = vk::CommandBufferBeginInfo::default()
                .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
            raw.begin_command_buffer(commands, &once)?;
            let view = (&orbit.camera(scene, swapchain.size), scene.near());
            let blocks = scene.blocks();
            let blocks = if has_geometry { &blocks[..] } else { &[] };
            self.geometry.record(&self.device, commands, (swapchain, &picture), view, blocks);
            let after = if is_shot { ImageState::TRANSFER_SOURCE } else { ImageState::PRESENT };
            self.splats.record((commands, number), (swapchain, &picture), view, after)?;
            let shot = is_shot.then(|| Shot::record(&self.device, commands, swapchain, picture));
            let shot = shot.transpose()?;
            raw.end_command_buffer(commands)?;
            self.submit(commands, acquired, picture.drawn, number)?;
            self.number = number;
            let (drawn, chains, indices) = ([picture.drawn], [chain], [index]);
            let present = vk::PresentInfoKHR::default()
                .wait_semaphores(&drawn)
                .swapchains(&chains)
                .image_indices(&indices);
            match swapchains.queue_present(self.device.queue, &present) {
                // The next frame sees the other size.
                Ok(_) | Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => (),
                Err(error) => return Err(error.into()),
            }
            self.device.wait_frame(if is_shot { number } else { 0 })?;
            Ok(Some(shot.map_or_else(|| Ok(vec![]), |shot| shot.read(&self.device))?))
        }
    }

    /// Once the frame is done, the timeline reaches its number.
    fn submit(
        &self,
        commands: vk::CommandBuffer,
        acquired: vk::Semaphore,
        drawn: vk::Semaphore,
        number: u64,
    ) -> Result<(), vk::Result> {
        let wait = [vk::SemaphoreSubmitInfo::default()
            .semaphore(acquired)
            .stage_mask(vk::PipelineStageFlags2::COLOR_ATTACHMENT_OUTPUT)];
        let all =
            vk::SemaphoreSubmitInfo::default().stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS);
        let signal = [all.semaphore(drawn), all.semaphore(self.device.frames).value(number)];
        let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let info = [vk::SubmitInfo2::default()
            .wait_semaphore_infos(&wait)
            .command_buffer_infos(&buffers)
            .signal_semaphore_infos(&signal)];
        // SAFETY: the command buffer is recorded; this is the queue's only thread.
        unsafe { self.device.raw.queue_submit2(self.device.queue, &info, vk::Fence::null()) }
    }

    /// Images of the window's size; the library needs to know nothing of it, as it learns of images by each draw.
    fn resize(&mut self) -> Outcome<()> {
        let PhysicalSize { width, height } = self.window.inner_size();
        if width == 0 || height == 0 {
            return Ok(());
        }
        // SAFETY: this is the queue's only thread.
        unsafe { self.device.raw.queue_wait_idle(self.device.queue) }?;
        let former = self.swapchain.take();
        let size = [width, height];
        self.swapchain = Some(Swapchain::new(&self.device, size, self.is_srgb, former)?);
        Ok(())
    }

    /// The number of validation messages.
    fn destroy(self) -> u32 {
        let Self { splats, geometry, swapchain, slots, device, window, .. } = self;
        // SAFETY: this is the queue's only thread; nothing is in flight after it.
        unsafe {
            // A lost device is destroyed all the same.
            let _ = device.raw.device_wait_idle();
            // What the library made goes before the device does.
            drop(splats);
            geometry.destroy(&device);
            for slot in slots {
                device.raw.destroy_semaphore(slot.acquired, None);
            }
        }
        if let Some(swapchain) = swapchain {
            swapchain.destroy(&device);
        }
        let messages = device.destroy();
        drop(window);
        messages
    }
}

struct App {
    options: Options,
    model: Model,
    scene: Scene,
    orbit: Orbit,
    is_dragging: bool,
    cursor: PhysicalPosition<f64>,
    running: Option<Running>,
    /// Of the validation layers.
    messages: u32,
    failed: Option<Box<dyn Error>>,
}

impl App {
    /// One frame, and what the options ask for after it.
    fn redraw(&mut self, events: &ActiveEventLoop) -> Outcome<()> {
        let Self { options, scene, orbit, running, .. } = self;
        let Some(running) = running else { return Ok(()) };
        let is_last = options.frames.is_some_and(|frames| running.number + 1 >= frames);
        let is_shot = is_last && options.screenshot.is_some();
        let Some(shot) = running.frame(scene, orbit, !options.has_no_geometry, is_shot)? else {
            return Ok(());
        };
        if let Some(path) = options.screenshot.as_ref().filter(|_| is_shot) {
            std::fs::write(path, shot)?;
        }
        let is_half = options.frames.is_some_and(|frames| running.number == frames / 2);
        if let Some([width, height]) = options.resize.filter(|_| is_half) {
            let _ = running.window.request_inner_size(PhysicalSize::new(width, height));
        }
        if running.number % 64 == 0 {
            // Of the newest frame that is done; it waits for none.
            let drawn = running.splats.renderer.drawn();
            let [count, out] = drawn.map_or([0; 2], |it| [it.intersections, it.left_out()]);
            running.window.set_title(&format!("{count} intersections, {out} left out"));
        }
        if is_last {
            events.exit();
        }
        Ok(())
    }

    fn ends_on_error(&mut self, events: &ActiveEventLoop, outcome: Outcome<()>) {
        if let Err(error) = outcome {
            self.failed.get_or_insert(error);
            events.exit();
        }
    }
}

impl ApplicationHandler for App {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        let made = Running::new(events, &self.options, &self.model);
        let made = made.map(|running| self.running = Some(running));
        self.ends_on_error(events, made);
    }

    /// While there still is a display.
    fn exiting(&mut self, _: &ActiveEventLoop) {
        self.messages = self.running.take().map_or(0, Running::destroy);
    }

    fn about_to_wait(&mut self, _: &ActiveEventLoop) {
        if let Some(running) = &self.running {
            running.window.request_redraw();
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => events.exit(),
            WindowEvent::RedrawRequested if self.failed.is_none() && !events.exiting() => {
                let drawn = self.redraw(events);
                self.ends_on_error(events, drawn);
            }
            WindowEvent::MouseInput { state, button: MouseButton::Left, .. } => {
                self.is_dragging = state == ElementState::Pressed;
            }
            WindowEvent::CursorMoved { position, .. } => {
                if self.is_dragging {
                    self.orbit.turn(position.x - self.cursor.x, position.y - self.cursor.y);
                }
                self.cursor = position;
            }
            WindowEvent::MouseWheel { delta, .. } => self.orbit.approach(match delta {
                MouseScrollDelta::LineDelta(_, lines) => f64::from(lines),
                MouseScrollDelta::PixelDelta(pixels) => pixels.y / 50.0,
            }),
            _ => (),
        }
    }
}
