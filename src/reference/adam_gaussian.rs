use glam::DVec3;
use nightsplat_models::attributes::{Attribute, PlaneCounts, column_count, planes};

use super::adam::{bounded, clamp_gradient, stepped};
use super::camera::ReferenceCamera;
use super::gaussian::{Planes, Words};
use super::project_backward::sh_backward;
use super::random::random_bits;
use super::rounding::{Rounded, UNIT};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::adam_gaussian::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::adam_step::{BETA1, BETA2};
use crate::kernels::half::{LARGEST_HALF, SMALLEST_HALF};
use crate::splats::batches::frozen_floats;
use crate::splats::packed_sh::{PackedSh, nearest, value};

/// Both moments from a word.
fn from_halves(word: u32) -> [f32; 2] {
    [word & 0xffff_0000, word << 16].map(f32::from_bits)
}

/// Both moments after the step as on the device, without fused multiply-adds, and the random number of their rounding.
fn moments_after(step: u32, [p, g, m, v]: [f32; 4]) -> ([f32; 2], u32) {
    let g = clamp_gradient(g);
    let m = BETA1 as f32 * m + (1.0 - BETA1) as f32 * g;
    let v = BETA2 as f32 * v + (1.0 - BETA2) as f32 * g * g;
    let [m, v] = [m, v].map(|x: f32| if x.is_subnormal() { 0.0 } else { x });
    ([m, v], random_bits((p.to_bits() ^ v.to_bits()).wrapping_add(random_bits(step))))
}

/// Both moments in a word.
fn in_halves([m, v]: [f32; 2], chance: u32) -> u32 {
    let first = m.to_bits().wrapping_add(chance & 0xffff);
    let second = v.to_bits().wrapping_add(chance >> 16);
    first & 0xffff_0000 | second >> 16
}

/// The upper half of a number's bits.
fn bfloat(bits: u16) -> f64 {
    f32::from_bits(u32::from(bits) << 16).into()
}

fn half(bits: u16) -> f64 {
    value(bits).into()
}

/// Rounds to a multiple of the half's unit, up or down depending on `chance`; returns the bits of a half.
fn rounded_by_chance(x: f32, chance: u32) -> u16 {
    let (smallest, largest) = (SMALLEST_HALF as f32, LARGEST_HALF as f32);
    let exponent = x.to_bits() & 0x7f80_0000;
    let below = exponent < smallest.to_bits();
    let unit = if below { smallest } else { f32::from_bits(exponent - (10 << 23)) };
    let share = (chance >> 19) as f32 / 8192.0;
    // A multiple is a half, so rounding to nearest keeps it.
    nearest(((x / unit + share).floor() * unit).clamp(-largest, largest))
}

/// The largest distance of neighbouring numbers of `bits` after the binary point within `bound` of `x`; no number is
/// between 0 and the smallest.
fn unit((x, bound): (f64, f64), bits: i32, smallest: f64) -> f64 {
    let at =
        |x: f64| if x < smallest { smallest } else { (x.log2().floor() - f64::from(bits)).exp2() };
    at(x.abs() + bound).max(at(x.abs() - bound))
}

/// A number that a step updates.
struct Update {
    /// Its index among the words of the parameters.
    at: usize,
    /// The shift of a coefficient within its word.
    shift: Option<u32>,
    /// The index of its moments.
    moment: usize,
    plane: usize,
    value: f32,
    gradient: f32,
    /// Of the gradient.
    error: f64,
}

/// The Gaussians of a step.
struct Inputs<'a> {
    params: &'a Params,
    constants: &'a Constants,
    gradients: &'a [f32],
    camera: ReferenceCamera,
    planes: Planes,
    /// The coefficients as floats, Gaussian by Gaussian.
    floats: (Planes, Vec<f32>),
}

impl<'a> Inputs<'a> {
    fn new(params: &'a Params, constants: &'a Constants, slices: &Slices<'a>) -> Self {
        let Constants { sh_degree, feature_count, rest_by_column, half_rest, .. } = *constants;
        let planes =
            Planes::new(params.gaussian_count, 3 + feature_count, sh_degree, rest_by_column);
        let (by_gaussian, floats) = planes.floats(slices.parameters, half_rest);
        let camera = ReferenceCamera::from(&slices.cameras[params.camera_index as usize]);
        let floats = (by_gaussian, floats.into_owned());
        Self { params, constants, gradients: slices.gradients, camera, planes, floats }
    }

    /// The indices of a Gaussian's numbers in planes of this many columns.
    fn indices(&self, i: usize, columns: usize) -> Vec<usize> {
        let Planes { count, feature_count, rest_by_column, .. } = self.planes;
        Words { count, feature_count, columns, rest_by_column }.of_gaussian(i).collect()
    }

    fn columns(&self) -> usize {
        column_count(self.planes.feature_count, self.planes.sh_degree)
    }

    /// Columns before the coefficients above degree 0.
    fn before_rest(&self) -> usize {
        Attribute::Rest.column(self.planes.feature_count)
    }

    /// The layout of packed coefficients.
    fn packed(&self) -> PackedSh {
        let Planes { count: gaussians, feature_count: features, .. } = self.planes;
        PackedSh::new(PlaneCounts { gaussians, columns: self.columns(), features })
    }

    /// What the step updates.
    fn all(&self, slices: &Slices<'_>) -> Vec<Update> {
        let count = if slices.status[0] == 0 { self.planes.count } else { 0 };
        (0..count).flat_map(|i| self.updates(i)).collect()
    }

    /// The number and its moments before the step, and its rates.
    fn before(&self, update: &Update, slices: &Slices<'_>) -> ([f32; 4], [f32; 2]) {
        let [m, v] = match self.constants.half_moments {
            true => from_halves(slices.both_moments[update.moment]),
            false => [slices.first_moments[update.moment], slices.second_moments[update.moment]],
        };
        let rates = [self.params.rates[update.plane], self.params.second_correction];
        ([update.value, update.gradient, m, v], rates)
    }

    /// What the step updates in Gaussian `i`.
    fn updates(&self, i: usize) -> Vec<Update> {
        let Self { params, constants, planes: layout, .. } = self;
        let (before_rest, columns) = (self.before_rest(), self.columns());
        let left_out = frozen_floats(constants.frozen_columns, layout.count);
        let words = match constants.half_rest {
            true => self.indices(i, self.packed().columns()),
            false => self.indices(i, columns),
        };
        let (by_gaussian, floats) = &self.floats;
        let (values, moments) =
            (by_gaussian.indices(i).collect::<Vec<_>>(), self.indices(i, columns));
        let attributes = planes(layout.feature_count, columns);
        let written = self.indices(i, columns.min(before_rest + 3));
        let written = |column: usize| self.gradients[written[column] - left_out];
        let uses_rest = params.sh_degree > 0;
        let of_color = if uses_rest { self.of_color(i, written) } else { OfColor::default() };
        let update = |column: usize| {
            let plane = attributes.iter().rposition(|p| p.width > 0 && column >= p.column);
            let of_rest = column.checked_sub(before_rest);
            let packed = of_rest.filter(|_| constants.half_rest);
            let (gradient, error) = match of_rest {
                Some(k) => (of_color.rest[k], of_color.rest_errors[k]),
                None if column < 3 => of_color.moved(column, written(column)),
                None => (written(column).into(), 0.0),
            };
            Update {
                at: packed.map_or_else(|| words[column], |k| words[before_rest + k / 2]),
                shift: packed.map(|k| 16 * (k as u32 % 2)),
                moment: moments[column] - left_out,
                plane: plane.unwrap_or_default(),
                value: floats[values[column]],
                gradient: gradient as f32,
                error,
            }
        };
        let updated =
            constants.frozen_columns as usize..if uses_rest { columns } else { before_rest };
        updated.map(update).collect()
    }

    /// The gradients by that of the colour of Gaussian `i`.
    fn of_color(&self, i: usize, written: impl Fn(usize) -> f32) -> OfColor {
        let (by_gaussian, floats) = &self.floats;
        let gaussian = by_gaussian.load(floats, i);
        let first = self.before_rest();
        let d_color = [0, 1, 2].map(|c| f64::from(clamp_gradient(written(first + c))));
        let d_color = DVec3::from_array(d_color);
        let offset = gaussian.mean - self.camera.center();
        let degree = self.params.sh_degree;
        let (mean, sh) = sh_backward(degree, &gaussian.sh, offset, d_color);
        let distance = offset.length().max(1e-12);
        // The direction has the error of the difference.
        let far = 1.0 + (gaussian.mean.length() + self.camera.center().length()) / distance;
        // Derivatives of a basis function are below 8.
        let through: f64 = gaussian.sh.iter().skip(1).map(|c| c.abs().dot(d_color.abs())).sum();
        let used = (degree as usize + 1).pow(2) - 1;
        let errors = sh.iter().skip(1).enumerate().map(|(k, _)| {
            // Beyond the degree in use, the basis is zero.
            if k < used { 256.0 * UNIT * far * d_color.abs() } else { DVec3::ZERO }
        });
        OfColor {
            mean,
            mean_error: 2048.0 * UNIT * far * through / distance,
            rest_errors: errors.flat_map(|error| error.to_array()).collect(),
            rest: sh.iter().skip(1).flat_map(|gradient| gradient.to_array()).collect(),
        }
    }
}

/// The gradients of a Gaussian by that of its colour, through the coefficients above degree 0.
#[derive(Default)]
struct OfColor {
    /// Through the viewing direction.
    mean: DVec3,
    mean_error: f64,
    /// Of the coefficients.
    rest: Vec<f64>,
    rest_errors: Vec<f64>,
}

impl OfColor {
    /// The whole gradient of a coordinate of the mean, and its error.
    fn moved(&self, axis: usize, written: f32) -> (f64, f64) {
        let sum = f64::from(written) + self.mean[axis];
        let rounding = if self.mean_error > 0.0 { UNIT * sum.abs() } else { 0.0 };
        (sum, self.mean_error + rounding)
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let inputs = Inputs::new(params, constants, &slices);
        for update in inputs.all(&slices) {
            let (before, rates) = inputs.before(&update, &slices);
            let [p, m, v] = bounded(update.plane, stepped::<f64>(rates, before));
            let (moments, chance) = moments_after(params.step, before);
            let (word, moment) = (&mut slices.parameters[update.at], update.moment);
            *word = update.shift.map_or(p as f32, |shift| {
                let half = u32::from(rounded_by_chance(p as f32, chance));
                f32::from_bits(word.to_bits() & !(0xffff << shift) | half << shift)
            });
            if constants.half_moments {
                slices.both_moments[moment] = in_halves(moments, chance);
            } else {
                (slices.first_moments[moment], slices.second_moments[moment]) =
                    (m as f32, v as f32);
            }
        }
    }

    /// Twice the running error, since the reference rounds too, and the change by an error of the gradient. A number of
    /// 16 bits may be rounded the other way, since the random number depends on every bit; moments of an exact gradient
    /// are rounded equally everywhere.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let inputs = Inputs::new(params, constants, &slices);
        let halves = if constants.half_rest {
            inputs.planes.count * inputs.before_rest()
        } else {
            usize::MAX
        };
        let len = slices.parameters.len();
        let mut parameters = vec![0.0; len.min(halves)];
        let mut coefficients = vec![[0.0; 2]; len.saturating_sub(halves)];
        let [mut first, mut second] = [(); 2].map(|()| vec![0.0; slices.gradients.len()]);
        for update in inputs.all(&slices) {
            let (before, rates) = inputs.before(&update, &slices);
            let [p, m, v] = bounds(&update, before, rates);
            match update.shift {
                None => parameters[update.at] = p.1,
                Some(shift) => {
                    let unit = unit(p, 10, SMALLEST_HALF);
                    coefficients[update.at - halves][shift as usize / 16] = p.1 + unit;
                }
            }
            let moment = |(value, bound): (f64, f64)| match constants.half_moments {
                true if update.error == 0.0 => 0.0,
                true => bound + unit((value, bound), 7, f32::MIN_POSITIVE.into()),
                false => bound,
            };
            (first[update.moment], second[update.moment]) = (moment(m), moment(v));
        }
        let parameters =
            Tolerance::Packed { numbers: parameters, format: half, pairs: coefficients };
        if constants.half_moments {
            // The second moment is the lower half.
            let pairs = second.into_iter().zip(first).map(<[f64; 2]>::from).collect();
            let both_moments = Tolerance::Packed { numbers: vec![], format: bfloat, pairs };
            return Tolerances { parameters, both_moments, ..Tolerances::default() };
        }
        let [first_moments, second_moments] = [first, second].map(Tolerance::Each);
        Tolerances { parameters, first_moments, second_moments, ..Tolerances::default() }
    }
}

/// The number and both moments after the step in 32 bits, with the bounds of their errors.
fn bounds(update: &Update, before: [f32; 4], rates: [f32; 2]) -> [(f64, f64); 3] {
    let [p, gradient, m, v] = before;
    let rounded = bounded(update.plane, stepped::<Rounded>(rates, before));
    let of = |gradient: f64| stepped::<f64>(rates, [p, gradient as f32, m, v]);
    let expected = of(gradient.into());
    let moved = [-update.error, update.error].map(|by| of(f64::from(gradient) + by));
    [0, 1, 2].map(|which| {
        let change = |moved: [f64; 3]| (moved[which] - expected[which]).abs();
        let change = moved.map(change).into_iter().fold(0.0, f64::max);
        (rounded[which].value, 2.0 * rounded[which].error + change)
    })
}
