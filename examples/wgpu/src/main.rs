//! A model in a wgpu texture: `wgpu-host MODEL.ply OUT.ppm [WALL]`. wgpu opens its device as ever, with a callback; the
//! library records into wgpu's own command buffers, over what wgpu drew and hidden by its depth. With WALL, wgpu draws
//! a wall at that depth into the left half. Prints how far the picture is from a device of the library's own.

use std::error::Error;

use nightsplat::Model;
use wgpu_host::{Host, Splats};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, out, wall @ ..] = &*arguments else {
        return Err("usage: wgpu-host MODEL.ply OUT.ppm [WALL]".into());
    };
    let wall = wall.first().map(|depth| depth.parse::<f32>()).transpose()?;
    let host = Host::new()?;
    let mut splats = Splats::new(&host, Model::load(model)?)?;
    let mut pixels = vec![];
    for number in 1..=3 {
        pixels = splats.draw(&host, number, wall)?;
    }
    splats.report(&pixels, out.as_ref(), wall.is_some())
}
