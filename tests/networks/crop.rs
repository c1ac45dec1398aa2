//! Crops of a view: their positions, and copying them.

use nightsplat::gpu::Reference;
use nightsplat::kernels::{crop_gather, crop_scatter};
use nightsplat::networks::crop::{CropKernels, PaddedCrop};

use crate::common::prelude::*;

#[test]
fn a_crop_is_a_cell_of_the_view_and_its_margin_is_clipped_to_the_view() {
    let stream = Stream::new(1, 2);
    let view = UVec2::new(43, 25);
    let mut cells = BTreeSet::new();
    for draw in 0..500 {
        let crop = PaddedCrop::random(view, 20, 6, &stream, draw);
        let corner = crop.origin + crop.crop_origin;
        let end = corner + crop.crop_size;
        assert_eq!(crop.origin, corner.saturating_sub(UVec2::splat(6)));
        assert_eq!(crop.origin + crop.size, (end + 6).min(view));
        cells.insert((corner.to_array(), end.to_array()));
    }
    // Three columns of 14 or 15 pixels, two rows of 12 or 13.
    let columns = [(0, 14), (14, 28), (28, 43)];
    let all = columns.map(|(left, right)| [([left, 0], [right, 12]), ([left, 12], [right, 25])]);
    assert_eq!(cells, all.into_iter().flatten().collect());
}

#[test]
fn means_over_crops_estimate_the_mean_over_the_view() {
    const DRAWS: u64 = 40_000;
    let stream = Stream::new(7, 1);
    // Far from a multiple of the side, and one pixel more than one cell.
    for (view, side) in [(UVec2::new(17, 11), 5), (UVec2::new(8, 7), 7)] {
        let mut weights = vec![0.0; view.element_product() as usize];
        for draw in 0..DRAWS {
            let crop = PaddedCrop::random(view, side, 1, &stream, draw);
            let corner = crop.origin + crop.crop_origin;
            let weight = 1.0 / f64::from(crop.crop_size.element_product());
            for y in corner.y..corner.y + crop.crop_size.y {
                for x in corner.x..corner.x + crop.crop_size.x {
                    weights[(y * view.x + x) as usize] += weight / DRAWS as f64;
                }
            }
        }
        // Every pixel has the same weight, within four standard deviations of the rarest cell's count.
        let even = 1.0 / weights.len() as f64;
        for weight in weights {
            assert!((weight / even - 1.0).abs() < 4.0 * (20.0 / DRAWS as f64).sqrt(), "{weight}");
        }
    }
}

#[test]
fn a_crop_larger_than_the_view_is_the_view() {
    let view = UVec2::new(7, 300);
    for side in [300, 500, u32::MAX] {
        let crop = PaddedCrop::random(view, side, 9, &Stream::new(1, 2), 3);
        assert_eq!(crop, PaddedCrop::whole(view));
    }
}

#[test]
fn gathering_and_scattering_match_their_references() {
    let gpu = gpu();
    let crops = CropKernels::new(&gpu).unwrap();
    for (size, crop, planes) in [
        (UVec2::ONE, PaddedCrop::whole(UVec2::ONE), 0..1),
        (
            UVec2::new(33, 17),
            PaddedCrop::random(UVec2::new(33, 17), 9, 2, &Stream::new(3, 0), 1),
            2..5,
        ),
        (UVec2::new(64, 5), PaddedCrop::whole(UVec2::new(64, 5)), 1..4),
    ] {
        let pixels = size.element_product() as usize;
        let image: Vec<f32> = (0..5 * pixels).map(|i| (i as f32 * 0.7).sin()).collect();
        let mut content = vec![f32::NAN; planes.len() * crop.size.element_product() as usize];
        let params = crop_gather::Params {
            size,
            origin: crop.origin,
            crop: crop.size,
            first_plane: planes.start as u32,
            plane_count: planes.len() as u32,
        };
        let slices = crop_gather::Slices { image: &image, content: &mut content };
        crop_gather::Kernel::run(&params, &crop_gather::Constants::default(), slices);
        let mut sum = image.clone();
        let scatter = crop_scatter::Params {
            size,
            origin: crop.origin,
            crop: crop.size,
            first_plane: params.first_plane,
            plane_count: params.plane_count,
        };
        let slices = crop_scatter::Slices { content: &content, image: &mut sum };
        crop_scatter::Kernel::run(&scatter, &crop_scatter::Constants::default(), slices);

        let device_image = gpu.buffer("image", &image).unwrap();
        let mut device_sum = gpu.buffer("sum", &image).unwrap();
        let mut device_content = gpu.zeros("content", content.len()).unwrap();
        gpu.run("windows", |pass| {
            let planes = planes.clone();
            crops.gather(pass, &device_image, size, planes.clone(), &crop, &mut device_content)?;
            crops.scatter(pass, &device_content, &crop, planes, size, &mut device_sum)
        })
        .unwrap();
        assert_eq!(gpu.read(&device_content).unwrap(), content);
        assert_eq!(gpu.read(&device_sum).unwrap(), sum);
    }
}

#[test]
fn a_crop_beyond_the_view_or_its_buffers_is_refused() {
    let gpu = gpu();
    let crops = CropKernels::new(&gpu).unwrap();
    let view = UVec2::new(8, 8);
    let image = gpu.zeros("image", 3 * 64).unwrap();
    let mut content = gpu.zeros("content", 3 * 64).unwrap();
    let mut problem = |crop: PaddedCrop, planes| {
        let gathered =
            gpu.run("window", |pass| crops.gather(pass, &image, view, planes, &crop, &mut content));
        gathered.unwrap_err().to_string()
    };
    let beyond = PaddedCrop { origin: UVec2::ONE, ..PaddedCrop::whole(view) };
    assert!(problem(beyond, 0..3).contains("is not inside"));
    assert!(problem(PaddedCrop::whole(view), 1..4).contains("`image` holds 192"));
}
