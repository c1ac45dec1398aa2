//! Undistortion: a photograph through a real lens becomes that of a pinhole.
//!
//! The pinhole keeps the image's size and the principal point; its focal lengths are scaled by one factor, the smallest
//! at which every output pixel is inside the input (`OpenCV`'s alpha = 0): no blank pixels, and no more of the image is
//! lost than necessary. Of a fisheye it shows at most [`WIDEST`] off the axis: a pinhole spends ever more pixels on
//! larger angles, and cannot show 90 degrees.

use glam::{DVec2, Vec4};
use nightsplat_core::camera::Lens;
use rayon::prelude::*;

use crate::image::Image;

/// The angle off the axis at the corner of a pinhole, degrees: 120 across the image, where a pixel of a fisheye covers
/// four.
pub(super) const WIDEST: f64 = 60.0;

/// The position of each pixel of the pinhole image in the photograph; computed once per lens.
#[derive(Debug)]
pub(super) struct Undistortion {
    /// The pinhole's focal lengths, pixels.
    pub(super) focal: DVec2,
    /// Whether the photograph shows more than [`WIDEST`], which is lost.
    pub(super) is_cropped: bool,
    /// Positions in the photograph, pixels, (height, width).
    positions: Vec<[f32; 2]>,
}

impl Undistortion {
    /// `None` if no pinhole sees only the inside of the photograph: the coefficients are not those of a lens.
    pub(super) fn new(lens: &Lens) -> Option<Self> {
        let zoom = zoom(lens)?;
        let focal = lens.focal * zoom;
        let is_cropped = fits(lens, zoom * 0.999, f64::INFINITY);
        let position = |index: u32| {
            let pixel =
                DVec2::new(f64::from(index % lens.width), f64::from(index / lens.width)) + 0.5;
            in_photograph(lens, focal, pixel).as_vec2().to_array()
        };
        let pixels = lens.width.checked_mul(lens.height)?;
        Some(Self {
            focal,
            is_cropped,
            positions: (0..pixels).into_par_iter().map(position).collect(),
        })
    }

    /// The pinhole's image of a photograph of the lens's size, by bicubic interpolation in float.
    pub(super) fn apply(&self, photograph: &Image) -> Image {
        /// Output rows whose source rows are in memory at a time, with the channels of a pixel side by side.
        const ROWS: usize = 32;
        let Image { width, height, .. } = *photograph;
        let [columns, rows] = [width, height].map(|side| side as usize);
        let pixels = photograph.pixel_count();
        let mut data = vec![0.0; 3 * pixels];
        for (band, positions) in self.positions.chunks(ROWS * columns.max(1)).enumerate() {
            let ys = || positions.iter().map(|[_, y]| *y);
            let [top, bottom] = [ys().fold(f32::INFINITY, f32::min), ys().fold(0.0, f32::max)];
            let [first, last] = [cubic(top, rows).0[0], cubic(bottom, rows).0[3]];
            let source = columns * first..columns * (last + 1);
            let values = |plane: usize| &photograph.data[plane * pixels..][source.clone()];
            let colors = values(0).iter().zip(values(1)).zip(values(2));
            let colors: Vec<Vec4> = colors.map(|((&r, &g), &b)| Vec4::new(r, g, b, 0.0)).collect();
            for (index, position) in (band * ROWS * columns..).zip(positions) {
                let taps = Taps::at(*position, columns, rows);
                let color = taps.sample(&colors, columns, source.start);
                for (plane, value) in color.into_iter().enumerate() {
                    data[plane * pixels + index] = value;
                }
            }
        }
        Image { width, height, data }
    }
}

fn in_photograph(lens: &Lens, focal: DVec2, pixel: DVec2) -> DVec2 {
    lens.focal * lens.distortion.distort((pixel - lens.principal_point) / focal)
        + lens.principal_point
}

/// The smallest factor on the focal lengths with which the centre of every output pixel is inside the input.
fn zoom(lens: &Lens) -> Option<f64> {
    const STEP: f64 = 1.01;
    const RANGE: f64 = 4.0;
    // From factor 1 outwards, not by bisection over the whole range: far out, the polynomial folds back inside.
    let (mut inside, mut outside) = (1.0, 1.0);
    if sees_only_the_photograph(lens, 1.0) {
        while sees_only_the_photograph(lens, outside) {
            inside = outside;
            outside /= STEP;
            if outside < 1.0 / RANGE {
                return None;
            }
        }
    } else {
        while !sees_only_the_photograph(lens, inside) {
            outside = inside;
            inside *= STEP;
            if inside > RANGE {
                return None;
            }
        }
    }
    for _ in 0..40 {
        let middle = 0.5 * (inside + outside);
        *(if sees_only_the_photograph(lens, middle) { &mut inside } else { &mut outside }) = middle;
    }
    Some(inside)
}

fn sees_only_the_photograph(lens: &Lens, zoom: f64) -> bool {
    let widest = if lens.distortion.is_fisheye { WIDEST.to_radians().tan() } else { f64::INFINITY };
    fits(lens, zoom, widest)
}

/// Whether the pinhole sees only the photograph, and nothing farther off the axis than `widest` at unit depth.
fn fits(lens: &Lens, zoom: f64, widest: f64) -> bool {
    let focal = lens.focal * zoom;
    let last = DVec2::new(f64::from(lens.width), f64::from(lens.height)) - 0.5;
    let inside = |pixel: DVec2| {
        let position = in_photograph(lens, focal, pixel);
        let direction = (pixel - lens.principal_point) / focal;
        let unfolded = lens.distortion.determinant(direction) > 0.0;
        unfolded
            && direction.length() <= widest
            && position.cmpge(DVec2::splat(0.5 - 1e-9)).all()
            && position.cmple(last + 1e-9).all()
    };
    let columns = (0..lens.width).map(|x| f64::from(x) + 0.5);
    let rows = (0..lens.height).map(|y| f64::from(y) + 0.5);
    // The map is continuous and one-to-one, so it suffices that the border is inside.
    columns.into_iter().all(|x| inside(DVec2::new(x, 0.5)) && inside(DVec2::new(x, last.y)))
        && rows.into_iter().all(|y| inside(DVec2::new(0.5, y)) && inside(DVec2::new(last.x, y)))
}

/// Catmull-Rom over 4x4 pixels, edges repeated, clamped to the range of those pixels: dark noise must not become
/// negative light.
struct Taps {
    columns: [usize; 4],
    across: [f32; 4],
    rows: [usize; 4],
    down: [f32; 4],
}

impl Taps {
    fn at([x, y]: [f32; 2], width: usize, height: usize) -> Self {
        let (columns, across) = cubic(x, width);
        let (rows, down) = cubic(y, height);
        Self { columns, across, rows, down }
    }

    /// All channels at once. `colors`: rows of `width` pixels from the pixel `first` on.
    fn sample(&self, colors: &[Vec4], width: usize, first: usize) -> [f32; 3] {
        let mut sum = Vec4::ZERO;
        let [mut low, mut high] = [Vec4::INFINITY, Vec4::NEG_INFINITY];
        let rows = self.rows.map(|row| &colors[row * width - first..][..width]);
        for (row, down) in rows.into_iter().zip(self.down) {
            for (&column, across) in self.columns.iter().zip(self.across) {
                sum += down * across * row[column];
                [low, high] = [row[column].min(low), row[column].max(high)];
            }
        }
        // Processors differ in `min` and `max` of a NaN, which reaches the sum: the range is that of the others.
        if sum.is_nan() {
            [low, high] = [Vec4::INFINITY, Vec4::NEG_INFINITY];
            for color in rows.iter().flat_map(|row| self.columns.map(|column| row[column])) {
                low = Vec4::select(color.cmplt(low), color, low);
                high = Vec4::select(color.cmpgt(high), color, high);
            }
        }
        std::array::from_fn(|channel| sum[channel].max(low[channel]).min(high[channel]))
    }
}

/// Indices and weights of the four pixels around a position along one axis.
fn cubic(position: f32, length: usize) -> ([usize; 4], [f32; 4]) {
    let position = position - 0.5;
    let base = position.floor();
    let t = position - base;
    let index = |offset: isize| (base as isize + offset).clamp(0, length as isize - 1) as usize;
    let weights = [
        0.5 * t * (-1.0 + t * (2.0 - t)),
        0.5 * (2.0 + t * t * (-5.0 + 3.0 * t)),
        0.5 * t * (1.0 + t * (4.0 - 3.0 * t)),
        0.5 * t * t * (t - 1.0),
    ];
    ([-1, 0, 1, 2].map(index), weights)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::camera::Distortion;

    fn lenses() -> [Distortion; 6] {
        let none = Distortion::default();
        [
            Distortion { k1: 0.018, k2: -0.051, p1: 0.0087, p2: 0.0025, ..none },
            Distortion { k1: -0.25, k2: 0.06, ..none },
            Distortion { k1: 0.2, p1: -0.002, p2: 0.004, ..none },
            Distortion { k1: 0.1, k3: 0.02, k4: 0.15, k5: -0.02, p1: 0.001, ..none },
            Distortion { k1: 0.05, k2: -0.02, k3: 0.006, k4: -0.001, is_fisheye: true, ..none },
            none,
        ]
    }

    fn lens(distortion: Distortion) -> Lens {
        let (focal, principal_point) = (DVec2::new(105.0, 108.0), DVec2::new(52.0, 44.0));
        Lens { width: 100, height: 75, focal, principal_point, distortion }
    }

    /// Light from a direction at unit depth.
    fn radiance(direction: DVec2) -> [f32; 3] {
        let wave = |a: f64, b: f64| (0.5 + 0.4 * (a * direction.x + b * direction.y).sin()) as f32;
        [wave(9.0, 2.0), wave(-3.0, 8.0), wave(5.0, -7.0)]
    }

    /// The undistorted position by brute force: a grid that converges to the distorted one.
    fn undistorted(distortion: Distortion, target: DVec2) -> DVec2 {
        let mut best = target;
        let mut reach = 0.2;
        while reach > 1e-8 {
            let steps = (-5..=5)
                .flat_map(|x| (-5..=5).map(move |y| DVec2::new(f64::from(x), f64::from(y)) / 5.0));
            let error = |at: DVec2| distortion.distort(at).distance(target);
            let center = best;
            best = steps
                .map(|step| center + reach * step)
                .fold(best, |a, b| if error(b) < error(a) { b } else { a });
            reach *= 0.5;
        }
        best
    }

    fn image_of(lens: &Lens, focal: DVec2, distortion: Distortion) -> Image {
        Image::from_fn(lens.width, lens.height, |x, y| {
            let pixel = DVec2::new(f64::from(x), f64::from(y)) + 0.5;
            radiance(undistorted(distortion, (pixel - lens.principal_point) / focal))
        })
    }

    #[test]
    fn the_undistorted_photograph_is_that_of_a_pinhole() {
        for distortion in lenses() {
            let lens = lens(distortion);
            let map = Undistortion::new(&lens).unwrap();
            let ours = map.apply(&image_of(&lens, lens.focal, distortion));
            let pinhole = image_of(&lens, map.focal, Distortion::default());
            let worst =
                ours.data.iter().zip(&pinhole.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // An offset of half a pixel would give 2e-2; the rest is the repeated edge.
            assert!(worst < 4e-3, "{distortion:?}: {worst}");
        }
    }

    #[test]
    fn no_output_pixel_is_blank_and_the_zoom_is_the_smallest_possible() {
        for distortion in lenses() {
            let lens = lens(distortion);
            let factor = zoom(&lens).unwrap();
            assert!(sees_only_the_photograph(&lens, factor), "{distortion:?}");
            assert!(!sees_only_the_photograph(&lens, factor * 0.9999), "{distortion:?}: {factor}");
        }
        assert!((zoom(&lens(Distortion::default())).unwrap() - 1.0).abs() < 5e-7);
    }

    #[test]
    fn a_fisheye_is_cropped_to_its_middle_and_marked_as_cropped() {
        let distortion = Distortion { k1: 0.02, is_fisheye: true, ..Distortion::default() };
        // 85 degrees at the corners, and 40.
        for (focal, is_cropped) in [(40.0, true), (90.0, false)] {
            let lens = Lens {
                focal: DVec2::splat(focal),
                principal_point: DVec2::new(50.0, 37.5),
                ..lens(distortion)
            };
            let map = Undistortion::new(&lens).unwrap();
            assert_eq!(map.is_cropped, is_cropped);
            let corner = (DVec2::new(0.5, 0.5) - lens.principal_point) / map.focal;
            let degrees = corner.length().atan().to_degrees();
            assert!(
                (degrees - WIDEST).abs() < 1e-3 || (!is_cropped && degrees < WIDEST),
                "{degrees}"
            );
        }
    }

    #[test]
    fn a_lens_that_folds_over_itself_is_refused() {
        let folded = lens(Distortion { k1: -40.0, ..Distortion::default() });
        assert!(Undistortion::new(&folded).is_none());
    }

    #[test]
    fn interpolation_stays_within_the_range_of_its_pixels() {
        let plane = [Vec4::ZERO, Vec4::ZERO, Vec4::ONE, Vec4::ONE].repeat(4);
        for x in (0..=40).map(|step| step as f32 / 10.0) {
            let [value, ..] = Taps::at([x, 2.0], 4, 4).sample(&plane, 4, 0);
            assert!((0.0..=1.0).contains(&value), "{x}: {value}");
        }
    }

    #[test]
    fn a_pixel_next_to_one_that_is_no_number_has_the_least_of_the_others() {
        for at in 0..16 {
            let mut plane = [0.25, 0.5, 0.75, 1.0].map(Vec4::splat).repeat(4);
            plane[at] = Vec4::new(f32::NAN, plane[at].y, f32::INFINITY, 0.0);
            let [nan, finite, _] = Taps::at([2.0, 2.0], 4, 4).sample(&plane, 4, 0);
            assert_eq!((nan, finite), (0.25, 0.625), "{at}");
        }
    }
}
