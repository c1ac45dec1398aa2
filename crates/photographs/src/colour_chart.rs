//! Colours of a photographed chart of 24 patches: where the patches are, and the matrix that brings their colours
//! nearest to the published ones.
//!
//! ```text
//! M = argmin sum_p |M b_p - n_p|^2 + lambda |M - I|^2,   M (1, 1, 1) = (1, 1, 1)
//! ```
//!
//! b: linear light of a patch after the gains that make its greys neutral, at the exposure of the greys; n: its
//! published colour. Dark photographs lose chroma, and small patches lose more than walls, so a matrix that fits the
//! chart best overshoots elsewhere. lambda is therefore the largest whose error on patches left out is within a
//! standard error of the smallest (the one-standard-error rule of cross-validation; Breiman et al. 1984, 3.4.3).

use glam::{DMat2, DMat3, DVec2, DVec3};

use super::image::linear_from_srgb;

/// Weights of a luminance of linear sRGB.
pub(super) const LUMINANCE: DVec3 = DVec3::new(0.2126, 0.7152, 0.0722);

/// Columns and rows of a chart.
const COLUMNS: usize = 6;
const ROWS: usize = 4;
const PATCHES: usize = COLUMNS * ROWS;

/// Published sRGB colours of a chart of 24 patches (`ColorChecker`), by rows: its greys, from white on, are the last.
const COLOURS: [[u8; 3]; PATCHES] = [
    [115, 82, 68],
    [194, 150, 130],
    [98, 122, 157],
    [87, 108, 67],
    [133, 128, 177],
    [103, 189, 170],
    [214, 126, 44],
    [80, 91, 166],
    [193, 90, 99],
    [94, 60, 108],
    [157, 188, 64],
    [224, 163, 46],
    [56, 61, 150],
    [70, 148, 73],
    [175, 54, 60],
    [231, 199, 31],
    [187, 86, 149],
    [8, 133, 161],
    [243, 243, 242],
    [200, 200, 200],
    [160, 160, 160],
    [122, 122, 121],
    [85, 85, 85],
    [52, 52, 52],
];

/// With fewer usable patches a chart gives gains alone.
const NEEDED: usize = 12;

/// The strengths of the ridge that are tried, ascending; the last is the identity.
const RIDGES: [f64; 17] =
    [0.01, 0.02, 0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 1e9];

/// The projective map of the unit square to these corners, in the order (0, 0), (1, 0), (1, 1), (0, 1) (Heckbert 1989,
/// 2.2.3).
pub(super) fn homography(corners: [[f64; 2]; 4]) -> DMat3 {
    let [a, b, c, d] = corners.map(DVec2::from_array);
    let (right, down, excess) = (b - c, d - c, a - b + c - d);
    let determinant = right.perp_dot(down);
    let g = excess.perp_dot(down) / determinant;
    let h = right.perp_dot(excess) / determinant;
    let (across, along) = (b - a + g * b, d - a + h * d);
    DMat3::from_cols(across.extend(g), along.extend(h), a.extend(1.0))
}

/// Whether the sides of a quadrilateral turn the same way at each corner.
fn is_convex(corners: [[f64; 2]; 4]) -> bool {
    let corner = |i: usize| DVec2::from_array(corners[i % 4]);
    let turns =
        |i: usize| (corner(i + 1) - corner(i)).perp_dot(corner(i + 2) - corner(i + 1)) > 0.0;
    (1..4).all(|i| turns(i) == turns(0))
}

/// Samples of the middle of every patch, column and row in pixels, in the order of [`COLOURS`]. The corners are at the
/// dark skin, bluish green, black and white patch. Some charts number every second row from the other end: black is
/// then beside dark skin.
pub(super) fn patches(corners: [[f64; 2]; 4]) -> Vec<Vec<[u32; 2]>> {
    let [dark_skin, bluish_green, black, white] = corners;
    let turned = [dark_skin, bluish_green, white, black];
    let is_turned = !is_convex(corners) && is_convex(turned);
    let map = homography(if is_turned { turned } else { corners });
    let patch = |index: usize| {
        let (column, row) = (index % COLUMNS, index / COLUMNS);
        let is_reversed = is_turned && row % 2 == 1;
        middle(map, if is_reversed { COLUMNS - 1 - column } else { column }, row)
    };
    (0..PATCHES).map(patch).collect()
}

/// Samples of the middle of a patch, column and row in pixels.
fn middle(map: DMat3, column: usize, row: usize) -> Vec<[u32; 2]> {
    /// Samples in each direction.
    const SAMPLES: usize = 16;
    let sample = |index: usize| {
        let [x, y] = [index % SAMPLES, index / SAMPLES]
            .map(|at| 0.3 + 0.4 * (at as f64 + 0.5) / SAMPLES as f64);
        let position = map
            * DVec3::new((column as f64 + x) / COLUMNS as f64, (row as f64 + y) / ROWS as f64, 1.0);
        // A position left of or above the photograph is moved beyond its right or bottom edge.
        let pixel = |value: f64| if value >= 0.0 { value as u32 } else { u32::MAX };
        [pixel(position.x / position.z), pixel(position.y / position.z)]
    };
    (0..SAMPLES * SAMPLES).map(sample).collect()
}

/// The index of the first of the greys, from white to black.
pub(super) const FIRST_GREY: usize = 3 * COLUMNS;

/// A patch: its balanced light and its published colour.
type Patch = [DVec3; 2];

/// The matrix of linear light that keeps greys and brings the patches nearest to their colours; `None` if too few are
/// usable. Takes the linear light of each patch, without that of clipped ones, and the gains that make greys neutral.
pub(super) fn matrix(light: &[Option<DVec3>], gains: DVec3) -> Option<DMat3> {
    let published = COLOURS.map(|colour| {
        DVec3::from_array(colour.map(|code| linear_from_srgb(f32::from(code) / 255.0).into()))
    });
    let balanced = light
        .iter()
        .zip(published)
        .map(|(light, colour)| light.map(|light| [light * gains, colour]));
    let mut patches: Vec<Option<Patch>> = balanced.collect();
    // The exposure: greys have their published luminance.
    let (mut product, mut square) = (0.0, 0.0);
    for [light, colour] in patches.iter().skip(FIRST_GREY).flatten() {
        let [light, colour] = [light, colour].map(|colour| colour.dot(LUMINANCE));
        product += light * colour;
        square += light * light;
    }
    for patch in patches.iter_mut().flatten() {
        patch[0] *= product / square;
    }
    let patches: Vec<Patch> = patches.into_iter().flatten().collect();
    (patches.len() >= NEEDED && square > 0.0).then(|| ridge_fit(&patches, strength(&patches)))
}

/// The largest ridge whose error on patches left out is within a standard error of the smallest.
fn strength(patches: &[Patch]) -> f64 {
    // Squared errors of each patch by the matrix of the others.
    let errors = |ridge: f64| -> Vec<f64> {
        let left_out = |index: usize| {
            let mut rest = patches.to_vec();
            let [light, colour] = rest.remove(index);
            (ridge_fit(&rest, ridge) * light - colour).length_squared()
        };
        (0..patches.len()).map(left_out).collect()
    };
    let means = RIDGES.map(|ridge| {
        let errors = errors(ridge);
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let variance = errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / count;
        [mean, (variance / (count - 1.0)).sqrt()]
    });
    let [least, error] = means
        .into_iter()
        .fold([f64::INFINITY; 2], |least, next| if next[0] < least[0] { next } else { least });
    let within = |(mean, _): &(&[f64; 2], f64)| mean[0] <= least + error;
    means.iter().zip(RIDGES).rev().find(within).map_or(RIDGES[16], |(_, ridge)| ridge)
}

/// The grey-preserving matrix of least squares with a ridge: a row changes by multiples of red - green and of
/// blue - green.
fn ridge_fit(patches: &[Patch], ridge: f64) -> DMat3 {
    let chroma = |light: DVec3| DVec2::new(light.x - light.y, light.z - light.y);
    let mut normal = DMat2::from_diagonal(DVec2::splat(ridge));
    let mut products = [DVec2::ZERO; 3];
    for &[light, colour] in patches {
        let chroma = chroma(light);
        normal += DMat2::from_cols(chroma * chroma.x, chroma * chroma.y);
        for (product, error) in products.iter_mut().zip((colour - light).to_array()) {
            *product += error * chroma;
        }
    }
    let inverse = normal.inverse();
    let [red, green, blue] = products.map(|product| {
        let change = inverse * product;
        DVec3::new(change.x, -change.x - change.y, change.y)
    });
    DMat3::IDENTITY + DMat3::from_cols(red, green, blue).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn published() -> Vec<DVec3> {
        let light = |code: u8| f64::from(linear_from_srgb(f32::from(code) / 255.0));
        COLOURS.iter().map(|colour| DVec3::from_array(colour.map(light))).collect()
    }

    /// A loss of chroma that keeps greys.
    fn paler(share: f64) -> DMat3 {
        let grey = DMat3::from_cols(LUMINANCE, LUMINANCE, LUMINANCE).transpose();
        DMat3::IDENTITY * (1.0 - share) + grey * share
    }

    #[test]
    fn lost_chroma_is_restored_at_any_exposure_and_greys_stay() {
        for (exposure, share) in [(1.0, 0.4), (0.01, 0.2)] {
            let photographed = |colour: DVec3| Some(paler(share) * colour * exposure);
            let light: Vec<_> = published().into_iter().map(photographed).collect();
            let found = matrix(&light, DVec3::ONE).unwrap();
            assert!((found * DVec3::ONE - DVec3::ONE).length() < 1e-12, "{found}");
            let off = |matrix: DMat3| -> f64 {
                let errors = light.iter().zip(published());
                errors
                    .map(|(light, colour)| (matrix * light.unwrap() / exposure - colour).length())
                    .sum()
            };
            assert!(
                off(found) < 0.1 * off(DMat3::IDENTITY),
                "{} {}",
                off(found),
                off(DMat3::IDENTITY)
            );
        }
    }

    #[test]
    fn a_matrix_on_which_patches_disagree_is_held_to_the_identity() {
        let strength_of = |noise: f64| {
            let patch = |(index, colour): (usize, DVec3)| {
                let seen = [3, 5, 7].map(|factor| ((index * factor) % 11) as f64 / 5.0 - 1.0);
                [paler(0.4) * colour + noise * DVec3::from_array(seen), colour]
            };
            strength(&published().into_iter().enumerate().map(patch).collect::<Vec<_>>())
        };
        assert!(strength_of(0.1) >= 10.0 * strength_of(0.0), "{}", strength_of(0.1));
    }

    #[test]
    fn few_patches_and_black_ones_give_no_matrix() {
        let some = |most: usize| -> Vec<_> {
            let colours = published().into_iter().enumerate();
            colours
                .map(|(index, colour)| Some(colour).filter(|_| index >= PATCHES - most))
                .collect()
        };
        assert_eq!(matrix(&some(NEEDED - 1), DVec3::ONE), None);
        assert!(matrix(&some(NEEDED), DVec3::ONE).is_some());
        assert_eq!(matrix(&[Some(DVec3::ZERO); PATCHES], DVec3::ONE), None);
    }

    #[test]
    fn a_chart_that_is_numbered_back_and_forth_is_told_by_its_corners() {
        let [left, right, top, bottom] = [0.0, 60.0, 0.0, 40.0];
        let patch_of = |patches: &[Vec<[u32; 2]>], index: usize| {
            let [x, y] = patches[index][0];
            [x / 10, y / 10]
        };
        let usual = patches([[left, top], [right, top], [right, bottom], [left, bottom]]);
        let turned = patches([[left, top], [right, top], [left, bottom], [right, bottom]]);
        for (index, expected, expected_turned) in
            [(0, [0, 0], [0, 0]), (6, [0, 1], [5, 1]), (12, [0, 2], [0, 2]), (18, [0, 3], [5, 3])]
        {
            assert_eq!(patch_of(&usual, index), expected);
            assert_eq!(patch_of(&turned, index), expected_turned);
        }
    }
}
