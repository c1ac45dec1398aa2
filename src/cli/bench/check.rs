//! A kernel on given data: checked against its CPU reference, then timed.

use bytemuck::Pod;
use glam::{UVec2, Vec2, Vec3};

use super::Timing;
use crate::kernels::{
    ChannelStatistics, DepthGradient, DepthMoments, ProjectedSplat, RankSearch, ToneParameters,
    ToneStatistics,
};

/// How an output must agree with the reference's.
#[derive(Clone, Copy, Debug)]
pub(super) enum Rule {
    /// In every bit.
    Exact,
    /// Within this fraction of its magnitude, or of the mean magnitude of all; one value in a thousand may lie on the
    /// other side of a cutoff.
    Close(f64),
    /// As `Close`, but only the sum of all values: how it is parted is the device's choice.
    Sum(f64),
}
use Rule::{Close, Exact, Sum};

/// An element of a buffer, as numbers.
pub(super) trait Element: Pod {
    fn numbers(values: &[Self]) -> Vec<f64>;
}

macro_rules! elements {
    ($number:ty: $($element:ty),+) => {$(
        impl Element for $element {
            fn numbers(values: &[Self]) -> Vec<f64> {
                bytemuck::cast_slice(values).iter().map(|&x: &$number| f64::from(x)).collect()
            }
        }
    )+};
}
elements!(u32: u32, UVec2, [u32; 3], [u32; 4], RankSearch);
elements!(f32: f32, Vec2, Vec3, ProjectedSplat, ToneStatistics, ToneParameters);
elements!(f32: ChannelStatistics, DepthGradient, DepthMoments);

/// Runs a kernel and its reference on copies of the same host data, compares the outputs, times the kernel, and
/// gives the device's outputs as a tuple. Inputs and outputs are variables named as the kernel's buffers.
macro_rules! check {
    ($bench:ident, $timings:ident, $kernel:ident, $constants:expr, $params:expr, $threads:expr,
     [$($input:ident),*], [$($output:ident: $rule:expr),+]) => {{
        let (constants, params, threads) = ($constants, $params, $threads);
        let expected = {
            $(let mut $output = $output.clone();)+
            let slices = $kernel::Slices { $($input: &$input,)* $($output: &mut $output,)+ };
            <$kernel::Kernel as $crate::gpu::Reference>::run(&params, &constants, slices);
            [$($crate::cli::bench::check::Element::numbers(&$output)),+]
        };
        let pipeline = $bench.gpu.pipeline::<$kernel::Kernel>(&constants)?;
        $(let $input = $bench.gpu.buffer(stringify!($input), &$input)?;)*
        $(let mut $output = $bench.gpu.buffer(stringify!($output), &$output)?;)+
        macro_rules! dispatch {
            () => {
                $bench.gpu.profile(stringify!($kernel), |pass| {
                    let buffers =
                        $kernel::Buffers { $($input: &$input,)* $($output: &mut $output,)+ };
                    pass.dispatch(&pipeline, &params, buffers, threads)
                })
            };
        }
        dispatch!()?;
        let outputs = ($($bench.gpu.read(&$output)?,)+);
        let actual = {
            let ($($output,)+) = &outputs;
            [$($crate::cli::bench::check::Element::numbers($output)),+]
        };
        for (i, rule) in [$($rule),+].into_iter().enumerate() {
            let name = [$(stringify!($output)),+][i];
            $crate::cli::bench::check::agree(stringify!($kernel), name, rule, &actual[i], &expected[i])?;
        }
        let milliseconds = $bench.median(|| Ok($crate::cli::bench::total(&dispatch!()?)))?;
        $crate::cli::bench::check::push($timings, stringify!($kernel), milliseconds);
        outputs
    }};
}
pub(super) use check;

/// A kernel that is used more than once is listed once.
pub(super) fn push(timings: &mut Vec<Timing>, name: &'static str, milliseconds: f64) {
    if timings.iter().all(|timing| timing.name != name) {
        timings.push(Timing { name, milliseconds, bound: None });
    }
}

/// # Errors
/// The values disagree, in one line with the worst.
pub(super) fn agree(
    kernel: &str,
    buffer: &str,
    rule: Rule,
    actual: &[f64],
    expected: &[f64],
) -> anyhow::Result<()> {
    let (tolerance, allowed) = match rule {
        Exact => (0.0, 0),
        Close(tolerance) => (tolerance, expected.len() / 1000),
        Sum(tolerance) => {
            let sum = |values: &[f64]| [values.iter().sum::<f64>()];
            return agree(kernel, buffer, Close(tolerance), &sum(actual), &sum(expected));
        }
    };
    let mean = expected.iter().map(|e| e.abs()).sum::<f64>() / expected.len().max(1) as f64;
    // Positive phrasing: a NaN disagrees.
    let is_close = |&(a, e): &(&f64, &f64)| (a - e).abs() <= tolerance * (e.abs() + mean);
    let wrong: Vec<_> = actual.iter().zip(expected).filter(|pair| !is_close(pair)).collect();
    if wrong.len() <= allowed && actual.len() == expected.len() {
        return Ok(());
    }
    let (a, e) = wrong.first().copied().unwrap_or((&0.0, &0.0));
    anyhow::bail!(
        "{kernel} disagrees with its CPU reference: {} of {} values of `{buffer}`, the first is {a} instead of {e}; \
         update the driver or report this with the output of `nightsplat doctor`",
        wrong.len(),
        expected.len()
    )
}

#[cfg(test)]
mod tests {
    use super::Rule::{Close, Exact, Sum};
    use super::agree;

    #[test]
    fn one_value_in_a_thousand_may_be_off_but_not_two_nor_any_where_bits_count() {
        let expected = vec![1.0; 1000];
        let with = |wrong: &[f64]| {
            let mut actual = expected.clone();
            actual[..wrong.len()].copy_from_slice(wrong);
            actual
        };
        let passes = |rule, wrong: &[f64]| agree("k", "b", rule, &with(wrong), &expected).is_ok();
        assert!(passes(Close(1e-3), &[1.001, 0.999, 2.0]));
        assert!(!passes(Close(1e-3), &[2.0, f64::NAN]));
        assert!(passes(Exact, &[]) && !passes(Exact, &[1.0 + 1e-12]));
        assert!(passes(Sum(1e-3), &[2.0, 0.0]) && !passes(Sum(1e-3), &[f64::NAN]));
        assert!(agree("k", "b", Close(1.0), &expected[..999], &expected).is_err());
    }
}
