//! Windows of a view: where they lie, and what is copied.

use glam::UVec2;
use nightsplat::gpu::Reference;
use nightsplat::gpu::testing::{assert_no_validation_messages, gpu};
use nightsplat::kernels::{window_gather, window_scatter};
use nightsplat::random::Stream;
use nightsplat::window::{Window, Windows};

#[test]
fn a_crop_lies_in_the_view_and_its_margin_is_cut_off_there() {
    let stream = Stream::new(1, 2);
    let view = UVec2::new(40, 25);
    let mut corners = std::collections::BTreeSet::new();
    for draw in 0..2000 {
        let window = Window::random(view, 20, 6, &stream, draw);
        assert_eq!(window.crop_size, UVec2::splat(20));
        let corner = window.origin + window.crop_origin;
        assert!((corner + window.crop_size).cmple(view).all());
        assert_eq!(window.origin, corner.saturating_sub(UVec2::splat(6)));
        assert_eq!(window.origin + window.size, (corner + 26).min(view));
        corners.insert(corner.to_array());
    }
    // 21 columns and 6 rows of corners.
    assert_eq!(corners.len(), 126);
}

#[test]
fn a_crop_larger_than_the_view_is_the_view() {
    let view = UVec2::new(7, 300);
    let window = Window::random(view, 500, 9, &Stream::new(1, 2), 3);
    assert_eq!(window, Window::whole(view));
}

#[test]
fn gathering_and_scattering_match_their_references() {
    let gpu = gpu();
    let windows = Windows::new(&gpu).unwrap();
    for (size, window, planes) in [
        (UVec2::ONE, Window::whole(UVec2::ONE), 0..1),
        (UVec2::new(33, 17), Window::random(UVec2::new(33, 17), 9, 2, &Stream::new(3, 0), 1), 2..5),
        (UVec2::new(64, 5), Window::whole(UVec2::new(64, 5)), 1..4),
    ] {
        let pixels = size.element_product() as usize;
        let image: Vec<f32> = (0..5 * pixels).map(|i| (i as f32 * 0.7).sin()).collect();
        let mut content = vec![f32::NAN; planes.len() * window.size.element_product() as usize];
        let params = window_gather::Params {
            size,
            origin: window.origin,
            window: window.size,
            first_plane: planes.start as u32,
            plane_count: planes.len() as u32,
        };
        let slices = window_gather::Slices { image: &image, content: &mut content };
        window_gather::Kernel::run(&params, &window_gather::Constants::default(), slices);
        let mut sum = image.clone();
        let scatter = window_scatter::Params {
            size,
            origin: window.origin,
            window: window.size,
            first_plane: params.first_plane,
            plane_count: params.plane_count,
        };
        let slices = window_scatter::Slices { content: &content, image: &mut sum };
        window_scatter::Kernel::run(&scatter, &window_scatter::Constants::default(), slices);

        let device_image = gpu.buffer("image", &image).unwrap();
        let mut device_sum = gpu.buffer("sum", &image).unwrap();
        let mut device_content = gpu.zeros("content", content.len()).unwrap();
        gpu.run("windows", |pass| {
            let planes = planes.clone();
            windows.gather(
                pass,
                &device_image,
                size,
                planes.clone(),
                &window,
                &mut device_content,
            )?;
            windows.scatter(pass, &device_content, &window, planes, size, &mut device_sum)
        })
        .unwrap();
        assert_eq!(gpu.read(&device_content).unwrap(), content);
        assert_eq!(gpu.read(&device_sum).unwrap(), sum);
    }
    assert_no_validation_messages();
}

#[test]
fn a_window_beyond_the_view_or_its_buffers_is_refused() {
    let gpu = gpu();
    let windows = Windows::new(&gpu).unwrap();
    let view = UVec2::new(8, 8);
    let image = gpu.zeros("image", 3 * 64).unwrap();
    let mut content = gpu.zeros("content", 3 * 64).unwrap();
    let mut problem = |window: Window, planes| {
        let gathered = gpu.run("window", |pass| {
            windows.gather(pass, &image, view, planes, &window, &mut content)
        });
        gathered.unwrap_err().to_string()
    };
    let beyond = Window { origin: UVec2::ONE, ..Window::whole(view) };
    assert!(problem(beyond, 0..3).contains("does not lie"));
    assert!(problem(Window::whole(view), 1..4).contains("`image` holds 192"));
}
