//! The number types of the curves' formulas: f32 as in the shaders, f64 as the reference, and dual numbers, whose
//! derivatives are exact.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// t is clamped to this: powers stay finite, and every curve is within an ulp of white or of its limit.
pub const LARGEST_T: f64 = 1e7;

/// The functions that the formulas of the curves require.
pub trait Real:
    Copy
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// The number nearest to `x`; its derivative is 0.
    fn from_f64(x: f64) -> Self;
    /// e^x.
    fn exp(self) -> Self;
    /// 1 - e^-x without cancellation.
    fn one_minus_exp(self) -> Self;
    /// The natural logarithm.
    fn ln(self) -> Self;
    /// ln(1 + x) without cancellation.
    fn ln_1p(self) -> Self;
    /// x^p for x > 0; 0 otherwise.
    fn power(self, p: Self) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// The arc tangent.
    fn atan(self) -> Self;

    /// The hyperbolic tangent, for x >= 0.
    fn tanh(self) -> Self {
        let q = (Self::from_f64(2.0) * self).one_minus_exp();
        q / (Self::from_f64(2.0) - q)
    }

    /// The greater of both.
    fn at_least(self, low: Self) -> Self {
        if self > low { self } else { low }
    }

    /// The lesser of both.
    fn at_most(self, high: Self) -> Self {
        if self < high { self } else { high }
    }
}

/// The functions of the primitive floats.
macro_rules! standard_functions {
    () => {
        fn exp(self) -> Self {
            self.exp()
        }
        fn ln(self) -> Self {
            self.ln()
        }
        fn ln_1p(self) -> Self {
            self.ln_1p()
        }
        fn power(self, p: Self) -> Self {
            if self > 0.0 { self.powf(p) } else { 0.0 }
        }
        fn sqrt(self) -> Self {
            self.sqrt()
        }
        fn atan(self) -> Self {
            self.atan()
        }
    };
}

impl Real for f32 {
    fn from_f64(x: f64) -> Self {
        x as Self
    }
    /// As in the shader.
    fn one_minus_exp(self) -> Self {
        if self < 0.01 {
            self * (1.0 - self * (0.5 - self * (1.0 / 6.0)))
        } else {
            1.0 - (-self).exp()
        }
    }
    standard_functions!();
}

impl Real for f64 {
    fn from_f64(x: f64) -> Self {
        x
    }
    fn one_minus_exp(self) -> Self {
        -(-self).exp_m1()
    }
    standard_functions!();
}

/// A value with its derivative with respect to one variable.
#[derive(Clone, Copy, Debug)]
pub struct Dual {
    /// The value.
    pub value: f64,
    /// Its derivative.
    pub derivative: f64,
}

impl Dual {
    /// The variable itself.
    pub fn variable(value: f64) -> Self {
        Self { value, derivative: 1.0 }
    }

    /// f(x), given f and f' at the value.
    fn chain(self, value: f64, slope: f64) -> Self {
        Self { value, derivative: slope * self.derivative }
    }
}

impl PartialEq for Dual {
    fn eq(&self, other: &Self) -> bool {
        self.value == other.value
    }
}

impl PartialOrd for Dual {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        self.value.partial_cmp(&other.value)
    }
}

impl Add for Dual {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { value: self.value + other.value, derivative: self.derivative + other.derivative }
    }
}

impl Sub for Dual {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self { value: self.value - other.value, derivative: self.derivative - other.derivative }
    }
}

impl Mul for Dual {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        let derivative = self.derivative * other.value + self.value * other.derivative;
        Self { value: self.value * other.value, derivative }
    }
}

impl Div for Dual {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        let value = self.value / other.value;
        Self { value, derivative: (self.derivative - value * other.derivative) / other.value }
    }
}

impl Neg for Dual {
    type Output = Self;
    fn neg(self) -> Self {
        Self { value: -self.value, derivative: -self.derivative }
    }
}

impl Real for Dual {
    fn from_f64(value: f64) -> Self {
        Self { value, derivative: 0.0 }
    }
    fn exp(self) -> Self {
        self.chain(self.value.exp(), self.value.exp())
    }
    fn one_minus_exp(self) -> Self {
        self.chain(self.value.one_minus_exp(), (-self.value).exp())
    }
    fn ln(self) -> Self {
        self.chain(self.value.ln(), 1.0 / self.value)
    }
    fn ln_1p(self) -> Self {
        self.chain(self.value.ln_1p(), 1.0 / (1.0 + self.value))
    }
    fn power(self, p: Self) -> Self {
        if self.value > 0.0 {
            let value = self.value.powf(p.value);
            let relative = p.value * self.derivative / self.value + self.value.ln() * p.derivative;
            Self { value, derivative: value * relative }
        } else {
            Self::from_f64(0.0)
        }
    }
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.chain(root, 0.5 / root)
    }
    fn atan(self) -> Self {
        self.chain(self.value.atan(), 1.0 / (1.0 + self.value * self.value))
    }
}

/// Clamps to (0, [`LARGEST_T`]); a NaN counts as black.
pub fn within<T: Real>(t: T) -> T {
    if t > T::from_f64(0.0) { t.at_most(T::from_f64(LARGEST_T)) } else { T::from_f64(0.0) }
}

#[cfg(test)]
mod tests {
    use super::Real;

    /// The difference from 1 would have a relative error of a thousandth for small arguments.
    #[test]
    fn one_minus_exp_has_few_roundings_for_small_arguments_too() {
        for i in 0..4000 {
            let x = 1e-8 * 1.006_f32.powi(i);
            let (single, double) = (x.one_minus_exp(), f64::from(x).one_minus_exp());
            let bound = if x < 0.01 { 2e-7 } else { 1e-5 };
            assert!((f64::from(single) / double - 1.0).abs() < bound, "{x}: {single} {double}");
        }
    }
}
