//! `view --window`: the model in a window, drawn by the device into the window's own images.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use winit::application::ApplicationHandler;
use winit::dpi::{PhysicalPosition, PhysicalSize};
use winit::event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::keyboard::{Key, NamedKey};
use winit::window::{Window, WindowId};

use super::newest::Newest;
use super::overview;
use crate::camera::{Camera, enclosing_sphere};
use crate::gpu::{DeviceChoice, Gpu, HostImage, ImageFormat, ImageState, Surface};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::results::export::page::moved;
use crate::splats::render::{RenderOptions, Renderer, Target};
use crate::splats::scene::Gaussians;
use crate::train::ShownModel;
use crate::{Error, Result};

/// A newer model is looked for this often.
const LOOKS_EVERY: Duration = Duration::from_millis(250);
/// The first size.
const SIZE: [u32; 2] = [1280, 720];
/// Radians that a pixel of a drag turns the camera by.
const TURN: f64 = 0.005;
/// The part of the distance to the centre that a notch of the wheel, or a key, goes.
const STRIDE: f64 = 0.1;

/// What a window begins with.
#[derive(Debug)]
pub(crate) struct Opening {
    pub(crate) title: String,
    /// Views to go through by the arrow keys; at least one, of the window's first size.
    pub(crate) cameras: Vec<Camera>,
    /// The direction that the camera is turned about.
    pub(crate) up: DVec3,
    /// What the camera turns about.
    pub(crate) center: DVec3,
    /// Ends after this number of frames.
    pub(crate) frames: Option<u64>,
    /// The last frame is written to this file.
    pub(crate) screenshot: Option<PathBuf>,
}

impl Opening {
    /// The views of a dataset.
    pub(crate) fn of_dataset(title: String, dataset: &Dataset) -> Self {
        let cameras: Vec<Camera> = dataset.views.iter().map(View::upright_camera).collect();
        let (center, _) = enclosing_sphere(&cameras);
        let cameras = cameras.iter().map(|camera| fitted(camera, SIZE)).collect();
        Self { title, cameras, up: dataset.up(), center, frames: None, screenshot: None }
    }

    /// A model from outside, with -y up.
    pub(crate) fn of_gaussians(title: String, gaussians: &Gaussians) -> Self {
        let (camera, center) = overview(gaussians);
        let camera = moved(&camera, -gaussians.origin);
        let center = center + gaussians.origin;
        let (cameras, up) = (vec![camera], DVec3::NEG_Y);
        Self { title, cameras, up, center, frames: None, screenshot: None }
    }
}

/// A connection to the display of this machine, and a device that presents to it.
#[derive(Debug)]
pub(crate) struct Screen {
    events: EventLoop<()>,
    pub(crate) gpu: Gpu,
}

impl Screen {
    pub(crate) fn open(choice: &DeviceChoice) -> Result<Self> {
        let events = EventLoop::new().map_err(|error| {
            let problem = format!(
                "there is no display for a window ({error}); leave out --window, or use `render`"
            );
            Error::Usage(problem.replace('\n', " "))
        })?;
        let gpu = Gpu::with_display(choice, &events)?;
        Ok(Self { events, gpu })
    }

    /// Shows models until the window is closed.
    pub(crate) fn show(self, opening: Opening, models: &mut dyn Newest) -> Result<()> {
        let camera = opening.cameras[0];
        let mut app = App {
            gpu: self.gpu,
            opening,
            models,
            camera,
            place: 0,
            model: None,
            window: None,
            cursor: None,
            last: PhysicalPosition::default(),
            drawn: 0,
            is_stale: true,
            saves: None,
            looked: None,
            failed: None,
        };
        let ended = self.events.run_app(&mut app);
        if let Some(error) = app.failed {
            return Err(error);
        }
        ended.map_err(|error| Error::Usage(format!("the window failed: {error}")))
    }
}

/// A model with what draws it.
struct Drawn {
    shown: ShownModel,
    renderer: Renderer,
}

struct App<'a> {
    gpu: Gpu,
    opening: Opening,
    models: &'a mut dyn Newest,
    /// Of the dataset's world, and of any size.
    camera: Camera,
    /// The view that the camera is or was.
    place: usize,
    model: Option<Drawn>,
    window: Option<(Surface, Arc<Window>)>,
    /// Where a drag is.
    cursor: Option<PhysicalPosition<f64>>,
    last: PhysicalPosition<f64>,
    drawn: u64,
    /// What the window shows is not what it would draw.
    is_stale: bool,
    /// A picture is to be written once it is drawn.
    saves: Option<PathBuf>,
    looked: Option<Instant>,
    failed: Option<Error>,
}

impl App<'_> {
    fn open(&mut self, events: &ActiveEventLoop) -> Result<()> {
        let Camera { width, height, .. } = self.camera;
        let attributes = Window::default_attributes()
            .with_title(&self.opening.title)
            .with_inner_size(PhysicalSize::new(width, height));
        let window = events.create_window(attributes).map_err(|error| {
            Error::Usage(format!("a window cannot be made: {error}; leave out --window"))
        })?;
        let window = Arc::new(window);
        self.window = Some((Surface::new(&self.gpu, &window)?, window));
        Ok(())
    }

    /// Takes a newer model, if there is one.
    fn look(&mut self) -> Result<()> {
        if self.looked.is_some_and(|at| at.elapsed() < LOOKS_EVERY) {
            return Ok(());
        }
        self.looked = Some(Instant::now());
        if let Some(shown) = self.models.newest(&self.gpu)? {
            let renderer = match self.model.take() {
                Some(Drawn { shown: former, renderer }) if former.settings == shown.settings => {
                    renderer
                }
                _ => Renderer::new(&self.gpu, shown.settings)?,
            };
            self.model = Some(Drawn { shown, renderer });
            self.is_stale = true;
        }
        if let Some((_, window)) = &self.window {
            window.set_title(&format!("{}{}", self.opening.title, self.models.progress()));
        }
        Ok(())
    }

    /// Draws and presents a frame.
    fn draw(&mut self) -> Result<()> {
        let (Some((surface, window)), Some(model)) = (&mut self.window, &mut self.model) else {
            return Ok(());
        };
        let PhysicalSize { width, height } = window.inner_size();
        let Some(acquired) = surface.acquire([width, height])? else { return Ok(()) };
        let Drawn { shown, renderer } = model;
        let camera = shown.frame.camera(&fitted(&self.camera, acquired.image.size));
        let options = RenderOptions { sh_degree: shown.sh_degree, background: [0.0; 3] };
        let is_last = self.opening.frames.is_some_and(|frames| self.drawn + 1 >= frames);
        let saves = match self.opening.screenshot.take_if(|_| is_last) {
            Some(path) => Some(path),
            None => self.saves.take(),
        };
        let image = match saves {
            Some(_) => HostImage { after: ImageState::TRANSFER_SOURCE, ..acquired.image },
            None => acquired.image,
        };
        let drawn = HostImage { before: image.after, ..acquired.image };
        let target = Target { color: Some(&image), ..Target::default() };
        let gaussians = &shown.gaussians;
        renderer.prepare_draw(&gaussians.layout, &[camera], &target)?;
        let [columns, rows] = image.size;
        let pixels = if saves.is_some() { columns as usize * rows as usize } else { 0 };
        let mut copy = self.gpu.uninit("screenshot", pixels)?;
        self.gpu.run("window", |pass| {
            renderer.draw(pass, gaussians, &[camera], &options, &target)?;
            if saves.is_some() {
                pass.take_image(&drawn, image.size, &mut copy);
            }
            Ok(())
        })?;
        surface.present(acquired)?;
        self.drawn += 1;
        // The next frame has memory for what this one left out.
        self.is_stale = renderer.drawn().is_some_and(|drawn| drawn.left_out() > 0);
        if let Some(path) = saves {
            let words = self.gpu.read(&copy)?;
            let order = if image.format == ImageFormat::Bgra8Unorm { [2, 1, 0] } else { [0, 1, 2] };
            let picture = Image::from_fn(columns, rows, |x, y| {
                let bytes = words[(y * columns + x) as usize].to_le_bytes();
                order.map(|channel: usize| f32::from(bytes[channel]) / 255.0)
            });
            picture.save_png8(&path)?;
        }
        Ok(())
    }

    fn ends(&mut self, events: &ActiveEventLoop, outcome: Result<()>) {
        if let Err(error) = outcome {
            self.failed.get_or_insert(error);
            events.exit();
        }
    }

    fn press(&mut self, events: &ActiveEventLoop, key: &Key) {
        let count = self.opening.cameras.len();
        match key {
            Key::Named(NamedKey::Escape) => events.exit(),
            Key::Named(NamedKey::ArrowRight) => self.go_to((self.place + 1) % count),
            Key::Named(NamedKey::ArrowLeft) => self.go_to((self.place + count - 1) % count),
            Key::Named(NamedKey::Space) => self.models.pause(),
            Key::Character(letter) => match letter.as_str() {
                "w" => self.approach(1.0),
                "s" => self.approach(-1.0),
                "p" => self.saves = Some("nightsplat.png".into()),
                "r" => self.go_to(self.place),
                _ => return,
            },
            _ => return,
        }
        self.is_stale = true;
    }

    fn go_to(&mut self, place: usize) {
        (self.place, self.camera) = (place, self.opening.cameras[place]);
    }

    fn approach(&mut self, notches: f64) {
        let distance = self.camera.center().distance(self.opening.center);
        let forward = STRIDE * notches * distance;
        self.camera.view_from_world.translation.z -= forward;
        self.is_stale = true;
    }

    /// Turns the camera about the centre.
    fn turn(&mut self, right: f64, down: f64) {
        let Opening { up, center, .. } = self.opening;
        let across = self.camera.view_from_world.matrix3.transpose().x_axis;
        let by = DQuat::from_axis_angle(up, TURN * right)
            * DQuat::from_axis_angle(across.normalize(), -TURN * down);
        let turn = DAffine3::from_translation(center)
            * DAffine3::from_mat3(DMat3::from_quat(by.inverse()))
            * DAffine3::from_translation(-center);
        self.camera.view_from_world *= turn;
        self.is_stale = true;
    }
}

/// The camera for an image of another size, which shows at least as much.
fn fitted(camera: &Camera, [width, height]: [u32; 2]) -> Camera {
    let [own, new] = [[camera.width, camera.height], [width, height]]
        .map(|[width, height]| DVec2::new(width.into(), height.into()));
    let scale = (new / own).min_element();
    let principal_point = (camera.principal_point - 0.5 * own) * scale + 0.5 * new;
    Camera { width, height, focal: camera.focal * scale, principal_point, ..*camera }
}

impl ApplicationHandler for App<'_> {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        let opened = self.open(events);
        self.ends(events, opened);
    }

    /// While there still is a display.
    fn exiting(&mut self, _: &ActiveEventLoop) {
        (self.model, self.window) = (None, None);
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        if events.exiting() {
            return;
        }
        let looked = self.look();
        self.ends(events, looked);
        if self.models.has_ended() {
            events.exit();
        }
        let is_counting = self.opening.frames.is_some() && self.model.is_some();
        if let Some((_, window)) = self.window.as_ref().filter(|_| self.is_stale || is_counting) {
            window.request_redraw();
        }
        events.set_control_flow(ControlFlow::WaitUntil(Instant::now() + LOOKS_EVERY));
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => events.exit(),
            WindowEvent::Resized(_) => self.is_stale = true,
            WindowEvent::RedrawRequested if self.failed.is_none() && !events.exiting() => {
                let drawn = self.draw();
                self.ends(events, drawn);
                if self.opening.frames.is_some_and(|frames| self.drawn >= frames) {
                    events.exit();
                }
            }
            WindowEvent::KeyboardInput {
                event: KeyEvent { logical_key, state: ElementState::Pressed, .. },
                ..
            } => self.press(events, &logical_key),
            WindowEvent::MouseInput { state, button: MouseButton::Left, .. } => {
                self.cursor = (state == ElementState::Pressed).then_some(self.last);
            }
            WindowEvent::CursorMoved { position, .. } => {
                if let Some(from) = self.cursor {
                    self.turn(position.x - from.x, position.y - from.y);
                    self.cursor = Some(position);
                }
                self.last = position;
            }
            WindowEvent::MouseWheel { delta, .. } => self.approach(match delta {
                MouseScrollDelta::LineDelta(_, lines) => f64::from(lines),
                MouseScrollDelta::PixelDelta(pixels) => pixels.y / 50.0,
            }),
            _ => (),
        }
    }
}
