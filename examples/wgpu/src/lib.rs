//! A host whose device wgpu owns, for the programs of this crate: `wgpu-host`, and a plug-in of Bevy.

mod host;

use std::error::Error;
use std::path::Path;

pub use host::{FEATURES, Host, enable};
use host::{NEAR, SIZE};
use nightsplat::glam::{DAffine3, DVec3};
use nightsplat::{
    Camera, DepthConvention, DeviceChoice, DeviceGaussians, Gpu, Model, Purpose, RenderOptions,
    RenderSettings, Renderer, SceneDepth, Target, Upload,
};

/// A model on the device of a host. It is dropped before the host.
pub struct Splats {
    model: Model,
    gpu: Gpu,
    on_device: DeviceGaussians,
    renderer: Renderer,
}

impl Splats {
    /// Uploads the model.
    pub fn new(host: &Host, model: Model) -> Result<Self, Box<dyn Error>> {
        // SAFETY: the device outlives what is made with it, and every frame waits for its picture.
        let gpu = unsafe { Gpu::from_host(host.lend()) }?;
        let on_device = model.gaussians.upload(&gpu)?;
        let settings = RenderSettings { purpose: Purpose::Show, ..model.render_settings() };
        let renderer = Renderer::new(&gpu, settings)?;
        Ok(Self { model, gpu, on_device, renderer })
    }

    /// Draws over the host's picture, hidden by its depth; the bytes of the picture, RGBA.
    pub fn draw(
        &mut self,
        host: &Host,
        number: u64,
        wall: Option<f32>,
    ) -> Result<Vec<u8>, Box<dyn Error>> {
        let (color, depth) = host.images();
        let convention = DepthConvention::Forward { near: NEAR, far: None };
        let target = Target {
            color: Some(&color),
            scene: Some(SceneDepth { image: &depth, convention }),
            is_over: true,
            ..Target::default()
        };
        let Self { model, gpu, on_device, renderer } = self;
        host.frame(number, wall, |frame| {
            // SAFETY: wgpu records the command buffer, and is in no pass.
            unsafe {
                gpu.record_into(&frame, |pass| {
                    renderer.draw(pass, &*on_device, &[camera(model)], &options(model), &target)
                })
            }
        })
    }

    /// Writes the picture, and prints how far it is from one of a device of the library's own; where there is a wall,
    /// in the right half.
    pub fn report(&self, pixels: &[u8], out: &Path, has_wall: bool) -> Result<(), Box<dyn Error>> {
        let mut file = format!("P6\n{} {}\n255\n", SIZE[0], SIZE[1]).into_bytes();
        file.extend(pixels.chunks(4).flat_map(|pixel| &pixel[..3]));
        std::fs::write(out, file)?;
        println!("largest difference {}", largest_difference(&self.model, pixels, has_wall)?);
        Ok(())
    }
}

impl Drop for Splats {
    fn drop(&mut self) {
        self.gpu.frames_done(u64::MAX);
    }
}

/// A camera four units before the middle of the model.
fn camera(model: &Model) -> Camera {
    let means = model.gaussians.means();
    let sum: DVec3 = means.iter().map(|mean| mean.as_dvec3()).sum();
    let eye = sum / means.len().max(1) as f64 - DVec3::Z * 4.0;
    Camera::perspective(DAffine3::from_translation(-eye), 0.87, SIZE)
}

fn options(model: &Model) -> RenderOptions {
    RenderOptions { sh_degree: model.gaussians.shape.sh_degree, background: [0.0; 3] }
}

/// Of the bytes from those of the same camera on a device of the library's own; where there is a wall, in the right
/// half.
fn largest_difference(model: &Model, pixels: &[u8], has_wall: bool) -> nightsplat::Result<u8> {
    let gpu = Gpu::new(&DeviceChoice::Best)?;
    let camera = camera(model);
    let mut renderer = Renderer::new(&gpu, model.render_settings())?;
    renderer.reserve(model.gaussians.count, [&camera])?;
    let uploaded = model.gaussians.upload(&gpu)?;
    let image = renderer.render_image(&uploaded, &camera, &options(model))?;
    let columns = if has_wall { SIZE[0] / 2 } else { 0 }..SIZE[0];
    let mut largest = 0;
    for (at, pixel) in (0..).zip(pixels.chunks(4)) {
        let (x, y) = (at % SIZE[0], at / SIZE[0]);
        let expected = image.pixel(x, y);
        let difference = |c: usize| {
            let byte = (expected[c].clamp(0.0, 1.0) * 255.0).round() as u8;
            if columns.contains(&x) { pixel[c].abs_diff(byte) } else { 0 }
        };
        largest = (0..3).map(difference).fold(largest, u8::max);
    }
    Ok(largest)
}
