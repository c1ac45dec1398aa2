//! Patches: a view that is too large to be rendered at once is cut into rectangles.

use std::borrow::Cow;
use std::ops::Range;

use glam::{UVec2, Vec2};

use super::Camera;

/// Patches are not cut to less than this on both sides, pixels: SSIM looks at 11 x 11.
const SMALLEST: u32 = 16;

/// A rectangle of a camera's image. It shows what the whole view shows there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patch {
    /// The camera of the whole view.
    pub camera: Camera,
    /// Its first column and row in the view, pixels.
    pub origin: UVec2,
    /// Width and height, pixels.
    pub size: UVec2,
}

impl From<&Camera> for Patch {
    /// The whole view.
    fn from(camera: &Camera) -> Self {
        let size = UVec2::new(camera.width, camera.height);
        Self { camera: *camera, origin: UVec2::ZERO, size }
    }
}

impl Camera {
    /// Cuts the view into rows of patches of about equal size, as few as satisfy `fits`. If even small ones do not,
    /// cutting does not help, and the view stays whole.
    #[doc(hidden)]
    pub fn patches(&self, fits: impl Fn(UVec2) -> bool) -> Vec<Patch> {
        let whole = UVec2::new(self.width, self.height);
        let mut counts = UVec2::ONE;
        loop {
            let largest = (whole + counts - 1) / counts;
            if fits(largest) {
                break;
            }
            if largest.max_element() <= SMALLEST {
                counts = UVec2::ONE;
                break;
            }
            *(if largest.x >= largest.y { &mut counts.x } else { &mut counts.y }) += 1;
        }
        let corner =
            |at: UVec2| (at.as_u64vec2() * whole.as_u64vec2() / counts.as_u64vec2()).as_uvec2();
        let patch = |at: UVec2| {
            let (origin, end) = (corner(at), corner(at + 1));
            Patch { camera: *self, origin, size: end - origin }
        };
        let rows = 0..counts.y;
        rows.flat_map(|y| (0..counts.x).map(move |x| UVec2::new(x, y))).map(patch).collect()
    }
}

impl Patch {
    /// Whether it is the first of its view, or the whole view.
    pub fn is_first(&self) -> bool {
        self.origin == UVec2::ZERO
    }

    /// Whether it is the whole view.
    pub fn is_whole(&self) -> bool {
        *self == Self::from(&self.camera)
    }

    /// With a margin of this many pixels, clipped to the view.
    pub fn with_margin(&self, pixels: u32) -> Self {
        let whole = Self::from(&self.camera).size;
        let origin = self.origin.saturating_sub(UVec2::splat(pixels));
        let end = (self.origin + self.size).saturating_add(UVec2::splat(pixels)).min(whole);
        Self { origin, size: end - origin, ..*self }
    }

    /// Crops planes of the view, (planes, H, W).
    pub fn cut<'a, T: Copy>(&self, planes: &'a [T]) -> Cow<'a, [T]> {
        if self.is_whole() {
            return Cow::Borrowed(planes);
        }
        let whole = Self::from(&self.camera);
        let planes = planes.chunks_exact(whole.pixel_count());
        let rows = planes.flat_map(|plane| self.rows_in(&whole).map(|row| &plane[row]));
        rows.flatten().copied().collect()
    }

    /// Copies it from the planes of one enclosing patch to those of another, (planes, h, w) each.
    pub fn paste(&self, from: &Self, source: &[f32], into: &Self, target: &mut [f32]) {
        let targets = target.chunks_exact_mut(into.pixel_count());
        for (target, source) in targets.zip(source.chunks_exact(from.pixel_count())) {
            for (to, row) in self.rows_in(into).zip(self.rows_in(from)) {
                target[to].copy_from_slice(&source[row]);
            }
        }
    }

    /// Its halves along its longer side; `None` for a single pixel.
    pub fn halves(&self) -> Option<[Self; 2]> {
        let UVec2 { x, y } = self.size;
        let first = if x >= y { UVec2::new(x / 2, y) } else { UVec2::new(x, y / 2) };
        let step = if x >= y { UVec2::new(first.x, 0) } else { UVec2::new(0, first.y) };
        let second = Self { origin: self.origin + step, size: self.size - step, ..*self };
        (self.size != UVec2::ONE).then_some([Self { size: first, ..*self }, second])
    }

    /// Pixels of a plane.
    pub fn pixel_count(&self) -> usize {
        self.size.x as usize * self.size.y as usize
    }

    /// The ranges of its rows in a plane of an enclosing patch.
    fn rows_in(&self, around: &Self) -> impl Iterator<Item = Range<usize>> + use<> {
        let ([column, row], [width, height]) =
            ((self.origin - around.origin).to_array(), self.size.to_array());
        let stride = around.size.x as usize;
        (row..row + height).map(move |row| {
            let first = row as usize * stride + column as usize;
            first..first + width as usize
        })
    }

    /// A camera whose whole view it is; splats far beyond its edges may differ there.
    pub fn own_camera(&self) -> Camera {
        let Self { camera, origin, size } = *self;
        Camera {
            width: size.x,
            height: size.y,
            principal_point: camera.principal_point - origin.as_dvec2(),
            ..camera
        }
    }

    /// Half the view, in pixels, times the fraction of its pixels in the patch: converts the gradient of a loss per
    /// pixel of the patch to normalised device units and a loss per pixel of the view.
    pub fn half_view(&self) -> Vec2 {
        let whole = Self::from(&self.camera).size.as_vec2();
        let share = (self.size.as_vec2() / whole).element_product();
        0.5 * share * whole
    }
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec2, DVec3};

    use super::*;
    use crate::camera::CameraModel;

    fn camera(width: u32, height: u32) -> Camera {
        Camera {
            width,
            height,
            focal: DVec2::new(80.0, 90.0),
            principal_point: DVec2::new(47.0, 33.0),
            model: CameraModel::Pinhole,
            view_from_world: DAffine3::from_translation(DVec3::new(0.5, 0.0, 2.0)),
        }
    }

    #[test]
    fn patches_are_the_view_without_gap_or_overlap_and_each_fits() {
        for (width, height, most, count) in [
            (100, 60, 6000, 1),
            (100, 60, 3000, 2),
            (101, 61, 700, 12),
            (70, 1, 20, 4),
            (100, 60, 9, 1),
        ] {
            let patches = camera(width, height).patches(|size| size.element_product() <= most);
            assert_eq!(patches.len(), count, "{width}x{height} by {most}");
            let mut seen = vec![0; (width * height) as usize];
            for Patch { origin, size, .. } in &patches {
                assert!(size.element_product() <= most || most < 16);
                for y in origin.y..origin.y + size.y {
                    (origin.x..origin.x + size.x).for_each(|x| seen[(y * width + x) as usize] += 1);
                }
            }
            assert!(seen.iter().all(|&times| times == 1));
            assert!(patches[0].is_first());
            assert_eq!(patches[0].is_whole(), count == 1);
        }
    }

    #[test]
    fn a_point_lies_in_a_patch_where_it_lies_in_the_view() {
        let camera = camera(100, 60);
        let point = DVec3::new(0.1, -0.2, 0.3);
        let whole = camera.project(point).unwrap();
        for patch in camera.patches(|size| size.x <= 30 && size.y <= 30) {
            let at = patch.own_camera().project(point).unwrap();
            assert!((at + patch.origin.as_dvec2() - whole).length() < 1e-12);
        }
    }

    #[test]
    fn margins_end_where_the_view_does() {
        let patches = camera(100, 60).patches(|size| size.x <= 50);
        let [left, right] = patches[..] else { panic!("{patches:?}") };
        let padded = left.with_margin(7);
        assert_eq!((padded.origin, padded.size), (UVec2::ZERO, UVec2::new(57, 60)));
        let padded = right.with_margin(7);
        assert_eq!((padded.origin, padded.size), (UVec2::new(43, 0), UVec2::new(57, 60)));
    }

    #[test]
    fn what_is_cut_out_is_pasted_back() {
        let camera = camera(13, 9);
        let view: Vec<f32> = (0..2 * 13 * 9).map(|i| i as f32).collect();
        let mut pasted = vec![-1.0; view.len()];
        for patch in camera.patches(|size| size.element_product() <= 20) {
            let around = patch.with_margin(2);
            let content = patch.cut(&view);
            assert_eq!(content.len(), 2 * patch.pixel_count());
            let UVec2 { x, y } = patch.origin;
            assert_eq!(content[0], (y * 13 + x) as f32);
            let whole = Patch::from(&camera);
            patch.paste(&around, &around.cut(&view), &whole, &mut pasted);
            for half in patch.halves().unwrap() {
                let at = half.cut(&view)[0];
                assert_eq!(at, (half.origin.y * 13 + half.origin.x) as f32);
            }
            let [first, second] = patch.halves().unwrap().map(|half| half.pixel_count());
            assert_eq!(first + second, patch.pixel_count());
        }
        assert_eq!(pasted, view);
        assert!(matches!(Patch::from(&camera).cut(&view), Cow::Borrowed(_)));
    }
}
