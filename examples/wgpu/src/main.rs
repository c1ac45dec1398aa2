//! A model in a wgpu texture: `wgpu-host MODEL.ply OUT.ppm [WALL]`. wgpu opens its device as ever, with a callback; the
//! library records into wgpu's own command buffers, over what wgpu drew and hidden by its depth. With WALL, wgpu draws
//! a wall at that depth into the left half. Prints how far the picture is from a device of the library's own.

mod host;

use std::error::Error;

use host::{Host, SIZE};
use nightsplat::glam::{DAffine3, DVec3};
use nightsplat::{
    Camera, DepthConvention, DeviceChoice, Gpu, Model, Purpose, RenderOptions, RenderSettings,
    Renderer, SceneDepth, Target,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, out, wall @ ..] = &*arguments else {
        return Err("usage: wgpu-host MODEL.ply OUT.ppm [WALL]".into());
    };
    let wall = wall.first().map(|depth| depth.parse::<f32>()).transpose()?;
    let model = Model::load(model)?;
    let host = Host::new()?;
    let pixels = draw(&host, &model, wall)?;
    let mut file = format!("P6\n{} {}\n255\n", SIZE[0], SIZE[1]).into_bytes();
    file.extend(pixels.chunks(4).flat_map(|pixel| &pixel[..3]));
    std::fs::write(out, file)?;
    println!("largest difference {}", largest_difference(&model, &pixels, wall.is_some())?);
    Ok(())
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

/// Three frames, of which no one waits for another; the bytes of the last.
fn draw(host: &Host, model: &Model, wall: Option<f32>) -> Result<Vec<u8>, Box<dyn Error>> {
    // SAFETY: the device outlives what is made with it, and `Host::finish` waits for every frame.
    let gpu = unsafe { Gpu::from_host(host.lend()) }?;
    let on_device = model.gaussians.upload(&gpu)?;
    let settings = RenderSettings { purpose: Purpose::Show, ..model.render_settings() };
    let mut renderer = Renderer::new(&gpu, settings)?;
    let (color, depth) = host.images();
    let convention = DepthConvention::Forward { near: host::NEAR, far: None };
    let target = Target {
        color: Some(&color),
        scene: Some(SceneDepth { image: &depth, convention }),
        is_over: true,
        ..Target::default()
    };
    let mut pixels = vec![];
    for number in 1..=3 {
        pixels = host.frame(number, wall, |frame| {
            // SAFETY: wgpu records the command buffer, and is in no pass.
            unsafe {
                gpu.record_into(&frame, |pass| {
                    renderer.draw(pass, &on_device, &[camera(model)], &options(model), &target)
                })
            }
        })?;
    }
    drop((renderer, on_device));
    gpu.frames_done(u64::MAX);
    Ok(pixels)
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
