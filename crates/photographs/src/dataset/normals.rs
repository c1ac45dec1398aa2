//! Normal maps next to photographs.

use std::path::Path;
use std::str::FromStr;

use glam::Vec3;
use nightsplat_core::camera::CameraModel;
use nightsplat_core::{Error, Result};
use serde::{Deserialize, Serialize};

use super::prepare::{Preparation, check_excess, disagreement};
use crate::image::Image;
use crate::image::ImageFile as _;

/// The axes of the vectors of normal maps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NormalAxes {
    /// Those in which most vectors of a map face the camera.
    #[default]
    Auto,
    /// x right, y down, z away from the camera.
    OpenCv,
    /// x right, y up, z towards the camera.
    OpenGl,
}

impl NormalAxes {
    /// Their names.
    #[doc(hidden)]
    pub const NAMES: [&'static str; 3] = ["auto", "opencv", "opengl"];
}

impl FromStr for NormalAxes {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "auto" => Ok(Self::Auto),
            "opencv" => Ok(Self::OpenCv),
            "opengl" => Ok(Self::OpenGl),
            _ => Err(Error::Usage(format!("unknown axes `{name}`; auto, opencv or opengl"))),
        }
    }
}

/// The normals that a view's camera sees: x right, y down, z away from the camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NormalMap {
    width: u32,
    height: u32,
    packed: Vec<u32>,
}

/// The largest of the three signed numbers of ten bits that a normal is stored in.
const LARGEST: f32 = 511.0;
/// Vectors shorter than the first are no normals, nor are longer ones than the second: tools leave grey or black where
/// they have none. The mean of several is shorter than 1, and near 0 at the edge between opposite ones.
const LENGTHS: [f32; 2] = [0.5, 1.25];

impl NormalMap {
    /// From a normal of every pixel, row by row, of any length; zero or what is not finite: none.
    pub fn new(width: u32, height: u32, normals: impl IntoIterator<Item = Vec3>) -> Self {
        let packed = normals.into_iter().map(|normal| {
            let unit = normal.try_normalize().unwrap_or_default();
            let numbers = (LARGEST * unit).round().to_array().map(|number| number as i32 as u32);
            numbers.iter().rev().fold(0, |bits, number| bits << 10 | number & 0x3ff)
        });
        Self { width, height, packed: packed.collect() }
    }

    /// (H, W): three signed numbers of ten bits, x lowest, in units of 1 / 511; 0: no normal.
    pub fn packed(&self) -> &[u32] {
        &self.packed
    }

    /// The normal of every pixel; zero: none.
    fn normals(&self) -> impl Iterator<Item = Vec3> + '_ {
        self.packed.iter().map(|&bits| {
            let number = |left| ((bits << left) as i32 >> 22) as f32;
            Vec3::new(number(22), number(12), number(2)).normalize_or_zero()
        })
    }

    /// The same of another size, by means.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let planes = image_of(self.width, self.height, self.normals());
        Self::of_means(&planes.resized(width, height))
    }

    /// From an image whose values are means of normals.
    fn of_means(means: &Image) -> Self {
        let is_normal = |vector: &Vec3| (LENGTHS[0]..=LENGTHS[1]).contains(&vector.length());
        let normals = vectors(means).map(|vector| Some(vector).filter(is_normal));
        Self::new(means.width, means.height, normals.map(Option::unwrap_or_default))
    }

    /// The normal map of a file, as seen by the view's camera.
    pub(super) fn load(
        path: &Path,
        preparation: &Preparation<'_>,
        axes: NormalAxes,
    ) -> Result<Self> {
        if preparation.camera().model != CameraModel::Pinhole {
            let problem = "normals are those of a pinhole; train this fisheye with --undistort";
            return Err(Error::input(path, problem));
        }
        let lens = preparation.lens;
        check_excess(path, Image::size_of(path)?, lens)?;
        let stored = Image::load_as_stored(path)?;
        let size = (stored.width, stored.height);
        if lens.fitted(size.0, size.1).is_none() {
            return Err(disagreement(path, size, lens));
        }
        let upright = in_view_axes(stored, axes);
        let whole = upright.resized(lens.width, lens.height);
        let (width, height) = preparation.size;
        let map = Self::of_means(&preparation.undistorted(whole).resized(width, height));
        if map.packed.iter().all(|&bits| bits == 0) {
            let problem = "has no normal: its vectors are not of length 1, stored from -1 to 1 or \
                           as (n + 1) / 2";
            return Err(Error::input(path, problem));
        }
        Ok(map)
    }
}

/// Normals from values that are stored as such, or as (n + 1) / 2 where none is negative; zero where there is none.
fn in_view_axes(stored: Image, axes: NormalAxes) -> Image {
    let is_signed = stored.data.iter().any(|&value| value < 0.0);
    let decoded = vectors(&stored).map(|vector| {
        let normal = if is_signed { vector } else { 2.0 * vector - 1.0 };
        let is_normal = (LENGTHS[0]..=LENGTHS[1]).contains(&normal.length());
        if is_normal { normal.normalize() } else { Vec3::ZERO }
    });
    let decoded: Vec<Vec3> = decoded.collect();
    let is_opengl = match axes {
        NormalAxes::Auto => decoded.iter().map(|normal| normal.z).sum::<f32>() > 0.0,
        NormalAxes::OpenCv => false,
        NormalAxes::OpenGl => true,
    };
    let flip = if is_opengl { Vec3::new(1.0, -1.0, -1.0) } else { Vec3::ONE };
    image_of(stored.width, stored.height, decoded.into_iter().map(|normal| flip * normal))
}

/// The values of every pixel as a vector.
fn vectors(image: &Image) -> impl Iterator<Item = Vec3> + '_ {
    let pixels = image.data.len() / 3;
    (0..pixels).map(move |i| Vec3::from_array([0, 1, 2].map(|c| image.data[c * pixels + i])))
}

fn image_of(width: u32, height: u32, vectors: impl Iterator<Item = Vec3>) -> Image {
    let vectors: Vec<Vec3> = vectors.collect();
    let data = (0..3).flat_map(|c| vectors.iter().map(move |vector| vector[c])).collect();
    Image { width, height, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FACING: Vec3 = Vec3::new(0.0, -0.6, -0.8);

    fn only(map: &NormalMap) -> Vec<Vec3> {
        map.normals().collect()
    }

    #[test]
    fn ten_bits_keep_a_normal_within_a_tenth_of_a_degree() {
        let normals = [FACING, Vec3::X, -Vec3::Y, Vec3::new(0.3, 0.2, -0.9), Vec3::ZERO];
        let back = only(&NormalMap::new(5, 1, normals));
        for (normal, back) in normals.into_iter().zip(&back).take(4) {
            assert!(normal.angle_between(*back).to_degrees() < 0.1, "{normal} {back}");
        }
        assert_eq!(back[4], Vec3::ZERO);
        assert_eq!(only(&NormalMap::new(1, 1, [Vec3::NAN])), [Vec3::ZERO]);
    }

    #[test]
    fn opengl_s_axes_are_told_from_opencv_s_by_what_faces_the_camera() {
        let flip = Vec3::new(1.0, -1.0, -1.0);
        // Of a signed map some number is negative, in either axes.
        let facing = [FACING, Vec3::new(-0.6, 0.0, -0.8)];
        let encoded =
            |flip: Vec3| image_of(2, 1, facing.into_iter().map(move |n| 0.5 * flip * n + 0.5));
        let signed = |flip: Vec3| image_of(2, 1, facing.into_iter().map(move |n| flip * n));
        for stored in [encoded(Vec3::ONE), encoded(flip), signed(Vec3::ONE), signed(flip)] {
            let found = only(&NormalMap::of_means(&in_view_axes(stored, NormalAxes::Auto)));
            for (found, facing) in found.iter().zip(facing) {
                assert!(found.angle_between(facing).to_degrees() < 0.1, "{found:?}");
            }
        }
        let chosen = in_view_axes(encoded(flip), NormalAxes::OpenCv);
        assert!(only(&NormalMap::of_means(&chosen))[0].angle_between(flip * FACING) < 0.01);
    }

    #[test]
    fn grey_black_and_what_is_not_a_number_are_no_normals() {
        for nothing in [[0.5; 3], [0.0; 3], [1.0; 3], [f32::NAN; 3], [128.0 / 255.0; 3]] {
            let stored = image_of(1, 1, std::iter::once(Vec3::from_array(nothing)));
            let map = NormalMap::of_means(&in_view_axes(stored, NormalAxes::Auto));
            assert_eq!(map.packed(), [0], "{nothing:?}");
        }
    }

    #[test]
    fn a_mean_of_opposite_normals_is_none_and_of_near_ones_their_mean() {
        let halved = |pair: [Vec3; 2]| only(&NormalMap::new(2, 1, pair).resized(1, 1))[0];
        assert_eq!(halved([Vec3::X, -Vec3::X]), Vec3::ZERO);
        let mean = halved([Vec3::X, Vec3::Y]);
        assert!(mean.angle_between(Vec3::new(1.0, 1.0, 0.0)).to_degrees() < 0.2, "{mean}");
    }
}
