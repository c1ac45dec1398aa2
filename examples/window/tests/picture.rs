//! The window's pictures on an X server without a screen, beside what the library renders by itself.

#[allow(dead_code, reason = "the near plane is that of the depth image alone")]
#[path = "../src/scene.rs"]
mod scene;

use std::path::Path;
use std::process::Command;

use nightsplat::glam::{DVec2, DVec3, Vec3};
use nightsplat::{
    Camera, DeviceChoice, Gaussians, Gpu, Image, RenderOptions, RenderSettings, Renderer, Upload,
};
use scene::{Block, Orbit, Scene};

const SKY: [f64; 3] = [0.06, 0.07, 0.23];
/// The first of the splats are before the wall, the others beyond it.
const BEFORE: usize = 300;
const COUNT: usize = 600;

/// Two layers of splats, one before and one beyond the middle of the scene.
fn gaussians() -> Gaussians {
    let mut gaussians = Gaussians::zeros(COUNT, 0);
    let mut state = 7_u32;
    for i in 0..COUNT {
        let mut uniform = |from: f32, to: f32| {
            // The generator of Numerical Recipes.
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            from + (to - from) * (state >> 8) as f32 / 16_777_216.0
        };
        let y = if i < BEFORE { uniform(-1.1, -1.0) } else { uniform(1.0, 1.1) };
        gaussians.means_mut()[i] = Vec3::new(uniform(-0.7, 0.7), y, uniform(-0.4, 0.4));
        gaussians.quats_mut()[i] = [0, 1, 2, 3].map(|_| uniform(-1.0, 1.0));
        gaussians.log_scales_mut()[i] = [0, 1, 2].map(|_| uniform(-3.5, -2.5)).into();
        gaussians.raw_opacities_mut()[i] = uniform(-1.0, 2.0);
        gaussians.dc_mut()[i] = [0, 1, 2].map(|_| uniform(-1.5, 1.5)).into();
    }
    gaussians
}

/// A PLY file of Gaussians, in INRIA's layout.
fn ply(gaussians: &Gaussians) -> Vec<u8> {
    let mut file = b"ply\nformat binary_little_endian 1.0\n".to_vec();
    file.extend(format!("element vertex {COUNT}\n").bytes());
    for name in "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
        .split(' ')
    {
        file.extend(format!("property float {name}\n").bytes());
    }
    file.extend(b"end_header\n");
    for i in 0..COUNT {
        let (mean, dc) = (gaussians.means()[i], gaussians.dc()[i]);
        let (opacity, scale) = (gaussians.raw_opacities()[i], gaussians.log_scales()[i]);
        let row = mean.to_array().into_iter().chain(dc.to_array()).chain([opacity]);
        let row = row.chain(scale.to_array()).chain(gaussians.quats()[i]);
        file.extend(row.flat_map(f32::to_le_bytes));
    }
    file
}

/// The example's picture of `model` with these options.
fn shot(model: &Path, options: &str) -> Image {
    let program = env!("CARGO_BIN_EXE_window");
    let picture = model.with_file_name("window.ppm");
    let run = Command::new("xvfb-run")
        .args(["--auto-servernum", "--server-args", "-screen 0 1280x1024x24"])
        .arg(program)
        .arg(model)
        .args(options.split_whitespace())
        .args(["--frames", "8", "--validate", "--screenshot"])
        .arg(&picture)
        .env_remove("WAYLAND_DISPLAY")
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{program}: {errors}");
    let bytes = std::fs::read(picture).unwrap();
    let mut parts = bytes.splitn(4, |byte| *byte == b'\n');
    let mut line = || String::from_utf8(parts.next().unwrap().to_vec()).unwrap();
    assert_eq!(line(), "P6");
    let size = line();
    assert_eq!(line(), "255");
    let [width, height] = [0, 1].map(|i| size.split(' ').nth(i).unwrap().parse().unwrap());
    let pixels = &bytes[bytes.len() - 3 * (width * height) as usize..];
    let at = |x: u32, y: u32| 3 * (y * width + x) as usize;
    Image::from_fn(width, height, |x, y| [0, 1, 2].map(|i| f32::from(pixels[at(x, y) + i])))
}

/// What the library renders of some Gaussians: colour before black, and transmittance.
fn render(gpu: &Gpu, gaussians: &Gaussians, camera: &Camera) -> [Image; 2] {
    let on_device = gaussians.upload(gpu).unwrap();
    let settings = RenderSettings { shape: gaussians.shape, ..RenderSettings::default() };
    let mut renderer = Renderer::new(gpu, settings).unwrap();
    renderer.reserve(COUNT, [camera]).unwrap();
    let [black, white] = [0.0, 1.0].map(|background| {
        let options = RenderOptions { sh_degree: 0, background: [background; 3] };
        renderer.render_image(&on_device, camera, &options).unwrap()
    });
    let through = Image::from_fn(camera.width, camera.height, |x, y| {
        let (white, black) = (white.pixel(x, y), black.pixel(x, y));
        [0, 1, 2].map(|i| white[i] - black[i])
    });
    [black, through]
}

/// The depth in the view and the colour of the nearest box along a pixel's ray.
fn hit(blocks: &[Block], camera: &Camera, x: u32, y: u32) -> Option<(f64, DVec3)> {
    let at = (DVec2::new(f64::from(x), f64::from(y)) + 0.5 - camera.principal_point) / camera.focal;
    let world_from_view = camera.view_from_world.inverse();
    let eye = world_from_view.translation;
    // Its length along the view is 1, so that distances are depths.
    let ray = world_from_view.transform_vector3(at.extend(1.0));
    let hit = |block: &Block| {
        let first = (block.center - block.half_size - eye) / ray;
        let second = (block.center + block.half_size - eye) / ray;
        let (enters, leaves) = (first.min(second), first.max(second));
        let axis = enters.max_position();
        let depth = enters[axis];
        let shade = 1.0 - 0.2 * axis as f64;
        (depth < leaves.min_element() && depth > 0.0)
            .then(|| (depth, shade * block.color.as_dvec3()))
    };
    blocks.iter().filter_map(hit).min_by(|a, b| a.0.total_cmp(&b.0))
}

/// The light that a value of an sRGB image stands for, and the value that stands for light.
fn linear_from_srgb(srgb: f64) -> f64 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

fn srgb_from_linear(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

fn to_level(value: f64, is_srgb: bool) -> f64 {
    let value = value.clamp(0.0, 1.0);
    255.0 * if is_srgb { srgb_from_linear(value) } else { value }
}

/// The fraction of the picture's values that are further than one level from the composite in f64.
fn off(picture: &Image, has_geometry: bool, is_srgb: bool) -> f64 {
    let gaussians = gaussians();
    let scene = Scene::around(gaussians.means(), false);
    let camera = Orbit::default().camera(&scene, [picture.width, picture.height]);
    let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
    let all = render(&gpu, &gaussians, &camera);
    let mut front = gaussians.clone();
    front.raw_opacities_mut()[BEFORE..].fill(-20.0);
    let front = render(&gpu, &front, &camera);
    let depths = |range: std::ops::Range<usize>| {
        let means = gaussians.means()[range].iter().map(|mean| DVec3::from(*mean));
        means.map(|mean| camera.view_from_world.transform_point3(mean).z).collect::<Vec<_>>()
    };
    let last_before = depths(0..BEFORE).into_iter().fold(0.0, f64::max);
    let first_beyond = depths(BEFORE..COUNT).into_iter().fold(f64::MAX, f64::min);
    let blocks = if has_geometry { scene.blocks().to_vec() } else { vec![] };
    let [mut hidden, mut over, mut wrong] = [0, 0, 0];
    for (x, y) in (0..picture.height).flat_map(|y| (0..picture.width).map(move |x| (x, y))) {
        let (depth, under) = hit(&blocks, &camera, x, y).unwrap_or((f64::MAX, SKY.into()));
        // A wall between the layers hides the second; what is beyond both hides none.
        let is_hidden = depth < first_beyond;
        let [color, through] = if is_hidden { &front } else { &all };
        let (color, through) = (color.pixel(x, y), f64::from(through.pixel(x, y)[0]));
        assert!(!is_hidden || depth > last_before || through == 1.0, "splats are in the wall");
        hidden += u32::from(is_hidden && all[0].pixel(x, y) != front[0].pixel(x, y));
        over += u32::from(depth < f64::MAX && through < 1.0);
        for i in 0..3 {
            let (color, alpha) = (f64::from(color[i]).max(0.0), 1.0 - through);
            // As the host's image holds it.
            let under = (to_level(under[i], is_srgb).round() / 255.0).clamp(0.0, 1.0);
            let value = match is_srgb {
                true if alpha > 0.0 => {
                    linear_from_srgb(color / alpha) * alpha + through * linear_from_srgb(under)
                }
                true => linear_from_srgb(under),
                false => color + through * under,
            };
            let level = to_level(value, is_srgb);
            wrong += u32::from((level - f64::from(picture.pixel(x, y)[i])).abs() > 1.0);
        }
    }
    assert!(!has_geometry || hidden.min(over) > 1000, "{hidden} hidden, {over} over boxes");
    f64::from(wrong) / (3 * picture.width * picture.height) as f64
}

#[test]
fn a_window_shows_splats_before_and_beyond_the_geometry_of_its_host() {
    let model = Path::new(env!("CARGO_TARGET_TMPDIR")).join("model.ply");
    std::fs::write(&model, ply(&gaussians())).unwrap();
    for (options, size, has_geometry, is_srgb) in [
        ("--size 400x300 --resize 500x376", [500, 376], true, false),
        ("--size 500x375 --srgb", [500, 375], true, true),
        ("--size 333x250 --no-geometry", [333, 250], false, false),
    ] {
        let picture = shot(&model, options);
        assert_eq!([picture.width, picture.height], size, "{options}");
        let off = off(&picture, has_geometry, is_srgb);
        assert!(off <= 1e-4, "{options}: {off} of the values are more than a level off");
    }
}

#[test]
fn a_camera_that_is_dragged_still_looks_at_the_scene() {
    let scene = Scene::around(&[Vec3::new(2.0, 3.0, 5.0), Vec3::new(4.0, 3.0, 5.0)], true);
    let mut orbit = Orbit::default();
    let distance =
        |orbit: &Orbit| orbit.camera(&scene, [40, 30]).center().distance(DVec3::new(3.0, 3.0, 5.0));
    let before = distance(&orbit);
    orbit.turn(300.0, -20.0);
    assert!((distance(&orbit) - before).abs() < 1e-9);
    orbit.approach(2.0);
    assert!((distance(&orbit) / before - 0.81).abs() < 1e-9);
    let camera = orbit.camera(&scene, [40, 30]);
    let middle = camera.project(DVec3::new(3.0, 3.0, 5.0)).unwrap();
    assert!(middle.distance(DVec2::new(20.0, 15.0)) < 1e-9, "{middle}");
    assert!(camera.project(DVec3::new(3.0, 2.0, 5.0)).unwrap().y < 15.0, "against y is up");
    assert!(camera.view_from_world.matrix3.determinant() > 0.99);
}
