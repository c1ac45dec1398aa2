//! Numbers as colours.

use nightsplat_photographs::image::Image;

/// Viridis, at nine even places, sRGB.
const VIRIDIS: [[u8; 3]; 9] = [
    [68, 1, 84],
    [71, 45, 123],
    [59, 82, 139],
    [44, 114, 142],
    [33, 145, 140],
    [40, 174, 128],
    [94, 201, 98],
    [173, 220, 48],
    [253, 231, 37],
];

/// The share of pixels at either end that a range leaves out.
const OUTLIERS: f64 = 0.01;

/// The finite values of a plane without the least and the largest hundredth; `None` if there are none.
pub fn range(plane: &[f32]) -> Option<[f32; 2]> {
    let mut values: Vec<f32> = plane.iter().copied().filter(|value| value.is_finite()).collect();
    values.sort_unstable_by(f32::total_cmp);
    let last = values.len().checked_sub(1)?;
    let skipped = (OUTLIERS * last as f64) as usize;
    Some([values[skipped], values[last - skipped]])
}

/// The first plane of an image in colours: dark violet at the first end of the range, yellow at the second, black where
/// the value is not finite.
pub fn mapped(image: &Image, [from, to]: [f32; 2]) -> Image {
    let pixels = image.pixel_count();
    let mut data = vec![0.0; 3 * pixels];
    for (pixel, &value) in image.data[..pixels].iter().enumerate() {
        if !value.is_finite() {
            continue;
        }
        let span = to - from;
        let along = if span == 0.0 { 0.0 } else { ((value - from) / span).clamp(0.0, 1.0) };
        let position = along * (VIRIDIS.len() - 1) as f32;
        let below = (position as usize).min(VIRIDIS.len() - 2);
        let share = position - below as f32;
        for plane in 0..3 {
            let [a, b] = [below, below + 1].map(|at| f32::from(VIRIDIS[at][plane]) / 255.0);
            data[plane * pixels + pixel] = a + (b - a) * share;
        }
    }
    Image { data, ..*image }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_of_a_range_have_the_colours_of_the_ends_and_what_is_not_finite_is_black() {
        let plane = [1.0, 3.0, 2.0, f32::INFINITY];
        let image = Image { width: 4, height: 1, data: plane.repeat(3) };
        let mapped = mapped(&image, range(&plane).unwrap());
        let colour =
            |pixel: usize| [0, 1, 2].map(|k| (255.0 * mapped.data[4 * k + pixel]).round() as u8);
        assert_eq!([0, 1, 2, 3].map(colour), [VIRIDIS[0], VIRIDIS[8], VIRIDIS[4], [0; 3]]);
        let many: Vec<f32> = (0..1000).map(|k| k as f32).collect();
        assert_eq!(range(&many), Some([9.0, 990.0]));
        assert_eq!(range(&[f32::NAN]), None);
        // All alike.
        let flat = Image { width: 1, height: 1, data: vec![5.0; 3] };
        assert_eq!(super::mapped(&flat, [5.0, 5.0]).data[0], 68.0 / 255.0);
    }
}
