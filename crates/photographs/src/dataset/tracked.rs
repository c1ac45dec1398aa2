//! The pixels that cameras refer to, if sizes are ambiguous, from tracked points: a point looks alike in all
//! photographs that show it, if each is sampled where its camera projects the point.

use nightsplat_core::Result;
use nightsplat_core::camera::Lens;
use rayon::prelude::*;

use super::Point;
use super::source::ViewFiles;
use super::turns::{CameraPixels, ImageHeader, PixelOrientation};
use crate::image::{Image, Orientation};

/// Photographs that are compared.
const MOST: usize = 12;
/// Pairs of photographs of a point below which chance decides.
const LEAST_PAIRS: usize = 30;
/// The difference of two correlations that is clear, and the number of standard errors that it has to exceed.
const CLEAR: f64 = 0.1;
const STANDARD_ERRORS: f64 = 4.0;
/// A sample is the mean of a square whose half side is this part of the longest side.
const HALF_SIDE: f64 = 1.0 / 250.0;

/// The pixels that the cameras are of where sizes do not tell. One program found them all, so that one answer holds for
/// all photographs. `points` gives the dataset's points, with indices into `sources`.
pub(super) fn pixels(
    sources: &[ViewFiles],
    headers: &[Option<ImageHeader>],
    choice: PixelOrientation,
    points: impl FnOnce() -> Result<Vec<Point>>,
) -> Result<CameraPixels> {
    let turned: Vec<(usize, ImageHeader)> = headers
        .iter()
        .enumerate()
        .filter_map(|(index, header)| Some((index, (*header)?)))
        .filter(|(_, header)| header.orientation != Orientation::UPRIGHT)
        .collect();
    let by_size = |(index, header): &(usize, ImageHeader)| header.by_size(&sources[*index].lens);
    let (told, open): (Vec<_>, Vec<_>) =
        turned.into_iter().partition(|image| by_size(image).is_some());
    let Some(first) = open.first() else { return Ok(CameraPixels::Stored) };
    match choice {
        PixelOrientation::Stored => return Ok(CameraPixels::Stored),
        PixelOrientation::Exif => return Ok(CameraPixels::Exif),
        PixelOrientation::Auto => {}
    }
    let mut told: Vec<CameraPixels> = told.iter().filter_map(by_size).collect();
    told.dedup();
    if let [only] = told[..] {
        return Ok(only);
    }
    let found = by_points(sources, headers, &open, &points()?);
    let (count, name) = (open.len(), &sources[first.0].name);
    let subject = format!(
        "Exif turns or mirrors {count} photographs, {name} the first, whose sizes do not tell which pixels their \
         cameras are of"
    );
    match found {
        Some(CameraPixels::Stored) => {
            tracing::info!("{subject}: those stored, by the points they share");
        }
        Some(CameraPixels::Exif) => {
            tracing::info!("{subject}: those that Exif shows, by the points they share");
        }
        None => tracing::warn!(
            "{subject}: those stored are taken; `--orientation exif` takes those that Exif shows, `stored` keeps \
             these"
        ),
    }
    Ok(found.unwrap_or(CameraPixels::Stored))
}

/// The pixels with which the photographs agree on their points; `None` where that is not clear. `open` are those, with
/// indices into `sources`, for which the answer is wanted.
fn by_points(
    sources: &[ViewFiles],
    headers: &[Option<ImageHeader>],
    open: &[(usize, ImageHeader)],
    points: &[Point],
) -> Option<CameraPixels> {
    let chosen = neighbours(sources.len(), open, points)?;
    let sampled = chosen.par_iter().map(|&view| {
        let image = sources[view].picture()?;
        let orientation = headers[view]?.orientation;
        let seen: Vec<(usize, &Point)> =
            points.iter().enumerate().filter(|(_, point)| sees(point, view)).collect();
        let turned = orientation.upright(image.clone());
        Some([image, turned].map(|image| samples(&image, &sources[view], &seen)))
    });
    let sampled: Vec<[Vec<(usize, f64)>; 2]> = sampled.flatten().collect();
    let [stored, exif] =
        [0, 1].map(|which| agreement(sampled.iter().map(|sample| &sample[which]), points.len()));
    let ((stored, pairs), (exif, others)) = (stored?, exif?);
    let pairs = pairs.min(others);
    let clear = CLEAR.max(STANDARD_ERRORS / (pairs as f64).sqrt());
    tracing::debug!("agreement on points: {stored:.3} as stored, {exif:.3} as Exif shows");
    match exif - stored {
        _ if pairs < LEAST_PAIRS => None,
        difference if difference > clear => Some(CameraPixels::Exif),
        difference if difference < -clear => Some(CameraPixels::Stored),
        _ => None,
    }
}

fn sees(point: &Point, view: usize) -> bool {
    u32::try_from(view).is_ok_and(|view| point.views.binary_search(&view).is_ok())
}

/// The photograph that sees most points of those in question, and those that share most with it.
fn neighbours(count: usize, open: &[(usize, ImageHeader)], points: &[Point]) -> Option<Vec<usize>> {
    let mut seen = vec![0; count];
    points.iter().flat_map(|point| &point.views).for_each(|&view| seen[view as usize] += 1);
    let first = open.iter().map(|image| image.0).max_by_key(|&view| seen[view])?;
    let mut shared = vec![0; count];
    for point in points.iter().filter(|point| sees(point, first)) {
        point.views.iter().for_each(|&view| shared[view as usize] += 1);
    }
    let mut views: Vec<usize> = (0..count).filter(|&view| shared[view] > 0).collect();
    views.sort_by_key(|&view| std::cmp::Reverse(shared[view]));
    views.truncate(MOST);
    Some(views)
}

/// The brightness of points in a picture, by their index; without those that lie outside.
fn samples(image: &Image, source: &ViewFiles, points: &[(usize, &Point)]) -> Vec<(usize, f64)> {
    let brightness = |(index, point): &(usize, &Point)| {
        let position = position_in_image(source, point)?;
        let (width, height) = (f64::from(image.width), f64::from(image.height));
        let half = (HALF_SIDE * width.max(height)).round() as i64;
        let (x, y) = ((position[0] * width) as i64, (position[1] * height) as i64);
        let (mut sum, mut count) = (0.0, 0.0);
        for row in (y - half).max(0)..=(y + half).min(i64::from(image.height) - 1) {
            for column in (x - half).max(0)..=(x + half).min(i64::from(image.width) - 1) {
                sum += image.pixel(column as u32, row as u32).map(f64::from).iter().sum::<f64>();
                count += 3.0;
            }
        }
        Some((*index, sum / count))
    };
    points.iter().filter_map(brightness).filter(|(_, value)| value.is_finite()).collect()
}

/// Where a camera has a point, as parts of width and height.
fn position_in_image(source: &ViewFiles, point: &Point) -> Option<[f64; 2]> {
    let Lens { width, height, focal, principal_point, distortion } = source.lens;
    let in_view = source.view_from_world.transform_point3(point.position);
    let at = in_view.truncate() / in_view.z;
    let pixel = focal * distortion.distort(at) + principal_point;
    let position = [pixel.x / f64::from(width), pixel.y / f64::from(height)];
    let is_seen = in_view.z > 0.0 && position.iter().all(|part| (0.0..1.0).contains(part));
    is_seen.then_some(position)
}

/// The mean correlation of the values of a point in pairs of photographs, normalised by the mean and contrast of each
/// photograph, and the number of pairs; `None` if no two show the same point.
fn agreement<'a>(
    views: impl Iterator<Item = &'a Vec<(usize, f64)>>,
    points: usize,
) -> Option<(f64, usize)> {
    // Sum, sum of squares, and number of views.
    let mut by_point = vec![(0.0, 0.0, 0.0); points];
    for view in views {
        let count = view.len().max(1) as f64;
        let mean = view.iter().map(|sample| sample.1).sum::<f64>() / count;
        let variance = view.iter().map(|sample| (sample.1 - mean).powi(2)).sum::<f64>() / count;
        if variance <= 0.0 {
            continue;
        }
        for (point, value) in view {
            let standard = (value - mean) / variance.sqrt();
            let (sum, squares, count) = &mut by_point[*point];
            *sum += standard;
            *squares += standard * standard;
            *count += 1.0;
        }
    }
    let (mut products, mut pairs, mut independent) = (0.0, 0.0, 0.0);
    for (sum, squares, count) in by_point.into_iter().filter(|sums| sums.2 > 1.0) {
        products += sum * sum - squares;
        pairs += count * (count - 1.0);
        independent += count - 1.0;
    }
    (pairs > 0.0).then(|| (products / pairs, independent as usize))
}
