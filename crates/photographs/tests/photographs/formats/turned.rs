//! Photographs that their Exif turns by half or mirrors, and square ones: their size does not tell which pixels their
//! cameras are of.

use nightsplat_photographs::dataset::PixelOrientation;

use super::*;

const VIEWS: usize = 9;
const WIDE: (u32, u32) = (160, 120);
const SQUARE: (u32, u32) = (120, 120);
/// Each orientation, and that which undoes it.
const HALF_TURN: (u8, u8) = (3, 3);
const MIRRORED: (u8, u8) = (2, 2);
const QUARTER_TURN: (u8, u8) = (6, 8);

/// Points of the scene, each with its grey.
fn points() -> Vec<(DVec3, u8)> {
    let part = |index: f64, of: f64| (index * of).sin() * 43758.5453 % 1.0;
    let point = |index: usize| {
        let value = index as f64 + 1.0;
        let at = DVec3::new(part(value, 12.9898), part(value, 78.233), part(value, 39.425));
        (0.9 * at, (25 + index * 53 % 140) as u8)
    };
    (0..60).map(point).collect()
}

fn pixel(index: usize, (width, height): (u32, u32), point: DVec3) -> Option<DVec2> {
    let at = pose(index).transform_point3(point);
    let pixel =
        120.0 * at.truncate() / at.z + 0.5 * DVec2::new(f64::from(width), f64::from(height));
    let is_inside = pixel.min_element() >= 4.0
        && pixel.x < f64::from(width) - 4.0
        && pixel.y < f64::from(height) - 4.0;
    is_inside.then_some(pixel)
}

/// What a camera took: its points, nearer ones in front of others.
fn taken(index: usize, size: (u32, u32)) -> Image {
    let mut image = Image::filled(size.0, size.1, [12.0 / 255.0; 3]);
    let mut points = points();
    let depth = |point: &(DVec3, u8)| pose(index).transform_point3(point.0).z;
    points.sort_by(|a, b| depth(b).total_cmp(&depth(a)));
    for (point, grey) in points {
        let Some(at) = pixel(index, size, point) else { continue };
        for (x, y) in (0..49).map(|i| (at.x as u32 + i % 7 - 3, at.y as u32 + i / 7 - 3)) {
            for plane in 0..3 {
                let offset = (plane * size.1 + y) * size.0 + x;
                image.data[offset as usize] = f32::from(grey) / 255.0;
            }
        }
    }
    image
}

/// Writes a capture whose photographs have the first orientation in their Exif, and whose cameras are of what is stored
/// or of what Exif shows; with points or without.
fn capture(root: &Path, size: (u32, u32), turn: (u8, u8), of_exif: bool, has_points: bool) {
    fs::create_dir_all(root.join("images")).unwrap();
    fs::create_dir_all(root.join("sparse/0")).unwrap();
    let camera = format!(
        "1 PINHOLE {0} {1} 120 120 {2} {3}\n",
        size.0,
        size.1,
        f64::from(size.0) / 2.0,
        f64::from(size.1) / 2.0
    );
    let mut images = String::new();
    for index in 0..VIEWS {
        let path = root.join(format!("images/{}.jpg", name(index)));
        let image = taken(index, size);
        let stored = if of_exif { turned(image, turn.1) } else { image };
        write(&stored, &path);
        orient(&path, turn.0);
        let (q, t) = (DQuat::from_mat3(&pose(index).matrix3), pose(index).translation);
        let numbers = [q.w, q.x, q.y, q.z, t.x, t.y, t.z].map(|number| number.to_string());
        images += &format!("{} {} 1 {}.jpg\n\n", index + 1, numbers.join(" "), name(index));
    }
    let mut lines = String::new();
    for (index, (point, _)) in points().into_iter().enumerate().filter(|_| has_points) {
        let seen = (0..VIEWS).filter(|view| pixel(*view, size, point).is_some());
        let track: Vec<String> = seen.map(|view| format!("{} 0", view + 1)).collect();
        let DVec3 { x, y, z } = point;
        lines += &format!("{} {x} {y} {z} 9 9 9 0.5 {}\n", index + 1, track.join(" "));
    }
    fs::write(root.join("sparse/0/cameras.txt"), camera).unwrap();
    fs::write(root.join("sparse/0/images.txt"), images).unwrap();
    fs::write(root.join("sparse/0/points3D.txt"), lines).unwrap();
}

fn write(image: &Image, path: &Path) {
    let grey = |x: u32, y: u32| Luma([(image.pixel(x, y)[0] * 255.0).round() as u8]);
    ImageBuffer::from_fn(image.width, image.height, grey).save(path).unwrap();
}

/// The image as one of this orientation is shown.
fn turned(image: Image, orientation: u8) -> Image {
    let folder = Folder::empty();
    let path = folder.join("a.jpg");
    write(&Image::filled(8, 8, [0.0; 3]), &path);
    orient(&path, orientation);
    Orientation::from_file(&path).upright(image)
}

fn loaded(root: &Path, orientation: PixelOrientation) -> (Dataset, String) {
    let mut dataset = None;
    let options = LoadOptions { orientation, ..Default::default() };
    let message = warnings(|| dataset = Some(load_with(root, options)));
    (dataset.unwrap(), message)
}

/// Whether the photographs are what their cameras took, up to what JPEG makes of it.
fn are_right(dataset: &Dataset, size: (u32, u32)) -> bool {
    (0..VIEWS).all(|index| {
        let image = view(dataset, &name(index)).image.as_ref().unwrap();
        let expected = taken(index, size);
        let off = image.data.iter().zip(&expected.data).map(|(a, b)| (a - b).abs());
        off.sum::<f32>() / (image.data.len() as f32) < 0.02
    })
}

#[test]
fn points_that_photographs_share_tell_which_pixels_their_cameras_are_of() {
    for (size, turn) in
        [(WIDE, HALF_TURN), (WIDE, MIRRORED), (SQUARE, QUARTER_TURN), (SQUARE, MIRRORED)]
    {
        for of_exif in [false, true] {
            let root = &Folder::empty();
            capture(root, size, turn, of_exif, true);
            let (dataset, message) = loaded(root, PixelOrientation::Auto);
            assert!(are_right(&dataset, size), "{size:?} {turn:?} {of_exif}");
            assert_eq!(message, "", "{size:?} {turn:?} {of_exif}");
            let orientation = Orientation::from_file(&root.join("images/v00.jpg"));
            let left = if of_exif { Orientation::UPRIGHT } else { orientation };
            assert_eq!(view(&dataset, "v00").orientation, left);
        }
    }
}

#[test]
fn without_points_what_is_stored_is_taken_with_one_warning_and_the_option_says_otherwise() {
    for of_exif in [false, true] {
        let root = &Folder::empty();
        capture(root, WIDE, HALF_TURN, of_exif, false);
        let (dataset, message) = loaded(root, PixelOrientation::Auto);
        assert_eq!(are_right(&dataset, WIDE), !of_exif);
        let expected = "Exif turns or mirrors 9 photographs, v00 the first";
        assert_eq!(message.matches(expected).count(), 1, "{message}");
        says(&message, &["--orientation exif"]);
        let options = [(PixelOrientation::Stored, !of_exif), (PixelOrientation::Exif, of_exif)];
        for (option, is_right) in options {
            let (dataset, message) = loaded(root, option);
            assert_eq!(are_right(&dataset, WIDE), is_right);
            assert!(!message.contains("Exif"), "{message}");
        }
    }
}

#[test]
fn the_option_overrides_what_points_tell() {
    let folder = Folder::empty();
    capture(&folder, WIDE, HALF_TURN, false, true);
    let (dataset, message) = loaded(&folder, PixelOrientation::Exif);
    assert!(!are_right(&dataset, WIDE) && message.is_empty(), "{message}");
}

#[test]
fn a_photograph_whose_size_tells_speaks_for_those_whose_size_does_not() {
    for of_exif in [false, true] {
        let root = &Folder::empty();
        capture(root, WIDE, HALF_TURN, of_exif, false);
        let path = root.join("images/v04.jpg");
        let lying = turned(taken(4, WIDE), 8);
        write(&if of_exif { lying } else { taken(4, WIDE) }, &path);
        orient(&path, 6);
        let (dataset, message) = loaded(root, PixelOrientation::Auto);
        assert!(are_right(&dataset, WIDE) && message.is_empty(), "{of_exif} {message}");
    }
}
