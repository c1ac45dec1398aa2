//! Drawing into a host's images, with its depth, from a device that only records.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

mod eyes;
mod frames;
mod instances;
mod kernels;
pub(crate) mod photograph;
mod picks;

use ash::vk::Handle as _;
use half::f16;
use nightsplat::gpu::{HostFrame, HostImage, ImageFormat, ImageState, Reference as _};
use nightsplat::kernels::{depth_limits, pack_pixels, pixels};
use nightsplat::reference::pack_pixels as pack_pixels_reference;
use nightsplat::splats::device::DeviceGaussians;
use nightsplat::splats::render::{DepthConvention, DepthKind, Purpose, SceneDepth, Target};

use crate::common::not_run;
use crate::common::prelude::*;
use crate::host::{Host, Picture, usual_extensions, with_host};
use kernels::{random_word, words_of};

pub(crate) const SIZE: [u32; 2] = [48, 40];
const PIXELS: usize = 48 * 40;
pub(crate) const OPTIONS: RenderOptions =
    RenderOptions { sh_degree: 0, background: [0.1, 0.2, 0.3] };

// ---------------------------------------------------------------------------
// What is drawn

/// Two views, one for each layer.
pub(crate) fn cameras() -> [Camera; 2] {
    [0.0, 0.3].map(|shift| pinhole(SIZE, 40.0, DAffine3::from_translation(shift * DVec3::X)))
}

/// Some three hundred in front of the cameras, 2 to 3 away.
pub(crate) fn gaussians() -> Gaussians {
    let mut gaussians = Gaussians::zeros(300, 0);
    let count = gaussians.count;
    for (i, value) in gaussians.parameters.iter_mut().enumerate() {
        let uniform = Stream::new(1, 0).uniform(i as u64) as f32;
        *value = match i / count {
            // Means lie in a plane of their own, three numbers each.
            0..3 if i % 3 == 2 => 2.0 + uniform,
            0..3 => 2.0 * uniform - 1.0,
            3..7 => uniform + 0.1,
            7..10 => -3.0 + uniform,
            10 => 3.0 * uniform - 1.0,
            _ => 2.0 * uniform,
        };
    }
    gaussians
}

fn show_settings() -> RenderSettings {
    RenderSettings { shape: 0.into(), purpose: Purpose::Show, ..RenderSettings::default() }
}

/// The Gaussians on a host's device, and a renderer that shows them.
struct Shown<'a> {
    host: &'a Host,
    gpu: &'a Gpu,
    on_device: DeviceGaussians,
    renderer: Renderer,
}

impl<'a> Shown<'a> {
    fn new(host: &'a Host, gpu: &'a Gpu) -> Self {
        let on_device = gaussians().upload(gpu).unwrap();
        Self { host, gpu, on_device, renderer: Renderer::new(gpu, show_settings()).unwrap() }
    }
}

/// Draws one frame into `target` and waits for it.
fn draw(shown: &mut Shown<'_>, frame: u64, target: &Target<'_>) {
    let Shown { host, gpu, on_device, renderer } = shown;
    let commands = host.begin();
    record(gpu, commands.as_raw(), frame, renderer, on_device, target);
    host.submit_frame(commands, frame);
    host.wait_frame(frame);
}

fn record(
    gpu: &Gpu,
    commands: u64,
    number: u64,
    renderer: &mut Renderer,
    on_device: &DeviceGaussians,
    target: &Target<'_>,
) {
    let frame = HostFrame { commands, number, readers: 0 };
    // SAFETY: the command buffer is recording, outside a render pass.
    let recorded = unsafe {
        gpu.record_into(&frame, |pass| renderer.draw(pass, on_device, &cameras(), &OPTIONS, target))
    };
    recorded.unwrap();
}

/// The planes of a view and its transmittances before black, by our own device.
fn planes(camera: &Camera) -> (Vec<f32>, Vec<f32>) {
    let gpu = gpu();
    let on_device = gaussians().upload(&gpu).unwrap();
    let settings = RenderSettings { purpose: Purpose::Train, ..show_settings() };
    let mut renderer = Renderer::new(&gpu, settings).unwrap();
    renderer.reserve(on_device.layout.count, [camera]).unwrap();
    let black = RenderOptions { background: [0.0; 3], ..OPTIONS };
    let mut planes = renderer.render_planes(&on_device, camera, &black).unwrap();
    let transmittances = planes.split_off(3 * PIXELS);
    (planes, transmittances)
}

/// A format, how it stores a pixel, and what its colours are.
#[derive(Clone, Copy, Debug)]
struct Stored {
    format: ImageFormat,
    storage: u32,
    light: u32,
    swaps: u32,
}

impl Stored {
    const fn new(format: ImageFormat, storage: u32, light: u32, swaps: u32) -> Self {
        Self { format, storage, light, swaps }
    }

    /// Of an image.
    fn words(self) -> usize {
        words_of(self.storage) * PIXELS
    }

    fn hdr10_nits(self) -> Option<f32> {
        (self.light == pixels::LIGHT_HDR10).then_some(NITS)
    }

    /// A display-referred value as the image counts it.
    fn counted(self, c: f32) -> f32 {
        match self.light {
            pixels::LIGHT_DISPLAY => c,
            _ => (1.5 * pack_pixels_reference::eotf(c.into())) as f32,
        }
    }

    /// Words of any pixels.
    fn random(self, random: &mut Random) -> Vec<u32> {
        (0..self.words()).map(|_| random_word(self.storage, random)).collect()
    }
}

/// Of light 1 in HDR10.
const NITS: f32 = 203.0;

const COLOR_FORMATS: [Stored; 12] = [
    Stored::new(ImageFormat::Rgba16Float, pixels::STORED_HALVES, pixels::LIGHT_LINEAR, 0),
    Stored::new(ImageFormat::Rgba32Float, pixels::STORED_FLOATS, pixels::LIGHT_LINEAR, 0),
    Stored::new(ImageFormat::B10G11R11Float, pixels::STORED_SMALL_FLOATS, pixels::LIGHT_LINEAR, 0),
    Stored::new(ImageFormat::Rgba8Unorm, pixels::STORED_BYTES, pixels::LIGHT_DISPLAY, 0),
    Stored::new(ImageFormat::Rgba8Srgb, pixels::STORED_BYTES, pixels::LIGHT_SRGB, 0),
    Stored::new(ImageFormat::Bgra8Unorm, pixels::STORED_BYTES, pixels::LIGHT_DISPLAY, 1),
    Stored::new(ImageFormat::Bgra8Srgb, pixels::STORED_BYTES, pixels::LIGHT_SRGB, 1),
    Stored::new(ImageFormat::A2B10G10R10Unorm, pixels::STORED_TENS, pixels::LIGHT_DISPLAY, 0),
    Stored::new(ImageFormat::A2R10G10B10Unorm, pixels::STORED_TENS, pixels::LIGHT_DISPLAY, 1),
    Stored::new(ImageFormat::A2B10G10R10Unorm, pixels::STORED_TENS, pixels::LIGHT_HDR10, 0),
    Stored::new(ImageFormat::A2R10G10B10Unorm, pixels::STORED_TENS, pixels::LIGHT_HDR10, 1),
    Stored::new(ImageFormat::Rgba16Float, pixels::STORED_HALVES, pixels::LIGHT_DISPLAY, 0),
];

/// Planes and transmittances as an image has them.
fn packed(
    (render, transmittances): (&[f32], &[f32]),
    stored: Stored,
    under: Option<&[u32]>,
) -> Vec<u32> {
    let (mut pixels, mut depths) = (vec![0; stored.words()], vec![0.0; PIXELS]);
    let params = pack_pixels::Params {
        pixel_count: PIXELS as u32,
        storage: stored.storage,
        light: stored.light,
        swaps: stored.swaps,
        is_over: under.is_some().into(),
        exposure: 1.5,
        nits: NITS,
        background: OPTIONS.background.map(|c| stored.counted(c)).into(),
        has_color: 1,
        ..pack_pixels::Params::default()
    };
    let slices = pack_pixels::Slices {
        render,
        transmittances,
        under: under.unwrap_or_default(),
        scene: &[],
        pixels: &mut pixels,
        depths: &mut depths,
    };
    pack_pixels::Kernel::run(&params, &pack_pixels::Constants {}, slices);
    pixels
}

/// The largest difference of two images in levels of their format; of 32-bit floats, in those of halves.
fn levels(a: &[u32], b: &[u32], storage: u32) -> u32 {
    let fields = |word: u32| match storage {
        pixels::STORED_FLOATS => {
            vec![u32::from(f16::from_f32(f32::from_bits(word)).to_bits() & 0x7fff)]
        }
        pixels::STORED_HALVES => vec![word & 0x7fff, word >> 16 & 0x7fff],
        pixels::STORED_SMALL_FLOATS => vec![word & 0x7ff, word >> 11 & 0x7ff, word >> 22],
        pixels::STORED_TENS => [0, 10, 20, 30].map(|shift| word >> shift & 0x3ff).to_vec(),
        _ => word.to_le_bytes().map(u32::from).to_vec(),
    };
    assert_eq!(a.len(), b.len());
    let [a, b] = [a, b].map(|words| words.iter().flat_map(|&word| fields(word)));
    a.zip(b).map(|(a, b)| a.abs_diff(b)).max().unwrap_or_default()
}

#[test]
fn every_colour_format_gets_our_own_render_to_a_level_in_each_layer_over_what_it_has_or_not() {
    with_host(|host, gpu| {
        let mut shown = Shown::new(host, gpu);
        let all = COLOR_FORMATS.into_iter().flat_map(|stored| [(stored, false), (stored, true)]);
        for (frame, (stored, is_over)) in (1..).zip(all) {
            let mut random = Random::new(frame);
            let under = [0, 1].map(|_| stored.random(&mut random));
            let picture = host.picture(stored.format, SIZE).unwrap();
            host.fill_picture(&picture, [&under[0], &under[1]], ImageState::SAMPLED);
            let image = picture.lent(ImageState::SAMPLED, ImageState::TRANSFER_SOURCE);
            let target = Target {
                color: Some(&image),
                is_over,
                is_display_referred: stored.light == pixels::LIGHT_DISPLAY,
                exposure: 1.5,
                hdr10_nits: stored.hdr10_nits(),
                ..Target::default()
            };
            draw(&mut shown, frame, &target);
            let layers = host.read_picture(&picture, stored.words());
            for ((camera, pixels), under) in cameras().iter().zip(&layers).zip(&under) {
                let (render, transmittances) = planes(camera);
                let under = is_over.then_some(&under[..]);
                let expected = packed((&render, &transmittances), stored, under);
                let off = levels(pixels, &expected, stored.storage);
                assert!(off <= 1, "{stored:?}: {off} levels");
            }
            assert_ne!(layers[0], layers[1], "both layers show one view");
            host.free_picture(picture);
        }
    });
}

// ---------------------------------------------------------------------------
// Depth

/// A scene's depth image whose pixels all have one depth, or no depth in the right half.
fn scene(host: &Host, format: ImageFormat, word: impl Fn(u32) -> u32) -> Option<Picture> {
    let picture = host.picture(format, SIZE)?;
    let words: Vec<u32> = match format {
        ImageFormat::D16Unorm => {
            (0..PIXELS as u32 / 2).map(|pair| word(2 * pair) | word(2 * pair + 1) << 16).collect()
        }
        _ => (0..PIXELS as u32).map(word).collect(),
    };
    host.fill_picture(&picture, [&words, &words], scene_state(format));
    Some(picture)
}

/// The state of a scene's depth before and after a draw.
fn scene_state(format: ImageFormat) -> ImageState {
    match format {
        ImageFormat::R32Float => ImageState::SAMPLED,
        _ => ImageState::DEPTH_ATTACHMENT,
    }
}

/// The alphas of layer 0 with this depth image, as halves.
fn alphas(
    shown: &mut Shown<'_>,
    frame: u64,
    scene: Option<(&Picture, DepthConvention)>,
) -> Vec<f32> {
    let host = shown.host;
    let picture = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
    let image = picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE);
    let lent = scene.map(|(picture, convention)| {
        let state = scene_state(picture.format);
        (picture.lent(state, state), convention)
    });
    let scene =
        lent.as_ref().map(|(image, convention)| SceneDepth { image, convention: *convention });
    draw(shown, frame, &Target { color: Some(&image), scene, ..Target::default() });
    let [layer, _] = host.read_picture(&picture, 2 * PIXELS);
    host.free_picture(picture);
    layer.chunks(2).map(|pixel| f16::from_bits((pixel[1] >> 16) as u16).to_f32()).collect()
}

#[test]
fn the_hosts_depth_hides_what_is_beyond_it_in_every_format_and_convention() {
    let (near, far) = (0.1f32, Some(40.0f32));
    // The depth value of a distance.
    let value = |z: f32, convention| match convention {
        DepthConvention::Linear => z,
        DepthConvention::Reversed { far: None, .. } => near / z,
        DepthConvention::Forward { far: None, .. } => 1.0 - near / z,
        DepthConvention::Reversed { far: Some(far), .. } => near * (far - z) / (z * (far - near)),
        DepthConvention::Forward { far: Some(far), .. } => far * (z - near) / (z * (far - near)),
    };
    with_host(|host, gpu| {
        let mut shown = Shown::new(host, gpu);
        let untested = alphas(&mut shown, 1, None);
        assert!(untested.iter().any(|&alpha| alpha > 0.5));
        let mut frame = 1;
        for format in [
            ImageFormat::D32Float,
            ImageFormat::R32Float,
            ImageFormat::D16Unorm,
            ImageFormat::D24UnormX8,
            ImageFormat::D32FloatS8,
            ImageFormat::D24UnormS8,
        ] {
            let bits = |depth: f32| match format {
                ImageFormat::D16Unorm => (depth * 65_535.0).round() as u32,
                ImageFormat::D24UnormX8 | ImageFormat::D24UnormS8 => {
                    (depth * 16_777_215.0).round() as u32
                }
                _ => depth.to_bits(),
            };
            let mut conventions = vec![
                DepthConvention::Forward { near, far },
                DepthConvention::Reversed { near, far },
                DepthConvention::Forward { near, far: None },
                DepthConvention::Reversed { near, far: None },
            ];
            if matches!(format, ImageFormat::D32Float | ImageFormat::R32Float) {
                conventions.push(DepthConvention::Linear);
            }
            for convention in conventions {
                frame += 3;
                // A wall beyond everything, one before everything, and one before the left half.
                let wall = |z: f32| bits(value(z, convention));
                let Some(beyond) = scene(host, format, |_| wall(35.0)) else {
                    not_run("image-formats", format_args!("no {format:?} images to copy"));
                    break;
                };
                let seen = alphas(&mut shown, frame, Some((&beyond, convention)));
                assert_eq!(seen, untested, "{format:?}, {convention:?}: far away");
                let before = scene(host, format, |_| wall(0.5)).unwrap();
                let seen = alphas(&mut shown, frame + 1, Some((&before, convention)));
                assert!(seen.iter().all(|&alpha| alpha == 0.0), "{format:?}, {convention:?}");
                let half =
                    |at: u32| if at % SIZE[0] < SIZE[0] / 2 { wall(0.5) } else { wall(35.0) };
                let half = scene(host, format, half).unwrap();
                let seen = alphas(&mut shown, frame + 2, Some((&half, convention)));
                for (at, (seen, untested)) in seen.into_iter().zip(&untested).enumerate() {
                    let is_hidden = at as u32 % SIZE[0] < SIZE[0] / 2;
                    assert_eq!(seen, if is_hidden { 0.0 } else { *untested }, "{format:?} {at}");
                }
                [beyond, before, half].into_iter().for_each(|picture| host.free_picture(picture));
            }
        }
    });
}

/// Every pass of a draw with depths in and out, on a device that submits, against the references.
#[test]
fn a_draw_with_depths_agrees_with_the_references_and_with_a_composite() {
    let host = Host::new(usual_extensions());
    {
        // SAFETY: the handles are the host's own and outlive `gpu`; nothing else uses the queue meanwhile.
        let gpu = unsafe { Gpu::from_host(host.lend()) }.unwrap();
        let wall = scene(&host, ImageFormat::D32Float, |_| (0.1f32 / 2.5).to_bits()).unwrap();
        let lent = wall.lent(ImageState::DEPTH_ATTACHMENT, ImageState::DEPTH_ATTACHMENT);
        let convention = DepthConvention::Reversed { near: 0.1, far: None };
        let on_device = gaussians().upload(&gpu).unwrap();
        let mut renderer = Renderer::new(&gpu, show_settings()).unwrap();
        for depth_kind in [DepthKind::Median, DepthKind::Expected] {
            let color = host.picture(ImageFormat::Rgba16Float, SIZE).unwrap();
            let depth = host.picture(ImageFormat::R32Float, SIZE).unwrap();
            let [color_image, depth_image]: [HostImage; 2] = [&color, &depth]
                .map(|picture| picture.lent(ImageState::UNDEFINED, ImageState::TRANSFER_SOURCE));
            let target = Target {
                color: Some(&color_image),
                depth: Some(&depth_image),
                depth_kind,
                scene: Some(SceneDepth { image: &lent, convention }),
                ..Target::default()
            };
            let (done, report) = gpu.checked(|| {
                gpu.run("draw", |pass| {
                    renderer.draw(pass, &on_device, &cameras(), &OPTIONS, &target)
                })
            });
            done.unwrap();
            report.agree().unwrap();
            let names: Vec<&str> = report.kernels().iter().map(|(name, ..)| *name).collect();
            assert!(names.contains(&"depth_limits") && names.contains(&"pack_pixels"), "{names:?}");
            let [pixels, _] = host.read_picture(&color, 2 * PIXELS);
            let [depths, _] = host.read_picture(&depth, PIXELS);
            let mut seen = 0;
            for (pixel, depth) in pixels.chunks(2).zip(depths) {
                let alpha = f16::from_bits((pixel[1] >> 16) as u16).to_f32();
                let depth = f32::from_bits(depth);
                if alpha > 0.6 {
                    seen += 1;
                    assert!((1.9..=2.5).contains(&depth), "{depth} at alpha {alpha}");
                } else if alpha == 0.0 {
                    assert!(depth.is_infinite());
                }
            }
            assert!(seen > 20, "{seen} pixels are covered");
            [color, depth].into_iter().for_each(|picture| host.free_picture(picture));
        }
        host.free_picture(wall);
    }
    host.destroy();
}
