//! Levels of detail: each has half as many Gaussians as the level before, in cells whose levels are independent.
//!
//! In a cell, the two neighbours whose merging changes images least are merged, over and over, until half are left. A
//! pair is replaced by the Gaussian with the moments of its composited alpha, the inverse of density control's
//! conserving split:
//!
//! ```text
//! alpha = a_1 + a_2 - a_1 a_2
//! w_i   = o_i A_i                                                      the integral of a_i
//! w_12  = o_1 o_2 I_12                                                 that of the product, which is at m_12, C_12
//! w     = w_1 + w_2 - w_12
//! m     = (w_1 m_1 + w_2 m_2 - w_12 m_12) / w
//! C     = (w_1 (C_1 + d_1 d_1^T) + w_2 (C_2 + d_2 d_2^T) - w_12 (C_12 + d_12 d_12^T)) / w       d = m_i - m
//! o     = w / A(C)
//! c     = ((w_1 - w_12 / 2) c_1 + (w_2 - w_12 / 2) c_2) / w            colour, SH, features
//! ```
//!
//! A is the integral of a Gaussian of height 1 and I that of the product of two, over an image plane, summed over the
//! planes of two axes of the world. Where o would exceed 0.99, the Gaussian is larger instead, so that it
//! covers as much. The change of images is the integral of the squared difference of premultiplied colour and alpha,
//! without what one of the two hides of the other, summed over the same planes.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;
use std::ops::Range;

use glam::{DMat3, DQuat, DVec3, DVec4, Vec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

use crate::gaussians::{Attribute, Gaussians, SH_C0};

/// The largest opacity of a merged Gaussian.
const MAX_OPACITY: f64 = 0.99;

/// The smallest opacity that counts, so that a pair of invisible Gaussians has moments.
const MIN_OPACITY: f64 = 1e-9;

/// How many of the nearest are neighbours of a Gaussian, itself included.
const NEIGHBOURS: usize = 9;

/// The most neighbours of a Gaussian; more where many are in one place would take quadratic time.
const MAX_NEIGHBOURS: usize = 24;

/// What a change of alpha by 1 counts as, in changes of a colour: the brightness of what it hides.
const ALPHA: f64 = 0.5;

/// The smallest variance, relative to the largest, and of any Gaussian: one without extent covers no area.
const MIN_VARIANCE: [f64; 2] = [1e-12, 1e-30];

/// The Gaussians of a model in cells that are close to cubes: the leaves of a k-d tree that is split at the median
/// along the longest axis.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cells {
    /// The Gaussians, those of a cell together.
    pub order: Vec<u32>,
    /// The cells in the order of the tree, as ranges of `order`.
    pub cells: Vec<Range<usize>>,
}

impl Cells {
    /// Cells of at most this many Gaussians, and of at least half as many if there are more than one.
    pub fn new(means: &[Vec3], most: usize) -> Self {
        let mut cells = Self { order: (0..means.len() as u32).collect(), cells: vec![] };
        cells.split(means, 0..means.len(), most);
        cells
    }

    fn split(&mut self, means: &[Vec3], range: Range<usize>, most: usize) {
        if range.len() <= most.max(1) {
            self.cells.push(range);
            return;
        }
        let part = &mut self.order[range.clone()];
        let bounds =
            part.iter().fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[low, high], &index| {
                let mean = means[index as usize];
                [low.min(mean), high.max(mean)]
            });
        let axis = (bounds[1] - bounds[0]).max_position();
        let middle = first_half(range.len());
        part.select_nth_unstable_by(middle, |&a, &b| {
            means[a as usize][axis].total_cmp(&means[b as usize][axis]).then(a.cmp(&b))
        });
        // The order within a cell must not depend on how the median was found.
        part[..middle].sort_unstable();
        part[middle..].sort_unstable();
        self.split(means, range.start..range.start + middle, most);
        self.split(means, range.start + middle..range.end, most);
    }
}

/// How many of the Gaussians of a node of the tree its first child has.
pub fn first_half(count: usize) -> usize {
    count.div_ceil(2)
}

/// The next level of a cell: half of its Gaussians, rounded up; and how much that changes images: the sum of all
/// changes of premultiplied colour and alpha, squared and integrated over the planes of two axes.
pub fn coarser(gaussians: &Gaussians) -> (Gaussians, f64) {
    let goal = gaussians.count.div_ceil(2);
    let (mut level, mut changes) = (gaussians.clone(), 0.0);
    // Once is enough, unless many are in one place.
    while level.count > goal {
        let mut merging = Merging::new(&level);
        let mut left = level.count;
        while left > goal
            && let Some(change) = merging.merge_next()
        {
            changes += change.max(0.0);
            left -= 1;
        }
        if left == level.count {
            break;
        }
        level = merging.gaussians(&level);
    }
    (level, changes)
}

/// A level of a model whose tiles have these numbers of Gaussians, tile by tile in cells of at most `most`; level 0 is
/// the model, cell by cell.
pub fn level(gaussians: &Gaussians, tiles: &[usize], most: usize, level: usize) -> Gaussians {
    let (mut indices, mut start): (Vec<Vec<u32>>, usize) = (vec![], 0);
    for &count in tiles.iter().filter(|count| **count > 0) {
        let Cells { order, cells } = Cells::new(&gaussians.means()[start..][..count], most);
        let of_cell =
            |cell: Range<usize>| order[cell].iter().map(move |index| index + start as u32);
        indices.extend(cells.into_iter().map(|cell| of_cell(cell).collect()));
        start += count;
    }
    let of_cell =
        |cell: &Vec<u32>| (0..level).fold(gaussians.select(cell), |index, _| coarser(&index).0);
    let cells: Vec<Gaussians> = indices.par_iter().map(of_cell).collect();
    Gaussians::concatenated(&cells.iter().collect::<Vec<_>>())
}

/// The shape of a Gaussian and what it looks like.
#[derive(Clone, Copy)]
struct MergedGaussian {
    mean: DVec3,
    covariance: DMat3,
    opacity: f64,
    /// Its colour from all sides, and [`ALPHA`].
    color: DVec4,
    /// A in each plane.
    areas: DVec3,
}

/// The merging of a cell.
struct Merging {
    parts: Vec<MergedGaussian>,
    /// Attributes that are averaged, a row a Gaussian.
    rows: Vec<f64>,
    width: usize,
    neighbours: Vec<Vec<u32>>,
    /// Counts the changes of each, so that older candidates are recognised; [`GONE`] of one merged into another.
    versions: Vec<u32>,
    /// The least change first.
    candidates: BinaryHeap<Reverse<MergeCandidate>>,
}

/// The version of a Gaussian that is merged into another.
const GONE: u32 = u32::MAX;

/// Two neighbours that can be merged.
#[derive(PartialEq)]
struct MergeCandidate {
    change: f64,
    pair: [u32; 2],
    versions: [u32; 2],
}

impl Eq for MergeCandidate {}

impl Ord for MergeCandidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.change.total_cmp(&other.change).then(self.pair.cmp(&other.pair))
    }
}

impl PartialOrd for MergeCandidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The attributes that are averaged.
const AVERAGED: [Attribute; 3] = [Attribute::Dc, Attribute::Features, Attribute::Rest];

impl Merging {
    fn new(gaussians: &Gaussians) -> Self {
        let count = gaussians.count;
        let planes = AVERAGED.map(|attribute| &gaussians.parameters[gaussians.plane(attribute)]);
        let widths = planes.map(|plane| plane.len() / count.max(1));
        let width = widths.iter().sum();
        let mut rows = Vec::with_capacity(count * width);
        for index in 0..count {
            for (plane, width) in planes.iter().zip(widths) {
                rows.extend(plane[width * index..][..width].iter().map(|&value| f64::from(value)));
            }
        }
        let neighbours = gaussians.nearest_of_each::<NEIGHBOURS>();
        let mut merging = Self {
            parts: (0..count).map(|index| MergedGaussian::new(gaussians, index)).collect(),
            rows,
            width,
            neighbours: vec![vec![]; count],
            versions: vec![0; count],
            candidates: BinaryHeap::new(),
        };
        for (index, nearest) in (0..).zip(neighbours) {
            for other in nearest.into_iter().filter(|&other| other != index) {
                merging.connect(index, other);
            }
        }
        merging
    }

    /// Makes two Gaussians neighbours, unless they are or one has enough of them.
    fn connect(&mut self, a: u32, b: u32) {
        let [of_a, of_b] = [a, b].map(|index| &self.neighbours[index as usize]);
        if of_a.len() >= MAX_NEIGHBOURS || of_b.len() >= MAX_NEIGHBOURS || of_a.contains(&b) {
            return;
        }
        self.neighbours[a as usize].push(b);
        self.neighbours[b as usize].push(a);
        self.consider(a, b);
    }

    fn consider(&mut self, a: u32, b: u32) {
        let pair = [a.min(b), a.max(b)];
        let [first, second] = pair.map(|index| &self.parts[index as usize]);
        let change = change(first, second, &merged(first, second).0);
        let versions = pair.map(|index| self.versions[index as usize]);
        self.candidates.push(Reverse(MergeCandidate { change, pair, versions }));
    }

    /// Merges the pair of least change, and returns it; `None` if there is no pair.
    fn merge_next(&mut self) -> Option<f64> {
        while let Some(Reverse(MergeCandidate { pair, versions, change })) = self.candidates.pop() {
            if pair.map(|index| self.versions[index as usize]) == versions {
                self.merge(pair);
                return Some(change);
            }
        }
        None
    }

    fn merge(&mut self, [kept, gone]: [u32; 2]) {
        let [a, b] = [kept, gone].map(|index| index as usize);
        let (part, share) = merged(&self.parts[a], &self.parts[b]);
        self.parts[a] = part;
        let (before, after) = self.rows.split_at_mut(b * self.width);
        for (to, from) in before[a * self.width..].iter_mut().zip(&after[..self.width]) {
            *to = share * *to + (1.0 - share) * from;
        }
        self.versions[a] += 1;
        self.versions[b] = GONE;
        let inherited = std::mem::take(&mut self.neighbours[b]);
        for &other in &inherited {
            self.neighbours[other as usize].retain(|&its| its != gone);
        }
        let neighbours = self.neighbours[a].clone();
        neighbours
            .iter()
            .filter(|&&other| other != gone)
            .for_each(|&other| self.consider(kept, other));
        for other in inherited.into_iter().filter(|&other| other != kept) {
            self.connect(kept, other);
        }
    }

    /// Those that are left, in their order.
    fn gaussians(&self, from: &Gaussians) -> Gaussians {
        let left = (0..self.parts.len()).filter(|&index| self.versions[index] != GONE);
        let left: Vec<usize> = left.collect();
        let mut level = Gaussians::zeros(left.len(), from.shape);
        level.origin = from.origin;
        for (to, &index) in left.iter().enumerate() {
            // One that is not merged keeps its numbers.
            if self.versions[index] == 0 {
                level.means_mut()[to] = from.means()[index];
                level.quats_mut()[to] = from.quats()[index];
                level.log_scales_mut()[to] = from.log_scales()[index];
                level.raw_opacities_mut()[to] = from.raw_opacities()[index];
                continue;
            }
            let part = &self.parts[index];
            let (quat, log_scales) = ellipsoid(part.covariance);
            level.means_mut()[to] = part.mean.as_vec3();
            level.quats_mut()[to] = quat;
            level.log_scales_mut()[to] = log_scales;
            level.raw_opacities_mut()[to] = (part.opacity / (1.0 - part.opacity)).ln() as f32;
        }
        let mut column = 0;
        for attribute in AVERAGED {
            let plane = level.plane(attribute);
            let width = plane.len() / left.len().max(1);
            let rows = level.parameters[plane].chunks_exact_mut(width.max(1));
            for (to, index) in rows.zip(&left) {
                let row = &self.rows[index * self.width + column..][..width];
                to.iter_mut().zip(row).for_each(|(to, row)| *to = *row as f32);
            }
            column += width;
        }
        level
    }
}

impl MergedGaussian {
    fn new(gaussians: &Gaussians, index: usize) -> Self {
        let [w, x, y, z] = gaussians.quats()[index].map(f64::from);
        let rotation = DQuat::from_xyzw(x, y, z, w);
        let rotation =
            if rotation.length() > 1e-12 { rotation.normalize() } else { DQuat::IDENTITY };
        let scales = gaussians.log_scales()[index].as_dvec3().exp();
        let axes = DMat3::from_quat(rotation);
        let variances = with_extent(scales * scales);
        let covariance = axes * DMat3::from_diagonal(variances) * axes.transpose();
        let raw_opacity = f64::from(gaussians.raw_opacities()[index]);
        let color = gaussians.dc()[index].as_dvec3() * f64::from(SH_C0) + 0.5;
        Self {
            mean: gaussians.means()[index].as_dvec3(),
            covariance,
            opacity: (1.0 / (1.0 + (-raw_opacity).exp())).max(MIN_OPACITY),
            color: color.extend(ALPHA),
            areas: areas(covariance),
        }
    }
}

/// A Gaussian in place of two, and the share of the first one's colour in its own.
fn merged(a: &MergedGaussian, b: &MergedGaussian) -> (MergedGaussian, f64) {
    let offset = b.mean - a.mean;
    let both = a.covariance + b.covariance;
    // Flat ones of one plane have no inverse.
    let trace = both.x_axis.x + both.y_axis.y + both.z_axis.z;
    let inverse = (both + DMat3::from_diagonal(DVec3::splat(1e-9 * trace))).inverse();
    let product = a.covariance * inverse * b.covariance;
    let product = 0.5 * (product + product.transpose());
    let between = a.covariance * (inverse * offset);

    let [weight_a, weight_b] = [a, b].map(|part| part.opacity * part.areas.element_sum());
    let weight_ab = a.opacity * b.opacity * overlap(a, b);
    let weight = weight_a + weight_b - weight_ab;
    // Relative to the first one's.
    let mean = (weight_b * offset - weight_ab * between) / weight;
    let covariance = (weight_a * (a.covariance + outer(mean))
        + weight_b * (b.covariance + outer(offset - mean))
        - weight_ab * (product + outer(between - mean)))
        * weight.recip();
    let merged_areas = areas(covariance);
    let opacity = weight / merged_areas.element_sum();
    let growth = (opacity / MAX_OPACITY).max(1.0);
    let share = (weight_a - 0.5 * weight_ab) / weight;
    let part = MergedGaussian {
        mean: a.mean + mean,
        covariance: covariance * growth,
        opacity: opacity.min(MAX_OPACITY),
        color: a.color * share + b.color * (1.0 - share),
        areas: merged_areas * growth,
    };
    (part, share)
}

/// The integral of the squared change of an image by a merged Gaussian in place of two, in units of 2 pi.
fn change(a: &MergedGaussian, b: &MergedGaussian, merged: &MergedGaussian) -> f64 {
    let product = |first: &MergedGaussian, second: &MergedGaussian| {
        first.opacity * second.opacity * first.color.dot(second.color) * overlap(first, second)
    };
    product(a, a)
        + product(b, b)
        + product(merged, merged)
        + 2.0 * (product(a, b) - product(a, merged) - product(b, merged))
}

fn outer(vector: DVec3) -> DMat3 {
    DMat3::from_cols(vector * vector.x, vector * vector.y, vector * vector.z)
}

/// The determinants of a covariance in the planes of z and y, x and z, y and x.
fn determinants(covariance: DMat3) -> DVec3 {
    let [x, y, z] = [covariance.x_axis, covariance.y_axis, covariance.z_axis];
    let minors = DVec3::new(y.y * z.z - y.z * y.z, x.x * z.z - x.z * x.z, x.x * y.y - x.y * x.y);
    minors.max(DVec3::ZERO)
}

/// The integral of a Gaussian of height 1 over each plane, in units of 2 pi.
fn areas(covariance: DMat3) -> DVec3 {
    determinants(covariance).map(f64::sqrt)
}

/// The integral of the product of two Gaussians of height 1, summed over the planes, in units of 2 pi.
fn overlap(a: &MergedGaussian, b: &MergedGaussian) -> f64 {
    let offset = b.mean - a.mean;
    let both = a.covariance + b.covariance;
    let determinants = determinants(both);
    let of_plane = |(normal, [i, j]): (usize, [usize; 2])| {
        let determinant = determinants[normal];
        if determinant <= 0.0 {
            return 0.0;
        }
        let (x, y) = (offset[i], offset[j]);
        let square = both.col(j)[j] * x * x - 2.0 * both.col(i)[j] * x * y + both.col(i)[i] * y * y;
        let height = (-0.5 * square / determinant).exp() / determinant.sqrt();
        a.areas[normal] * b.areas[normal] * height
    };
    [[1, 2], [0, 2], [0, 1]].into_iter().enumerate().map(of_plane).sum()
}

/// Variances of which none vanishes.
fn with_extent(variances: DVec3) -> DVec3 {
    let [share, least] = MIN_VARIANCE;
    variances.max(DVec3::splat(least.max(share * variances.max_element())))
}

/// Rotation and logarithms of the standard deviations.
fn ellipsoid(covariance: DMat3) -> ([f32; 4], Vec3) {
    let matrix = Matrix3::from_column_slice(&covariance.to_cols_array());
    let SymmetricEigen { eigenvectors, eigenvalues } = SymmetricEigen::new(matrix);
    let axes = DMat3::from_cols_slice(eigenvectors.as_slice());
    let axes = if axes.determinant() < 0.0 { -axes } else { axes };
    let variances = with_extent(DVec3::from_slice(eigenvalues.as_slice()));
    let log_scales = variances.map(|variance| 0.5 * variance.ln());
    let DQuat { x, y, z, w } = DQuat::from_mat3(&axes).normalize();
    ([w, x, y, z].map(|part| part as f32), log_scales.as_vec3())
}
