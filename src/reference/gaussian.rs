//! One Gaussian's attributes in the planes of [`attributes`](nightsplat_models::attributes).

use std::borrow::Cow;
use std::ops::Range;

use glam::{DVec3, DVec4};
use nightsplat_models::attributes::{Attribute, AttributePlane, PlaneCounts, column_count, planes};

use crate::splats::packed_sh::PackedSh;

/// A Gaussian, or the gradient of one, in f64.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian {
    /// World units.
    pub mean: DVec3,
    /// (w, x, y, z), not normalised.
    pub quat: DVec4,
    /// ln of the standard deviations, in world units.
    pub log_scale: DVec3,
    /// Before the sigmoid.
    pub raw_opacity: f64,
    /// Blended values in addition to colour.
    pub features: Vec<f64>,
    /// All stored SH coefficients, degree 0 first, RGB.
    pub sh: Vec<DVec3>,
}

/// The layout of an array of attributes.
#[derive(Clone, Copy, Debug)]
pub struct Planes {
    /// Gaussians in the array.
    pub count: usize,
    /// Features per Gaussian.
    pub feature_count: usize,
    /// The stored SH degree.
    pub sh_degree: u32,
    /// The SH coefficients above degree 0 are stored word by word, each for all Gaussians.
    pub rest_by_column: bool,
}

/// The layout of an array of words, of which the last attribute may be in halves.
#[derive(Clone, Copy)]
pub(super) struct Words {
    /// Gaussians in the array.
    pub(super) count: usize,
    pub(super) feature_count: usize,
    /// Words per Gaussian.
    pub(super) columns: usize,
    pub(super) rest_by_column: bool,
}

impl Words {
    /// The layout of `count` Gaussians.
    pub(super) fn new(
        count: usize,
        [feature_count, columns]: [u32; 2],
        rest_by_column: bool,
    ) -> Self {
        let [feature_count, columns] = [feature_count, columns].map(|n| n as usize);
        Self { count, feature_count, columns, rest_by_column }
    }

    /// The indices of the words of Gaussian `i`.
    pub(super) fn of_gaussian(self, i: usize) -> impl Iterator<Item = usize> {
        planes(self.feature_count, self.columns).into_iter().flat_map(move |plane| {
            (0..plane.width).map(move |k| plane.index(self.rest_by_column, self.count, i, k))
        })
    }
}

impl Planes {
    /// The planes of this many Gaussians whose splats have this many channels: colour, and the features after it.
    pub(super) fn new(
        gaussian_count: u32,
        channels: u32,
        sh_degree: u32,
        rest_by_column: bool,
    ) -> Self {
        let feature_count = channels as usize - 3;
        Self { count: gaussian_count as usize, feature_count, sh_degree, rest_by_column }
    }

    /// Floats of the whole array.
    pub fn float_count(self) -> usize {
        self.count * column_count(self.feature_count, self.sh_degree)
    }

    /// The indices of the floats of Gaussian `i`, in the order of [`Gaussian`].
    pub(super) fn indices(self, i: usize) -> impl Iterator<Item = usize> {
        let Self { count, feature_count, sh_degree, rest_by_column } = self;
        let columns = column_count(feature_count, sh_degree);
        Words { count, feature_count, columns, rest_by_column }.of_gaussian(i)
    }

    /// The array as floats, Gaussian by Gaussian, and its planes; the last one may be in halves.
    pub(super) fn floats(self, parameters: &[f32], half_rest: bool) -> (Self, Cow<'_, [f32]>) {
        let Self { count, feature_count: features, sh_degree, rest_by_column } = self;
        let planes =
            PlaneCounts { gaussians: count, columns: column_count(features, sh_degree), features };
        let packed = PackedSh::new(planes);
        let words = if half_rest { packed.columns() } else { planes.columns };
        let mut by_gaussian = Cow::from(parameters);
        if rest_by_column {
            let column = planes.before_rest();
            let rest = AttributePlane { attribute: Attribute::Rest, column, width: words - column };
            for (i, k) in (0..count).flat_map(|i| (0..rest.width).map(move |k| (i, k))) {
                by_gaussian.to_mut()[rest.index(false, count, i, k)] =
                    parameters[rest.index(true, count, i, k)];
            }
        }
        let floats = if half_rest { packed.unpack(&by_gaussian).into() } else { by_gaussian };
        (Self { rest_by_column: false, ..self }, floats)
    }

    /// Gaussian `i` of the array.
    pub fn load<T: Copy + Into<f64>>(self, parameters: &[T], i: usize) -> Gaussian {
        let v: Vec<f64> = self.indices(i).map(|at| parameters[at].into()).collect();
        let planes = planes(self.feature_count, v.len());
        let of = |attribute: Attribute| {
            let AttributePlane { column, width, .. } = planes[attribute as usize];
            &v[column..column + width]
        };
        Gaussian {
            mean: DVec3::from_slice(of(Attribute::Means)),
            quat: DVec4::from_slice(of(Attribute::Quats)),
            log_scale: DVec3::from_slice(of(Attribute::LogScales)),
            raw_opacity: of(Attribute::RawOpacities)[0],
            features: of(Attribute::Features).to_vec(),
            sh: [of(Attribute::Dc), of(Attribute::Rest)]
                .into_iter()
                .flat_map(|sh| sh.chunks_exact(3).map(DVec3::from_slice))
                .collect(),
        }
    }

    /// Writes Gaussian `i` through `set`, which takes index and value.
    pub fn store(self, gaussian: &Gaussian, i: usize, mut set: impl FnMut(usize, f64)) {
        self.indices(i).zip(gaussian.values()).for_each(|(at, value)| set(at, value));
    }
}

impl Gaussian {
    /// Its numbers in the order of the planes.
    pub(super) fn values(&self) -> impl Iterator<Item = f64> {
        let sh = |range: Range<usize>| self.sh[range].iter().flat_map(DVec3::to_array);
        (self.mean.to_array().into_iter())
            .chain(self.quat.to_array())
            .chain(self.log_scale.to_array())
            .chain([self.raw_opacity])
            .chain(sh(0..1))
            .chain(self.features.iter().copied())
            .chain(sh(1..self.sh.len()))
    }
}

/// The logistic function.
pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}
