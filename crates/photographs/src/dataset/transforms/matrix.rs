//! `transform_matrix` as exporters write it: transposed, scaled or rounded ones are corrected, left-handed ones are
//! refused.

use glam::{DAffine3, DMat3, DVec3};
use serde::{Deserialize, Deserializer};

/// Rows as listed; `None` represents NaN.
pub(super) type Rows = Vec<Vec<Option<f64>>>;

/// Rows, or the same numbers in a flat list.
pub(super) fn rows<'de, D: Deserializer<'de>>(matrix: D) -> Result<Rows, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum MatrixValues {
        Rows(Rows),
        Flat(Vec<Option<f64>>),
    }
    Ok(match MatrixValues::deserialize(matrix)? {
        MatrixValues::Rows(rows) => rows,
        MatrixValues::Flat(numbers) => numbers.chunks(4).map(<[_]>::to_vec).collect(),
    })
}

/// A pose, and the corrections of its matrix.
#[derive(Debug)]
pub(super) struct Pose {
    /// World to view, `OpenCV` axes.
    pub(super) view_from_world: DAffine3,
    /// The divisor of its columns; 1 if they have length 1 except for rounding.
    pub(super) scale: f64,
    /// Whether the matrix was replaced by the nearest rotation because it is rounded.
    pub(super) is_rounded: bool,
}

/// Maximum difference between the lengths of columns, and from 1 to be a rounding.
const LENGTH_TOLERANCE: f64 = 0.02;
/// Maximum difference of `R^T R` from the identity, per entry: two decimals are off by 0.02.
const ROTATION_TOLERANCE: f64 = 0.05;
/// A larger difference is not explained by single precision.
const IS_ROUNDED: f64 = 2e-4;
/// With a smaller difference, the matrix is used unchanged.
const IS_EXACT: f64 = 1e-5;

/// Whether a listing writes columns instead of rows: some frame has its translation in the last row, and none in the
/// last column.
pub(super) fn are_transposed<'a>(matrices: impl Iterator<Item = &'a Rows> + Clone) -> bool {
    let moves = |at: fn(&Rows, usize) -> Option<f64>| {
        let mut matrices = matrices.clone();
        matrices.any(|rows| (0..3).any(|axis| at(rows, axis).is_some_and(|value| value != 0.0)))
    };
    let is_square = |rows: &Rows| rows.len() == 4 && rows.iter().all(|row| row.len() == 4);
    matrices.clone().all(is_square)
        && moves(|rows, axis| rows[3][axis])
        && !moves(|rows, axis| rows[axis][3])
}

/// The pose of a camera from view to world in OpenGL axes, as 4x4 or 3x4 rows.
pub(super) fn pose(rows: &Rows, is_transposed: bool) -> Result<Pose, &'static str> {
    let world_from_gl = affine(rows, is_transposed)
        .filter(DAffine3::is_finite)
        .ok_or("is no finite rotation and translation")?;
    let DAffine3 { matrix3: matrix, translation } = world_from_gl;
    let lengths = [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(DVec3::length);
    let mean = lengths.iter().sum::<f64>() / 3.0;
    // A positive condition: it is false for NaN.
    let is_uniform =
        lengths.iter().all(|length| (length - mean).abs() <= LENGTH_TOLERANCE * mean) && mean > 0.0;
    if !is_uniform {
        return Err("is no rotation: its columns differ in length");
    }
    let scale = if (mean - 1.0).abs() > LENGTH_TOLERANCE { mean } else { 1.0 };
    let matrix = if scale == 1.0 { matrix } else { matrix * (1.0 / scale) };
    let off = (matrix.transpose() * matrix - DMat3::IDENTITY).to_cols_array();
    let off = off.iter().fold(0.0_f64, |worst, entry| worst.max(entry.abs()));
    if off > ROTATION_TOLERANCE {
        return Err("is no rotation: its columns are not perpendicular");
    }
    if matrix.determinant() < 0.0 {
        return Err("is left-handed (determinant -1, as engines of left-handed axes write it)");
    }
    let rotation = if off > IS_EXACT { nearest_rotation(matrix) } else { matrix };
    let world_from_gl = DAffine3 { matrix3: rotation, translation };
    let opencv_from_gl = DAffine3::from_scale(DVec3::new(1.0, -1.0, -1.0));
    let view_from_world = opencv_from_gl * world_from_gl.inverse();
    Ok(Pose { view_from_world, scale, is_rounded: off > IS_ROUNDED })
}

/// The transform of 4x4 or 3x4 rows.
pub(super) fn affine(rows: &Rows, is_transposed: bool) -> Option<DAffine3> {
    let row = |index: usize| -> Option<[f64; 4]> {
        let entry = |other: usize| {
            let (row, column) = if is_transposed { (other, index) } else { (index, other) };
            *rows.get(row)?.get(column)?
        };
        let is_complete = is_transposed || rows.get(index)?.len() == 4;
        is_complete.then_some([entry(0)?, entry(1)?, entry(2)?, entry(3)?])
    };
    let [x, y, z] = [row(0)?, row(1)?, row(2)?];
    let matrix3 =
        DMat3::from_cols_array(&[x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]]).transpose();
    Some(DAffine3 { matrix3, translation: DVec3::new(x[3], y[3], z[3]) })
}

/// The orthogonal factor of the polar decomposition, by Newton's iteration (Higham 1986): the nearest rotation.
fn nearest_rotation(mut matrix: DMat3) -> DMat3 {
    for _ in 0..10 {
        matrix = (matrix + matrix.inverse().transpose()) * 0.5;
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(matrix: DMat3, translation: DVec3) -> Rows {
        let row = |row: usize| {
            let [x, y, z] = matrix.row(row).to_array();
            [x, y, z, translation[row]].map(Some).to_vec()
        };
        vec![row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0].map(Some).to_vec()]
    }

    fn turned() -> DMat3 {
        DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -1.0).normalize(), 1.1)
    }

    const AT: DVec3 = DVec3::new(0.5, -2.0, 3.0);

    #[test]
    fn a_matrix_that_is_not_a_rotation_is_named() {
        let problem = |matrix: DMat3| pose(&rows(matrix, AT), false).unwrap_err();
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        assert!(problem(mirror * turned()).contains("left-handed"));
        let stretched = DMat3::from_diagonal(DVec3::new(1.0, 2.0, 1.0));
        assert!(problem(turned() * stretched).contains("differ in length"));
        assert!(problem(DMat3::ZERO).contains("differ in length"));
        let sheared = DMat3::from_cols(DVec3::X, DVec3::new(0.6, 0.8, 0.0), DVec3::Z);
        assert!(problem(sheared).contains("not perpendicular"));
        assert!(problem(DMat3::from_cols(DVec3::NAN, DVec3::Y, DVec3::Z)).contains("no finite"));
        assert!(pose(&vec![vec![Some(1.0); 4]; 2], false).is_err());
    }

    #[test]
    fn columns_as_rows_are_detected_even_if_one_camera_is_at_the_origin() {
        let transposed = |rows: &Rows| -> Rows {
            (0..4).map(|column| rows.iter().map(|row| row[column]).collect()).collect()
        };
        let written = [rows(turned(), AT), rows(turned(), DVec3::ZERO)];
        let columns = written.each_ref().map(transposed);
        assert!(are_transposed(columns.iter()) && !are_transposed(written.iter()));
        let exact = pose(&written[0], false).unwrap().view_from_world;
        assert!(pose(&columns[0], true).unwrap().view_from_world.abs_diff_eq(exact, 1e-12));
        // Three rows have no last row, and cameras at one position are ambiguous.
        assert!(!are_transposed([written[0][..3].to_vec()].iter()));
        assert!(!are_transposed([rows(turned(), DVec3::ZERO)].iter()));
    }
}
