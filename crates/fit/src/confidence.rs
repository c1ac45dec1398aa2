//! Standard errors of the fitted constants.

use nalgebra::{DMatrix, SymmetricEigen};

use super::model::FitModel;
use super::solve::{Group, Solution};
use super::{Estimate, Residuals};

/// A constant within this share of its range from a bound counts as at the bound.
const AT_BOUND: f64 = 1e-5;

/// Below this ratio of the smallest to the largest eigenvalue of the inverse correlations, constants are not determined
/// separately.
const SINGULAR: f64 = 1e-9;

pub(super) struct Confidence {
    pub(super) estimates: Vec<Estimate>,
    pub(super) effective_values: f64,
}

pub(super) fn estimate(
    model: &FitModel,
    groups: &[Group],
    solution: &Solution,
    residuals: &Residuals,
) -> Confidence {
    let values = &solution.values;
    let at_bound: Vec<bool> = model
        .free
        .iter()
        .zip(values)
        .map(|(constant, value)| {
            let [low, high] = constant.bounds;
            (value - low).min(high - value) <= AT_BOUND * (high - low)
        })
        .collect();
    let inner: Vec<usize> = (0..values.len()).filter(|&index| !at_bound[index]).collect();

    // Sums of psi squared, of psi', and of the products of gradients.
    let limit = solution.delta.unwrap_or(f64::INFINITY);
    let [mut psi2, mut slope] = [0.0; 2];
    let mut normal = DMatrix::<f64>::zeros(inner.len(), inner.len());
    for group in groups {
        let curve = model.curve(values, &group.exposure);
        let slopes = model.slopes(values, &group.exposure);
        for column in &group.histogram.columns {
            let y = curve.at(column.x);
            for cell in &column.cells {
                let size = (cell.y() - y).abs();
                psi2 += cell.count() * size.min(limit).powi(2);
                slope += if size <= limit { cell.count() } else { 0.0 };
            }
            let gradient: Vec<f64> = slopes.at(column.x).collect();
            for (row, &i) in inner.iter().enumerate() {
                for (at, &j) in inner.iter().enumerate() {
                    normal[(row, at)] += column.count * gradient[i] * gradient[j];
                }
            }
        }
    }
    let count = residuals.count;
    let effective_values = effective_values(residuals);
    let variance = (psi2 / count) / (slope / count).powi(2).max(f64::MIN_POSITIVE)
        * (count / effective_values);
    let errors = diagonal_of_inverse(&normal)
        .map(|diagonal| diagonal.into_iter().map(move |d| (variance * d).sqrt()));
    let mut standard_errors = vec![None; values.len()];
    for (&index, error) in inner.iter().zip(errors.into_iter().flatten()) {
        standard_errors[index] = Some(error).filter(|error| error.is_finite());
    }
    let estimate = |index: usize| Estimate {
        name: model.free[index].name.clone(),
        value: values[index],
        standard_error: standard_errors[index],
        at_bound: at_bound[index],
    };
    Confidence { estimates: (0..values.len()).map(estimate).collect(), effective_values }
}

/// N / (1 + (m - 1) rho), with rho the intraclass correlation of the residuals from a one-way analysis of variance.
fn effective_values(residuals: &Residuals) -> f64 {
    let Residuals { count, weighted_squares: squares, means, .. } = residuals;
    let photographs = means.len() as f64;
    if means.len() < 2 {
        return *count;
    }
    let mean = means.iter().map(|(n, mean)| n * mean).sum::<f64>() / count;
    let between_sum: f64 = means.iter().map(|(n, m)| n * (m - mean).powi(2)).sum();
    let within =
        (squares - count * mean * mean - between_sum).max(0.0) / (count - photographs).max(1.0);
    let size = count / photographs;
    let between = ((between_sum / (photographs - 1.0) - within) / size).max(0.0);
    let rho = if between > 0.0 { between / (between + within) } else { 0.0 };
    count / (1.0 + (size - 1.0) * rho)
}

/// The diagonal of the inverse of a normal matrix; `None` if it is singular.
fn diagonal_of_inverse(normal: &DMatrix<f64>) -> Option<Vec<f64>> {
    let size = normal.nrows();
    let scale: Vec<f64> = (0..size).map(|i| normal[(i, i)].sqrt()).collect();
    if size == 0 || scale.iter().any(|&scale| !(scale > 0.0 && scale.is_finite())) {
        return None;
    }
    let correlations = DMatrix::from_fn(size, size, |i, j| normal[(i, j)] / (scale[i] * scale[j]));
    let SymmetricEigen { eigenvectors, eigenvalues } = SymmetricEigen::new(correlations);
    if eigenvalues.min() < SINGULAR * eigenvalues.max() {
        return None;
    }
    let diagonal = |i: usize| {
        (0..size).map(|k| eigenvectors[(i, k)].powi(2) / eigenvalues[k]).sum::<f64>()
            / scale[i].powi(2)
    };
    Some((0..size).map(diagonal).collect())
}
