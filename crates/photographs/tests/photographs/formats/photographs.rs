//! Photograph files: formats, orientation, alpha and masks.

use nightsplat_photographs::dataset::DepthOptions;

use super::*;

/// The values of one row of pixels.
fn row(image: &Image) -> Vec<f32> {
    image.data[..image.width as usize].to_vec()
}

fn close(values: &[f32], expected: &[f32]) {
    let off = values.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(values.len() == expected.len() && off < 1e-6, "{values:?}, not {expected:?}");
}

#[test]
fn tiff_and_webp_are_read_at_full_precision() {
    let folder = Folder::empty();
    let path = |name: &str| folder.join(name);
    let grey = [0_u8, 7, 100, 255];
    let expected = grey.map(|value| f32::from(value) / 255.0);
    let eight = ImageBuffer::from_fn(4, 1, |x, _| Rgb([grey[x as usize]; 3]));
    eight.save(path("8.tif")).unwrap();
    eight.save(path("8.webp")).unwrap();
    let alpha = ImageBuffer::from_fn(4, 1, |x, _| {
        let value = grey[x as usize];
        Rgba([value, value, value, 255])
    });
    alpha.save(path("alpha.webp")).unwrap();
    ImageBuffer::from_fn(4, 1, |x, _| Luma([grey[x as usize]])).save(path("grey.tiff")).unwrap();
    for name in ["8.tif", "8.webp", "alpha.webp", "grey.tiff"] {
        let image = Image::load(path(name)).unwrap();
        close(&row(&image), &expected);
        assert_eq!(Image::size_of(path(name)).unwrap(), (4, 1), "{name}");
    }
    let deep = [0_u16, 1, 700, 65_535];
    ImageBuffer::from_fn(4, 1, |x, _| Rgb([deep[x as usize]; 3])).save(path("16.tif")).unwrap();
    close(
        &row(&Image::load(path("16.tif")).unwrap()),
        &deep.map(|value| f32::from(value) / 65_535.0),
    );
    // Float images are only read from EXR.
    fs::write(path("float.tif"), float_tiff(&[[0.0; 3], [0.5; 3]])).unwrap();
    let error = Image::load(path("float.tif")).unwrap_err().to_string();
    says(&error, &["float.tif: is not read", "EXR"]);
}

/// A TIFF of one row of colours in 32-bit floats.
fn float_tiff(pixels: &[[f32; 3]]) -> Vec<u8> {
    let bytes: Vec<u8> = pixels.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let (count, length) = (pixels.len() as u32, bytes.len() as u32);
    // After the pixels, for each of the three samples: 32 bits, and the float format.
    let of_samples = [32_u16, 32, 32, 3, 3, 3];
    let (bits, formats) = (8 + length, 8 + length + 6);
    // Tag, number, value: size, bits, no compression, RGB, offset, samples, rows, bytes, float.
    let entries: [(u16, u16, u32); 10] = [
        (256, 1, count),
        (257, 1, 1),
        (258, 3, bits),
        (259, 1, 1),
        (262, 1, 2),
        (273, 1, 8),
        (277, 1, 3),
        (278, 1, 1),
        (279, 1, length),
        (339, 3, formats),
    ];
    let mut file = [b"II*\0".as_slice(), &(8 + length + 12).to_le_bytes(), &bytes].concat();
    file.extend(of_samples.iter().flat_map(|value| value.to_le_bytes()));
    file.extend((entries.len() as u16).to_le_bytes());
    for (tag, number, value) in entries {
        // Several values are shorts; a single one is a long.
        let kind: u16 = if number > 1 { 3 } else { 4 };
        file.extend([tag, kind, number, 0].iter().flat_map(|half| half.to_le_bytes()));
        file.extend(value.to_le_bytes());
    }
    file.extend([0; 4]);
    file
}

#[test]
fn pixels_of_an_exr_that_are_not_finite_are_masked() {
    let root = &Folder::empty();
    fs::create_dir(root.join("images")).unwrap();
    let (columns, rows) = (SIZE.0 as usize, SIZE.1 as usize);
    let green = |x, y| match (x, y) {
        (7, 4) => f32::NAN,
        (20, 9) => f32::NEG_INFINITY,
        _ => 0.01,
    };
    for index in 0..9 {
        let path = root.join("images").join(name(index)).with_extension("exr");
        let pixel = |x, y| (0.02, if index == 3 { green(x, y) } else { 0.01 }, 0.03);
        exr::prelude::write_rgb_file(path, columns, rows, pixel).unwrap();
    }
    model(9).write_text(&root.join("sparse/0"));
    let dataset = load(root);
    let hidden = |name: &str| view(&dataset, name).mask.as_ref().map(Mask::hidden);
    assert_eq!(hidden("v03"), Some(vec![4 * columns + 7, 9 * columns + 20]));
    assert_eq!(hidden("v02"), None);
}

#[test]
fn a_photograph_is_rotated_if_its_camera_is_upright_and_else_kept_as_stored() {
    // For each orientation: as stored if the cameras' size is 40 x 30.
    for orientation in 1..=8 {
        let root = &Folder::empty();
        write_json(root.join("transforms.json"), &listed("images", 0..9, ".jpg"));
        let seen = if orientation >= 5 { (30, 40) } else { SIZE };
        for (stored, is_turned) in [(SIZE, false), (seen, orientation >= 5)] {
            for index in 0..9 {
                jpeg(&root.join(format!("images/{}.jpg", name(index))), stored, orientation);
            }
            let dataset = load(root);
            let image = view(&dataset, "v03").image.as_ref().unwrap();
            assert_eq!((image.width, image.height), SIZE);
            // The bright half is that of the stored columns.
            let is_bright = |x: u32, y: u32| image.pixel(x, y)[0] > 0.12;
            let (columns, rows) =
                ([5, 35].map(|x| is_bright(x, 15)), [5, 25].map(|y| is_bright(20, y)));
            if is_turned {
                assert!(rows[0] != rows[1], "orientation {orientation} is not turned");
            } else {
                assert_eq!(columns, [false, true], "orientation {orientation} is turned");
            }
            let lone = root.join("images/v03.jpg");
            let stated = Orientation::from_file(&lone);
            let left = if is_turned { Orientation::UPRIGHT } else { stated };
            assert_eq!(view(&dataset, "v03").orientation, left);
            let upright = Orientation::from_file(&lone).upright(Image::load(&lone).unwrap());
            assert_eq!((upright.width, upright.height), Orientation::from_file(&lone).size(stored));
        }
        jpeg(&root.join("images/v03.jpg"), (36, 40), orientation);
        let upright = if orientation >= 5 { " (upright 40x36)" } else { "" };
        refuses(root, &[&format!("v03.jpg: is 36x40{upright} but its camera is 40x30")]);
    }
}

#[test]
fn up_is_that_of_the_upright_photographs() {
    // A phone held upright stores its photographs sideways: orientation 6, with cameras of the stored images.
    let root = &Folder::empty();
    let backup = DAffine3::from_mat3(DMat3::from_cols(DVec3::NEG_Y, DVec3::X, DVec3::Z));
    for (orientation, turn) in [(1, DAffine3::IDENTITY), (6, backup)] {
        let mut frames = vec![];
        for index in 0..9 {
            let file = format!("images/{}.jpg", name(index));
            jpeg(&root.join(&file), SIZE, orientation);
            frames.push(frame_of(&(turn * pose(index)), &file));
        }
        write_json(root.join("transforms.json"), &transforms(frames));
        let dataset = load(root);
        let up = dataset.up();
        assert!(up.distance(DVec3::Z) < 1e-6, "orientation {orientation}: {up}");
        let first = &dataset.views[0];
        let seen = first.upright_camera();
        let size = if orientation == 6 { (30, 40) } else { SIZE };
        assert_eq!((seen.width, seen.height), size);
        let image = first.upright(first.image.clone().unwrap());
        assert_eq!((image.width, image.height), size);
        let right = seen.view_from_world.matrix3.row(0);
        assert!(right.dot(DVec3::Z).abs() < 1e-9, "{right}");
    }
}

fn hides_the_right(mask: &Mask) {
    assert_eq!((mask.width, mask.height), SIZE);
    let columns = mask.weights[..40].iter().map(|&weight| weight as u32).sum::<u32>();
    assert_eq!((columns, mask.weights[0], mask.weights[39]), (20, 1.0, 0.0));
}

#[test]
fn masks_are_found_by_both_names_and_may_be_inverted_and_alpha_is_a_mask() {
    let root = &Folder::lom();
    assert!(load(root).views.iter().all(|view| view.mask.is_none()));
    half_mask(&root.join("masks/v00.png"), SIZE);
    half_mask(&root.join("masks/v01.png.png"), SIZE);
    half_mask(&root.join("masks/v02.png"), (80, 60));
    let alpha = |x: u32, y: u32| Rgba([20_u8, 20, 20, if x < 20 && y < 40 { 255 } else { 0 }]);
    ImageBuffer::from_fn(40, 30, alpha).save(root.join("low/v03.png")).unwrap();
    let dataset = load(root);
    for index in 0..4 {
        hides_the_right(view(&dataset, &name(index)).mask.as_ref().unwrap());
    }
    assert!(view(&dataset, "v04").mask.is_none());
    let image = view(&dataset, "v00").image.as_ref().unwrap();
    assert_eq!(view(&dataset, "v00").counted(image).len(), 3 * 20 * 30);
    let inverted = LoadOptions { invert_masks: true, ..Default::default() };
    let dataset = load_with(root, inverted);
    let mask = view(&dataset, "v00").mask.as_ref().unwrap();
    assert_eq!((mask.weights[0], mask.weights[39]), (0.0, 1.0));
    // Alpha is not inverted.
    hides_the_right(view(&dataset, "v03").mask.as_ref().unwrap());

    // Resized with the photograph.
    let shrunk = LoadOptions { downscale: 1.6, ..Default::default() };
    let mask = view(&load_with(root, shrunk), "v00").mask.clone().unwrap();
    // The thirteenth column contains half a masked column.
    assert_eq!((mask.width, mask.weights[11], mask.weights[12]), (25, 1.0, 0.0));
}

#[test]
fn a_mask_of_another_aspect_ratio_is_refused_and_a_full_mask_excludes_its_view() {
    let root = &Folder::lom();
    photograph(&root.join("masks/v00.png"), SIZE, 0.0);
    let dataset = load(root);
    assert!(!names(&dataset, Split::Train).contains(&"v00"));
    assert!(
        dataset.skipped.join("\n").contains("masks/v00.png: the mask is black everywhere"),
        "{:?}",
        dataset.skipped
    );
    half_mask(&root.join("masks/v01.png"), (30, 30));
    refuses(root, &["masks/v01.png: is 30x30, its photograph 40x30"]);
}

#[test]
fn float_depth_keeps_its_values_and_its_sign() {
    let folder = Folder::lom();
    let maps = folder.join("estimates");
    fs::create_dir(&maps).unwrap();
    let map = Image::from_fn(SIZE.0, SIZE.1, |x, _| [x as f32 - 20.0; 3]);
    for index in 0..10 {
        map.save_exr_as_stored(maps.join(name(index)).with_extension("exr")).unwrap();
    }
    let depth = DepthOptions { load: true, folder: Some(maps), ..DepthOptions::default() };
    let dataset = load_with(&folder, LoadOptions { depth, ..LoadOptions::default() });
    let depth = dataset.train_views().next().unwrap().depth.clone().unwrap();
    assert_eq!((depth[0], depth[39]), (-20.0, 19.0));
}
