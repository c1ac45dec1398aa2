//! What all photographs of a size have at the same position, outside the scene: black borders and corners, as
//! undistorting leaves them, and overlays.
//!
//! Such black touches the border, is at the same position in all views and ends abruptly, unlike the black of a dark
//! scene.

mod overlay;
mod still;

use crate::image::ImageFile as _;
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::path::Path;

use super::source::{ViewFiles, shown};
use super::{LoadOptions, Photograph, Split};
use crate::image::{Image, Mask, PictureFile};
use overlay::Overlay;

/// The maximum encoded value of black: JPEG turns 0 into up to this within a block.
const BLACK: f32 = 1.5 / 255.0;
/// Brighter pixels are part of the scene.
const SOMETHING: f32 = 4.0 / 255.0;
/// How many photographs of a size are looked at, and how many are needed.
const LOOKED_AT: usize = 12;
const NEEDED: usize = 3;
/// The share of the photographs that must be black at a position.
const MAX_VIEWS: f64 = 0.9;
/// The minimum area of a border, as a share of the photograph.
const LEAST_AREA: f64 = 0.002;
/// The share of its outline at which black must end abruptly.
const LEAST_ABRUPT: f64 = 0.5;
/// In most views, the black connected to the border is at most this many times the common black: a sky with a moving
/// horizon has more.
const MOST_EXTRA: f64 = 1.2;
/// JPEG turns black in a block with content into less than this.
const DIM: f32 = 8.0 / 255.0;
/// A block of JPEG, pixels: within this distance of black, pixels that are dim in most views are black.
const BLOCK: usize = 8;
/// How far interpolation spreads black, pixels.
const REACH: usize = 2;

/// A border of more of an image is a scene that is black.
const MOST_AREA: f64 = 0.9;

/// The pixels that show nothing, as indices into a plane, ascending; by width and height of the photographs as stored.
#[derive(Clone, Debug, Default)]
pub struct Borders(BTreeMap<(u32, u32), Vec<usize>>);

/// A training photograph without a mask: who has masks has masked what shows nothing.
struct BorderCandidate<'a> {
    size: (u32, u32),
    picture: Box<dyn Fn() -> Option<Image> + 'a>,
}

impl Borders {
    pub(super) fn of_sources<'a>(
        sources: impl Iterator<Item = &'a ViewFiles>,
        options: &LoadOptions,
    ) -> Self {
        let sources =
            sources.filter(|source| source.split == Split::Train && source.mask.is_none());
        let candidates = sources.map(|source| {
            let picture = Box::new(|| source.picture());
            BorderCandidate { size: source.decoded_sizes[0].unwrap_or_default(), picture }
        });
        Self::find(candidates, options, &warn)
    }

    /// Those of a dataset that is not loaded.
    pub fn of_photographs(photographs: &[Photograph], options: &LoadOptions) -> Self {
        let training =
            photographs.iter().filter(|one| one.split == Split::Train && one.mask.is_none());
        let decoded_size = |size| options.decoded_size(size);
        let candidates = training.map(|one| BorderCandidate::of_file(&one.input, decoded_size));
        Self::find(candidates, options, &warn)
    }

    /// Those of files at their full size, unsaid.
    pub fn of_files<'a>(files: impl Iterator<Item = &'a Path>, options: &LoadOptions) -> Self {
        Self::find(files.map(|file| BorderCandidate::of_file(file, |size| size)), options, &drop)
    }

    /// What stays in place in the photographs of each size, however dim it is, unsaid. Twelve of a size are decoded.
    pub fn still_in<'a>(files: impl Iterator<Item = &'a Path>) -> Self {
        let mut by_size: BTreeMap<(u32, u32), Vec<&Path>> = BTreeMap::new();
        for file in files {
            if let Ok(size) = Image::size_of(file) {
                by_size.entry(size).or_default().push(file);
            }
        }
        let found = by_size.into_iter().map(|(size, files)| (size, still_of_size(&files, size)));
        Self(found.filter(|(_, pixels)| !pixels.is_empty()).collect())
    }

    /// The pixels of both.
    pub fn joined(mut self, other: Self) -> Self {
        for (size, pixels) in other.0 {
            let hidden = self.0.entry(size).or_default();
            hidden.extend(pixels);
            hidden.sort_unstable();
            hidden.dedup();
        }
        self
    }

    fn find<'a>(
        candidates: impl Iterator<Item = BorderCandidate<'a>>,
        options: &LoadOptions,
        say: &dyn Fn(String),
    ) -> Self {
        let mut by_size: BTreeMap<(u32, u32), Vec<BorderCandidate<'_>>> = BTreeMap::new();
        if options.mask_borders || options.mask_overlays {
            candidates.for_each(|one| by_size.entry(one.size).or_default().push(one));
        }
        by_size.retain(|_, candidates| candidates.len() >= NEEDED);
        let found = by_size.into_iter().filter_map(|(size, candidates)| {
            let hidden = hidden(&candidates, size, options, say);
            (!hidden.is_empty()).then_some((size, hidden))
        });
        Self(found.collect())
    }

    /// The mask of a photograph of this size, as stored, with its border masked as well.
    pub fn hide_borders(&self, mask: Option<Mask>, size: (u32, u32)) -> Option<Mask> {
        Mask::masked_at(mask, size, self.0.get(&size).map_or(&[], Vec::as_slice))
    }
}

impl<'a> BorderCandidate<'a> {
    fn of_file(
        file: &'a Path,
        decoded_size: impl Fn((u32, u32)) -> (u32, u32) + Copy + 'a,
    ) -> Self {
        let picture = Box::new(move || shown(PictureFile::open(file).ok()?.reduced(decoded_size)));
        Self { size: Image::size_of(file).map(decoded_size).unwrap_or_default(), picture }
    }
}

fn warn(line: String) {
    tracing::warn!("{line}");
}

/// The pixels outside the scene in photographs of one size. Says what they are.
fn hidden(
    candidates: &[BorderCandidate<'_>],
    (width, height): (u32, u32),
    options: &LoadOptions,
    say: &dyn Fn(String),
) -> Vec<usize> {
    let grid = PixelGrid { width: width as usize, height: height as usize };
    let step = candidates.len().div_ceil(LOOKED_AT);
    let chosen: Vec<&BorderCandidate<'_>> = candidates.iter().step_by(step).collect();
    let planes = vec![OnceCell::new(); chosen.len()];
    let plane = |index: usize| {
        let decoded = || {
            let image = (chosen[index].picture)();
            image.filter(|image| image.pixel_count() == grid.len()).map(|image| brightest(&image))
        };
        planes[index].get_or_init(decoded).as_deref()
    };
    let mut hidden = vec![];
    if options.mask_borders
        && let Some(border) = border((0..chosen.len()).filter_map(plane), (width, height))
    {
        say(format!(
            "{:.1} % of the photographs of {width}x{height} is black in the same place at the border, as \
             undistorting leaves it where the lens saw nothing: masked (mask_borders = false trains on it)",
            100.0 * border.len() as f64 / grid.len() as f64
        ));
        hidden = border;
    }
    if options.mask_overlays {
        for Overlay { rows, columns, .. } in overlay::overlays(chosen.len(), plane, &grid) {
            say(format!(
                "rows {} to {}, columns {} to {} of the photographs of {width}x{height} hardly change between views \
                 that move, like a date burnt into them: masked (masks/ can mask other pixels, mask_overlays = false \
                 trains on these)",
                rows.start,
                rows.end - 1,
                columns.start,
                columns.end - 1
            ));
            hidden.extend(rows.flat_map(|y| columns.clone().map(move |x| y * grid.width + x)));
        }
    }
    hidden.sort_unstable();
    hidden.dedup();
    hidden
}

/// The pixels that stay in place in files of one size, from images of at most `LONGEST` pixels each way.
fn still_of_size(files: &[&Path], (width, height): (u32, u32)) -> Vec<usize> {
    const LONGEST: u32 = 1024;
    let factor = width.max(height).div_ceil(LONGEST).max(1);
    let [columns, rows] = [width, height].map(|side| side.div_ceil(factor));
    let step = files.len().div_ceil(LOOKED_AT);
    let plane = |file: &&Path| {
        let image = shown(PictureFile::open(file).ok()?.reduced(|_| (columns, rows)))?;
        Some(brightest(&image))
    };
    let planes: Vec<Vec<f32>> = files.iter().step_by(step).filter_map(plane).collect();
    let grid = PixelGrid { width: columns as usize, height: rows as usize };
    let hidden = still::still(&planes, &grid);
    let image = Image::filled(columns, rows, [0.0; 3]);
    let Some(mask) = Mask::hiding(&image, &hidden) else { return vec![] };
    mask.resized(width, height).hidden()
}

/// The black border that images of one size have in common; of each, the largest channel of every pixel.
fn border<'a>(
    views: impl Iterator<Item = &'a [f32]>,
    (width, height): (u32, u32),
) -> Option<Vec<usize>> {
    let plane = PixelGrid { width: width as usize, height: height as usize };
    let least = (LEAST_AREA * plane.len() as f64).ceil().max(1.0) as usize;
    let mut counts = vec![0_u16; plane.len()];
    let (mut brightness, mut areas) = (vec![], vec![]);
    for values in views {
        let black = plane.black_from_border(values);
        // What all views have the first has.
        if black.len() < least {
            return None;
        }
        black.iter().for_each(|&pixel| counts[pixel] += 1);
        areas.push(black.len());
        brightness.push(values);
    }
    let views = brightness.len();
    if views < NEEDED {
        return None;
    }
    let most = (MAX_VIEWS * views as f64).ceil() as u16;
    let is_common = |pixel: usize| counts[pixel] >= most;
    let common: Vec<usize> = (0..plane.len()).filter(|&pixel| is_common(pixel)).collect();
    if common.len() < least || common.len() as f64 > MOST_AREA * plane.len() as f64 {
        return None;
    }
    areas.sort_unstable();
    if areas[views / 2] as f64 > MOST_EXTRA * common.len() as f64 {
        return None;
    }
    // Where black ends, what lies a block farther shows something in most views.
    let (mut outline, mut abrupt) = (0, 0);
    for &pixel in &common {
        for (next, beyond) in plane.outward(pixel, BLOCK + 2 * REACH) {
            if !is_common(next) {
                outline += views;
                abrupt += brightness.iter().filter(|values| values[beyond] > SOMETHING).count();
            }
        }
    }
    let is_abrupt = abrupt as f64 >= LEAST_ABRUPT * f64::from(outline.max(1) as u32);
    let is_dim = |pixel: usize| {
        let dim = brightness.iter().filter(|values| values[pixel] <= DIM).count();
        dim >= usize::from(most)
    };
    is_abrupt.then(|| plane.dilated(&plane.grown(common, is_dim)))
}

/// The largest channel of every pixel.
fn brightest(image: &Image) -> Vec<f32> {
    let pixels = image.pixel_count();
    let (red, rest) = image.data.split_at(pixels);
    let (green, blue) = rest.split_at(pixels);
    red.iter().zip(green).zip(blue).map(|((r, g), b)| r.max(*g).max(*b)).collect()
}

/// Pixels of an image by their index.
struct PixelGrid {
    width: usize,
    height: usize,
}

impl PixelGrid {
    fn len(&self) -> usize {
        self.width * self.height
    }

    /// The neighbours of a pixel, each with the pixel `reach` away in its direction, within the image.
    fn outward(&self, pixel: usize, reach: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (width, height) = (self.width, self.height);
        let (x, y) = (pixel % width, pixel / width);
        let row = move |at: usize| y * width + at;
        let column = move |at: usize| at * width + x;
        let left = (x > 0).then(|| (row(x - 1), row(x.saturating_sub(reach))));
        let right = (x + 1 < width).then(|| (row(x + 1), row((x + reach).min(width - 1))));
        let above = (y > 0).then(|| (column(y - 1), column(y.saturating_sub(reach))));
        let below = (y + 1 < height).then(|| (column(y + 1), column((y + reach).min(height - 1))));
        [left, right, above, below].into_iter().flatten()
    }

    /// The black pixels that are connected to the border by black ones.
    fn black_from_border(&self, values: &[f32]) -> Vec<usize> {
        let mut is_reached = vec![false; self.len()];
        let is_edge = |pixel: usize| {
            let (x, y) = (pixel % self.width, pixel / self.width);
            x == 0 || y == 0 || x + 1 == self.width || y + 1 == self.height
        };
        let mut open: Vec<usize> =
            (0..self.len()).filter(|&pixel| is_edge(pixel) && values[pixel] <= BLACK).collect();
        open.iter().for_each(|&pixel| is_reached[pixel] = true);
        let mut black = vec![];
        while let Some(pixel) = open.pop() {
            black.push(pixel);
            for (next, _) in self.outward(pixel, 1) {
                if !is_reached[next] && values[next] <= BLACK {
                    is_reached[next] = true;
                    open.push(next);
                }
            }
        }
        black
    }

    /// Pixels with those of a kind that are connected to them, within a block.
    fn grown(&self, mut pixels: Vec<usize>, is_of_kind: impl Fn(usize) -> bool) -> Vec<usize> {
        let mut is_reached = vec![false; self.len()];
        pixels.iter().for_each(|&pixel| is_reached[pixel] = true);
        let mut begin = 0;
        for _ in 0..BLOCK {
            let end = pixels.len();
            for index in begin..end {
                for (next, _) in self.outward(pixels[index], 1) {
                    if !is_reached[next] && is_of_kind(next) {
                        is_reached[next] = true;
                        pixels.push(next);
                    }
                }
            }
            begin = end;
        }
        pixels
    }

    /// Pixels and those that interpolation mixes them into, ascending.
    fn dilated(&self, pixels: &[usize]) -> Vec<usize> {
        let mut is_hidden = vec![false; self.len()];
        for &pixel in pixels {
            let (x, y) = (pixel % self.width, pixel / self.width);
            for row in y.saturating_sub(REACH)..(y + REACH + 1).min(self.height) {
                let begin = row * self.width;
                let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(self.width);
                is_hidden[begin + columns.start..begin + columns.end].fill(true);
            }
        }
        (0..self.len()).filter(|&pixel| is_hidden[pixel]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (60, 40);

    /// Photographs of a scene that moves by `shift` pixels a view, black outside a circle.
    fn views(
        shift: u32,
        scene: impl Fn(u32, u32) -> f32,
        radius: f64,
    ) -> impl Iterator<Item = Image> {
        (0..5).map(move |view| {
            Image::from_fn(SIZE.0, SIZE.1, |x, y| {
                let (from_x, from_y) = (f64::from(x) - 29.5, f64::from(y) - 19.5);
                let is_seen = from_x.hypot(from_y) < radius;
                [if is_seen { scene(x + shift * view, y + shift * view) } else { 0.0 }; 3]
            })
        })
    }

    fn border(images: impl Iterator<Item = Image>, size: (u32, u32)) -> Option<Vec<usize>> {
        let planes: Vec<Vec<f32>> = images.map(|image| brightest(&image)).collect();
        super::border(planes.iter().map(Vec::as_slice), size)
    }

    fn textured(x: u32, y: u32) -> f32 {
        0.03 + 0.04 * ((x * 7 + y * 13) % 11) as f32 / 11.0
    }

    #[test]
    fn black_corners_are_found_with_what_interpolation_mixes_them_into() {
        let border = border(views(3, textured, 30.0), SIZE).unwrap();
        let is_outside = |pixel: usize, radius: f64| {
            let (x, y) = ((pixel % 60) as f64 - 29.5, (pixel / 60) as f64 - 19.5);
            x.hypot(y) >= radius
        };
        assert!(border.iter().all(|&pixel| is_outside(pixel, 30.0 - 5.0)));
        let outside = (0..2400).filter(|&pixel| is_outside(pixel, 30.0));
        assert!(outside.into_iter().all(|pixel| border.binary_search(&pixel).is_ok()));
    }

    #[test]
    fn a_dark_scene_has_no_border() {
        assert_eq!(border(views(3, textured, 100.0), SIZE), None, "no black");
        let sky = |_: u32, y: u32| if y < 25 { 0.0 } else { 0.1 };
        assert_eq!(border(views(4, sky, 100.0), SIZE), None, "a sky whose horizon moves");
        let fade = |_: u32, y: u32| 0.0005 * y as f32;
        assert_eq!(border(views(0, fade, 100.0), SIZE), None, "a sky that fades");
        assert_eq!(border(views(0, |_, _| 0.0, 100.0), SIZE), None, "all black");
        assert_eq!(border(views(0, |_, _| 1.0, 1.0), SIZE), None, "some lit pixels");
        assert_eq!(border(views(3, textured, 30.0).take(2), SIZE), None, "two views tell nothing");
        let one = views(3, textured, 30.0).take(1).chain(views(3, textured, 100.0));
        assert_eq!(border(one, SIZE), None, "in one view only");
    }
}
