//! Where curves are compared.

/// Values of t from 0 on: dense, with the published ones, and beyond any photograph.
pub(crate) fn grid() -> Vec<f64> {
    let mut grid: Vec<f64> = (0..=20_000).map(|i| f64::from(i) / 4000.0).collect();
    grid.extend((-60..=32).map(|power| 10f64.powf(f64::from(power) / 4.0)));
    grid.extend([1e-12, 0.009_999, 0.01, 0.010_001, 65.0, 1e6, f64::INFINITY]);
    grid.sort_by(f64::total_cmp);
    grid
}
