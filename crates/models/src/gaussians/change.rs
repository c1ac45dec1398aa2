//! Changes of a set of Gaussians in place: transforms, removal, and joining.

use glam::DVec3;
use rayon::prelude::*;

use super::neighbours::Neighbours;
use super::{ATTRIBUTES, AttributePlane, Gaussians};

/// A model is moved in its numbers up to this many times its size; farther, its origin is moved instead.
const FAR: f64 = 64.0;

#[doc(hidden)]
impl Gaussians {
    /// Scales the world about its origin by a factor above 0.
    pub fn scale(&mut self, factor: f64) {
        self.origin *= factor;
        for mean in self.means_mut() {
            *mean = (mean.as_dvec3() * factor).as_vec3();
        }
        for scale in self.log_scales_mut() {
            *scale = (scale.as_dvec3() + factor.ln()).as_vec3();
        }
    }

    /// Moves the world. `is_far`: by the origin, as the means, which are f32, would lose precision; [`is_far`] tells.
    pub fn translate(&mut self, by: DVec3, is_far: bool) {
        if is_far {
            self.origin += by;
            return;
        }
        for mean in self.means_mut() {
            *mean = (mean.as_dvec3() + by).as_vec3();
        }
    }

    /// Removes the Gaussians that have an infinity or NaN.
    pub fn retain_finite(&mut self) {
        let mut keep = vec![true; self.count];
        for spec in &ATTRIBUTES {
            let plane = &self.parameters[self.plane(spec.attribute)];
            let rows = plane.chunks_exact(self.columns(spec.attribute).width.max(1));
            for (keep, row) in keep.iter_mut().zip(rows) {
                *keep &= row.iter().all(|value| value.is_finite());
            }
        }
        self.retain(&keep);
    }

    /// Removes the Gaussians whose `keep` is false; the others keep their order.
    pub fn retain(&mut self, keep: &[bool]) {
        let kept = keep.iter().filter(|keep| **keep).count();
        if kept == self.count {
            return;
        }
        let mut to = 0;
        for spec in &ATTRIBUTES {
            let AttributePlane { column, width, .. } = self.columns(spec.attribute);
            for (index, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
                let from = column * self.count + index * width;
                self.parameters.copy_within(from..from + width, to);
                to += width;
            }
        }
        self.parameters.truncate(to);
        self.count = kept;
    }

    /// These Gaussians, in this order.
    pub fn select(&self, indices: &[u32]) -> Self {
        let mut some = Self::zeros(indices.len(), self.shape);
        some.origin = self.origin;
        for spec in &ATTRIBUTES {
            let from = &self.parameters[self.plane(spec.attribute)];
            let width = from.len() / self.count.max(1);
            let plane = some.plane(spec.attribute);
            let rows = some.parameters[plane].chunks_exact_mut(width.max(1));
            for (to, &index) in rows.zip(indices) {
                to.copy_from_slice(&from[width * index as usize..][..width]);
            }
        }
        some
    }

    /// Gaussians of one shape, one after the other, at least one set of them; the positions of all stay where they are
    /// in the world, relative to the first one's origin.
    pub fn concatenated(parts: &[&Self]) -> Self {
        let (shape, origin) = (parts[0].shape, parts[0].origin);
        let mut all = Self::zeros(parts.iter().map(|part| part.count).sum(), shape);
        all.origin = origin;
        for spec in &ATTRIBUTES {
            let mut at = all.plane(spec.attribute).start;
            for part in parts {
                debug_assert_eq!(part.shape, shape, "planes of two shapes");
                let plane = &part.parameters[part.plane(spec.attribute)];
                all.parameters[at..at + plane.len()].copy_from_slice(plane);
                at += plane.len();
            }
        }
        let mut at = 0;
        for part in parts {
            let offset = part.origin - origin;
            if offset != DVec3::ZERO {
                for mean in &mut all.means_mut()[at..at + part.count] {
                    *mean = (mean.as_dvec3() + offset).as_vec3();
                }
            }
            at += part.count;
        }
        all
    }

    /// Appends Gaussians of the same shape; the positions of both stay where they are in the world.
    pub fn append(&mut self, other: &Self) {
        *self = Self::concatenated(&[&*self, other]);
    }

    /// The parameters of a Gaussian, attribute by attribute.
    pub fn row(&self, index: usize) -> impl Iterator<Item = &[f32]> {
        ATTRIBUTES.iter().map(move |spec| {
            let AttributePlane { column, width, .. } = self.columns(spec.attribute);
            &self.parameters[column * self.count + index * width..][..width]
        })
    }

    /// Appends Gaussians of the same features to those that there are, if any; all get the higher of the SH degrees.
    pub fn add(to: &mut Option<Self>, more: Self) {
        match to {
            _ if more.count == 0 => {}
            None => *to = Some(more),
            Some(sum) => {
                let degree = sum.shape.sh_degree.max(more.shape.sh_degree);
                *sum = sum.with_sh_degree(degree);
                sum.append(&more.with_sh_degree(degree));
            }
        }
    }

    /// The position of a Gaussian in the world.
    pub fn position(&self, index: usize) -> DVec3 {
        self.means()[index].as_dvec3() + self.origin
    }

    /// The root mean squared distance of each Gaussian to the three nearest others; infinite if there are fewer.
    pub fn distances_to_nearest(&self) -> Vec<f64> {
        let positions: Vec<DVec3> = self.means().iter().map(|mean| mean.as_dvec3()).collect();
        let neighbours = Neighbours::new(positions.clone());
        let distance = |position: &DVec3| {
            // The nearest is the Gaussian itself.
            let nearest = neighbours.nearest::<4>(*position);
            (nearest[1..].iter().map(|(squared, _)| squared).sum::<f64>() / 3.0).sqrt()
        };
        positions.par_iter().map(distance).collect()
    }

    /// The indices of the `COUNT` Gaussians nearest to each, itself among them; there can be fewer.
    pub fn nearest_of_each<const COUNT: usize>(&self) -> Vec<Vec<u32>> {
        let positions: Vec<DVec3> = self.means().iter().map(|mean| mean.as_dvec3()).collect();
        let neighbours = Neighbours::new(positions.clone());
        positions.iter().map(|position| neighbours.nearest_indices::<COUNT>(*position)).collect()
    }

    /// Opacities after the sigmoid.
    pub fn opacities(&self) -> impl Iterator<Item = f64> {
        self.raw_opacities().iter().map(|&raw| 1.0 / (1.0 + (-f64::from(raw)).exp()))
    }
}

/// Whether a move of a model, whose median distance to its origin is `size`, is left to the origin.
pub fn is_far(by: DVec3, origin: DVec3, size: f64) -> bool {
    origin != DVec3::ZERO || by.length() > FAR * size
}

/// The distribution of lengths, in memory that does not depend on how many they are.
#[derive(Clone, Debug)]
pub struct Lengths {
    /// By the leading bits: exponent, and the next two.
    counts: [u64; 1 << Self::BITS],
}

impl Default for Lengths {
    fn default() -> Self {
        Self { counts: [0; 1 << Self::BITS] }
    }
}

impl Lengths {
    const BITS: u32 = 10;
    /// The bits of an f32 that follow the sign and the leading ones.
    const REST: u32 = 31 - Self::BITS;

    /// Adds a length, 0 or more.
    pub fn add(&mut self, length: f32) {
        self.counts[(length.to_bits() >> Self::REST) as usize] += 1;
    }

    /// The median, at most a quarter too small; 0 of none.
    pub fn median(&self) -> f64 {
        let middle = self.counts.iter().sum::<u64>() / 2;
        let mut sum = 0;
        let bits = (0..).zip(&self.counts).find(|(_, count)| {
            sum += **count;
            sum > middle
        });
        bits.map_or(0.0, |(bits, _): (u32, _)| f32::from_bits(bits << Self::REST).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::{Features, Shape, width};
    use nightsplat_core::random::Stream;

    fn drawn(count: usize, seed: u64) -> Gaussians {
        let shape = Shape { sh_degree: 2, features: Features { noise: true, ..Features::NONE } };
        let mut gaussians = Gaussians::zeros(count, shape);
        let stream = Stream::new(seed, 0);
        for (index, value) in (0..).zip(&mut gaussians.parameters) {
            *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
        }
        gaussians
    }

    /// The parameters of a Gaussian in the order of the planes.
    fn row(gaussians: &Gaussians, index: usize) -> Vec<f32> {
        let row = gaussians.row(index).collect::<Vec<_>>().concat();
        assert_eq!(row.len(), width(gaussians.shape));
        row
    }

    #[test]
    fn those_that_are_kept_keep_their_numbers_and_order() {
        let whole = drawn(9, 1);
        let keep = [true, false, false, true, true, false, true, true, false];
        let mut some = whole.clone();
        some.retain(&keep);
        assert_eq!(some.count, 5);
        for (index, from) in [0, 3, 4, 6, 7].into_iter().enumerate() {
            assert_eq!(row(&some, index), row(&whole, from), "{from}");
        }
        some.retain(&[false; 5]);
        assert!(some.parameters.is_empty() && some.count == 0);
    }

    #[test]
    fn those_that_are_selected_are_in_the_order_of_the_selection() {
        let whole = Gaussians { origin: DVec3::new(1e6, 0.0, 0.0), ..drawn(9, 1) };
        let some = whole.select(&[7, 0, 0, 8]);
        assert_eq!((some.count, some.origin), (4, whole.origin));
        for (index, from) in [7, 0, 0, 8].into_iter().enumerate() {
            assert_eq!(row(&some, index), row(&whole, from), "{from}");
        }
        assert_eq!(drawn(0, 1).select(&[]).count, 0);
    }

    #[test]
    fn joined_models_stay_where_they_are_in_the_world() {
        let (mut first, mut second) = (drawn(3, 1), drawn(2, 2));
        first.origin = DVec3::new(1e6, 0.0, -2.0);
        second.origin = DVec3::new(1e6 + 1.0, 0.5, -2.0);
        let (alone, other) = (first.clone(), second.clone());
        first.append(&second);
        assert_eq!((first.count, first.origin), (5, alone.origin));
        for index in 0..3 {
            assert_eq!(row(&first, index), row(&alone, index));
        }
        for index in 0..2 {
            assert!(first.position(3 + index).distance(other.position(index)) < 1e-6);
            assert_eq!(row(&first, 3 + index)[3..], row(&other, index)[3..]);
        }
    }

    #[test]
    fn a_far_move_keeps_the_precision_of_the_means() {
        let mut model = drawn(5, 3);
        let before = model.clone();
        let mut lengths = Lengths::default();
        before.means().iter().for_each(|mean| lengths.add(mean.length()));
        let mut sorted = before.means().iter().map(|mean| mean.length()).collect::<Vec<_>>();
        sorted.sort_by(f32::total_cmp);
        let (size, median) = (lengths.median(), f64::from(sorted[2]));
        assert!(size <= median && size > 0.75 * median, "{size} {median}");
        assert_eq!(Lengths::default().median(), 0.0);
        let moved = |model: &mut Gaussians, by| model.translate(by, is_far(by, DVec3::ZERO, size));
        moved(&mut model, DVec3::new(0.5, 0.0, 0.0));
        assert!(model.origin == DVec3::ZERO && model.means() != before.means());
        let mut far = before.clone();
        moved(&mut far, DVec3::new(5e6, 0.0, 0.25));
        assert_eq!((far.origin, far.means()), (DVec3::new(5e6, 0.0, 0.25), before.means()));
    }

    #[test]
    fn parts_that_are_put_into_place_make_the_whole() {
        let whole = drawn(7, 4);
        let mut made = Gaussians::zeros(7, whole.shape);
        for range in [0..3, 3..5, 5..7] {
            let mut part = whole.clone();
            part.retain(&(0..7).map(|index| range.contains(&index)).collect::<Vec<_>>());
            made.replace(range.start, &part);
        }
        assert_eq!(made, whole);
    }
}
