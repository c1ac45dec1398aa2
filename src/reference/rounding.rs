//! Rounding error in single precision: numbers with an error bound, from the bounds of each operation in the Vulkan
//! specification ("Precision of core SPIR-V instructions"). Fused multiply-adds round once less.

use std::cmp::Ordering;
use std::ops::{Add, Div, Mul, Neg, Sub};

use bytemuck::Pod;
use nightsplat_photographs::tone::{Real, curve_at, mirrored};

use crate::gpu::Tolerance;
use crate::kernels::ToneParameters;

/// The relative error of one rounding; half a unit in the last place (ulp).
pub const UNIT: f64 = f32::EPSILON as f64 / 2.0;

/// The largest absolute error of a sine or cosine.
pub(super) const TRIGONOMETRIC: f64 = 1.0 / 2048.0;

/// The most roundings of one term while a subgroup sums `count`: within a lane, then across the 4 to 128 lanes.
pub(super) fn chain(count: usize) -> f64 {
    count as f64 / 4.0 + 128.0
}

/// First-order forward error of `f`, given the errors of its inputs.
pub(super) fn sensitivity(
    inputs: &[f64],
    errors: &[f64],
    f: impl Fn(&[f64]) -> Vec<f64>,
) -> Vec<f64> {
    let (exact, mut moved) = (f(inputs), inputs.to_vec());
    let mut bounds = vec![0.0; exact.len()];
    for at in 0..inputs.len() {
        moved[at] += errors[at];
        let changes = f(&moved).into_iter().zip(&exact).map(|(moved, exact)| (moved - exact).abs());
        bounds.iter_mut().zip(changes).for_each(|(bound, change)| *bound += change);
        moved[at] = inputs[at];
    }
    bounds
}

/// A number with the bound of its error in single precision: running error analysis (Higham 2002, section 3.3).
#[derive(Clone, Copy, Debug, Default)]
pub struct Rounded {
    /// The number itself.
    pub value: f64,
    /// The bound of the error.
    pub error: f64,
}

impl Rounded {
    /// A number in single precision.
    pub fn exact(value: f32) -> Self {
        Self { value: value.into(), error: 0.0 }
    }

    /// Numbers in single precision.
    pub(super) fn all(values: &[f32]) -> Vec<Self> {
        values.iter().copied().map(Self::exact).collect()
    }

    /// After `count` more roundings. A subnormal result may be flushed to zero: NVIDIA's devices do.
    pub(super) fn rounded(self, count: f64) -> Self {
        let magnitude = self.value.abs();
        let flushed = if magnitude < f64::from(f32::MIN_POSITIVE) { magnitude } else { 0.0 };
        Self { error: self.error + flushed + count * UNIT * (magnitude + self.error), ..self }
    }

    /// The same value, with the error of an argument magnified by `slope`.
    fn from_argument(value: f64, argument: f64, slope: f64) -> Self {
        let error = if argument == 0.0 { 0.0 } else { argument * slope };
        Self { value, error }
    }

    /// A sum in any order in which a term takes part in at most `chain` additions.
    pub(super) fn sum(chain: f64, terms: impl IntoIterator<Item = Self>) -> Self {
        let (mut sum, mut magnitude) = (Self::default(), 0.0);
        for term in terms {
            sum.value += term.value;
            sum.error += term.error;
            magnitude += term.value.abs() + term.error;
        }
        Self { error: sum.error + chain * UNIT * magnitude, ..sum }
    }

    pub(super) fn abs(self) -> Self {
        Self { value: self.value.abs(), ..self }
    }

    /// The greater or the lesser of both, as `choose` selects.
    fn between(self, choose: impl Fn(f64, f64) -> f64, other: Self) -> Self {
        let value = choose(self.value, other.value);
        let high = choose(self.value + self.error, other.value + other.error);
        let low = choose(self.value - self.error, other.value - other.error);
        Self { value, error: (high - value).max(value - low) }
    }

    /// Whether `limit` is within a rounding.
    pub(super) fn may_cross(self, limit: f64) -> bool {
        (self.value - limit).abs() <= self.error
    }

    /// The error of a reference in double precision that is rounded at its end.
    pub(super) fn bound(self) -> f64 {
        self.error + UNIT * self.value.abs()
    }
}

/// The pseudo-GT value of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`).
pub(super) fn rounded_tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> Rounded {
    let [x, white, offset, gain] = [x, tone.white, tone.offset, tone.gain].map(Rounded::exact);
    let constants = tone.constants.map(Rounded::exact);
    mirrored(x, |x| {
        let y = curve_at(curve, x / white, [offset, gain], &constants);
        y.at_least(Rounded::from_f64(0.0)).at_most(Rounded::from_f64(1.0))
    })
}

/// Writes the values to the start of a buffer of floats or of groups of floats.
pub(super) fn write<T: Pod>(numbers: impl IntoIterator<Item = Rounded>, to: &mut [T]) {
    let to: &mut [f32] = bytemuck::cast_slice_mut(to);
    to.iter_mut().zip(numbers).for_each(|(to, number)| *to = number.value as f32);
}

/// The tolerance of a buffer that these numbers are written to from index `first` on.
pub(super) fn bounds_from(first: usize, numbers: impl IntoIterator<Item = Rounded>) -> Tolerance {
    std::iter::repeat_n(0.0, first).chain(numbers.into_iter().map(Rounded::bound)).collect()
}

/// Writes a whole sum into the first partial: the device chooses the number of partials.
pub(super) fn write_sum(terms: impl Iterator<Item = f64>, partials: &mut [f32]) {
    partials.fill(0.0);
    partials[0] = terms.sum::<f64>() as f32;
}

/// The tolerance of partial sums in which a term takes part in at most `chain` additions.
pub(super) fn sum_tolerance(chain: f64, terms: impl IntoIterator<Item = Rounded>) -> Tolerance {
    Tolerance::Sum(Rounded::sum(chain, terms).bound())
}

/// The reference of a kernel, from a function that returns the numbers of each buffer that it writes.
macro_rules! bounded_reference {
    ($numbers:ident: $($buffer:ident),+) => {
        impl crate::gpu::Reference for Kernel {
            fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
                let [$($buffer),+] = $numbers(params, constants, &slices);
                $(crate::reference::rounding::write($buffer, slices.$buffer);)+
            }

            fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
                let [$($buffer),+] = $numbers(params, constants, &slices);
                Tolerances { $($buffer: $buffer.into_iter().collect()),+ }
            }
        }
    };
}
pub(super) use bounded_reference;

/// A bound for each element of a buffer.
impl FromIterator<f64> for Tolerance {
    fn from_iter<I: IntoIterator<Item = f64>>(bounds: I) -> Self {
        Self::Each(bounds.into_iter().collect())
    }
}

/// A bound for each element of a buffer, from a reference in double precision.
impl FromIterator<Rounded> for Tolerance {
    fn from_iter<I: IntoIterator<Item = Rounded>>(numbers: I) -> Self {
        numbers.into_iter().map(Rounded::bound).collect()
    }
}

impl PartialEq for Rounded {
    fn eq(&self, other: &Self) -> bool {
        self.value == other.value
    }
}

impl PartialOrd for Rounded {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        self.value.partial_cmp(&other.value)
    }
}

impl Add for Rounded {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { value: self.value + other.value, error: self.error + other.error }.rounded(1.0)
    }
}

impl Sub for Rounded {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

impl Mul for Rounded {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        let error = self.value.abs() * other.error + (other.value.abs() + other.error) * self.error;
        Self { value: self.value * other.value, error }.rounded(1.0)
    }
}

impl Div for Rounded {
    type Output = Self;
    /// 2.5 ulp.
    fn div(self, other: Self) -> Self {
        let value = self.value / other.value;
        let least = other.value.abs() - other.error;
        let error = match self.error + value.abs() * other.error {
            0.0 => 0.0,
            error if least > 0.0 => error / least,
            _ => f64::INFINITY,
        };
        Self { value, error }.rounded(5.0)
    }
}

impl Neg for Rounded {
    type Output = Self;
    fn neg(self) -> Self {
        Self { value: -self.value, ..self }
    }
}

/// A value that a condition can select.
pub trait Gated: Real {
    /// The value itself if `y` is above 0, else 0.
    fn where_positive(self, y: Self) -> Self;
}

impl Gated for f64 {
    fn where_positive(self, y: Self) -> Self {
        if y > 0.0 { self } else { 0.0 }
    }
}

impl Gated for Rounded {
    fn where_positive(self, y: Self) -> Self {
        let passed = if y.value > 0.0 { self.value } else { 0.0 };
        let either = if y.may_cross(0.0) { self.value.abs() } else { 0.0 };
        Self { value: passed, error: self.error + either }
    }
}

impl Real for Rounded {
    fn from_f64(x: f64) -> Self {
        Self { value: x, error: (f64::from(x as f32) - x).abs() }
    }

    /// 3 + 2 |x| ulp.
    fn exp(self) -> Self {
        let value = self.value.exp();
        let argument = Self::from_argument(value, self.error.exp_m1(), value);
        argument.rounded(6.0 + 4.0 * (self.value.abs() + self.error))
    }

    /// A series if x is small, else 1 - exp(-x).
    fn one_minus_exp(self) -> Self {
        let value = -(-self.value).exp_m1();
        let slope = (self.error - self.value).exp();
        let argument = Self::from_argument(value, self.error, slope);
        if self.value < 0.01 {
            return argument.rounded(6.0);
        }
        let exponential = UNIT * (6.0 + 4.0 * self.value.abs()) * (-self.value).exp();
        Self { error: argument.error + exponential, ..argument }.rounded(1.0)
    }

    /// ln x: three ulp, or 2^-21 between a half and two.
    fn ln(self) -> Self {
        let (low, value) = (self.value - self.error, self.value.ln());
        let is_near_one = (0.5..=2.0).contains(&self.value);
        let logarithm = if is_near_one { 1.0 / 2_097_152.0 } else { 6.0 * UNIT * value.abs() };
        let argument = if self.error == 0.0 { 0.0 } else { (self.value / low.max(0.0)).ln() };
        Self { value, error: logarithm + argument }
    }

    /// A series if x is small, else ln(1 + x).
    fn ln_1p(self) -> Self {
        if self.value < 0.01 {
            let argument = Self::from_argument(self.value.ln_1p(), self.error, 1.0);
            return argument.rounded(8.0);
        }
        (Self::from_f64(1.0) + self).ln()
    }

    /// exp2(p log2(x)).
    fn power(self, p: Self) -> Self {
        if self.value > 0.0 {
            let exponent = p * self.ln();
            let value = exponent.value.exp();
            let argument = Self::from_argument(value, exponent.error.exp_m1(), value);
            argument.rounded(6.0 + 6.0 * (exponent.value.abs() + exponent.error))
        } else {
            Self::default()
        }
    }

    /// The inverse of an inverse square root of two ulp.
    fn sqrt(self) -> Self {
        let value = self.value.sqrt();
        let argument = match self.error {
            0.0 => 0.0,
            error => error / (value + (self.value - error).max(0.0).sqrt()),
        };
        Self { value, error: argument }.rounded(9.0)
    }

    fn at_least(self, low: Self) -> Self {
        self.between(|x, low| if x > low { x } else { low }, low)
    }

    fn at_most(self, high: Self) -> Self {
        self.between(|x, high| if x < high { x } else { high }, high)
    }

    /// Three halvings of the angle, each a square root and a division, then a series.
    fn atan(self) -> Self {
        Self::from_argument(self.value.atan(), self.error, 1.0).rounded(60.0)
    }
}

#[cfg(test)]
mod tests {
    use super::{Rounded, UNIT};
    use nightsplat_core::random::Stream;
    use nightsplat_photographs::tone::Real;

    /// A formula with every operation, in any number type.
    fn formula<T: Real>(x: T, y: T) -> T {
        let root = (x * x + y * y).sqrt();
        (x - y) / (T::from_f64(0.3) + root) + (-root).exp() * root.one_minus_exp()
            - x.power(y).ln_1p()
    }

    #[test]
    fn single_precision_stays_within_a_tight_bound() {
        let stream = Stream::new(1, 2);
        let (mut largest, mut loosest) = (0.0_f64, 0.0_f64);
        for i in 0..10_000 {
            let [x, y] = [2 * i, 2 * i + 1].map(|at| 3.0 * stream.uniform(at) as f32);
            let bound = formula(Rounded::exact(x), Rounded::exact(y));
            let error = (f64::from(formula(x, y)) - bound.value).abs();
            assert!(error <= bound.error, "{x} {y}: {error} {bound:?}");
            largest = largest.max(error / bound.error);
            loosest = loosest.max(bound.error / UNIT);
        }
        assert!(largest > 0.02 && loosest < 1e3, "{largest} {loosest}");
    }

    #[test]
    fn a_subnormal_number_may_be_zero() {
        let x = Rounded::exact(1e-20);
        assert!((x * x).error >= (x * x).value && (x * x).value > 0.0);
        let root = (x * x).sqrt();
        assert!(root.error >= root.value);
        assert!((x * Rounded::exact(1e10)).error < 1e-16);
    }
}
