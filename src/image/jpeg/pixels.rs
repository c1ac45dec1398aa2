//! From coefficients to pixels, with libjpeg's rounding: every sum is an integer, so the order of additions is ours.

use rayon::prelude::*;

use super::{Colors, Component, Picture};
use crate::image::Image;

/// Bits behind the point of the transform's factors.
const FACTOR_BITS: u32 = 13;
/// Bits behind the point that the first pass keeps.
const KEPT_BITS: u32 = 2;

/// The inverse DCT of one row or column, times 2^13 sqrt(8).
fn transformed(c: [i64; 8]) -> [i64; 8] {
    let sum = (c[0] + c[4]) << FACTOR_BITS;
    let difference = (c[0] - c[4]) << FACTOR_BITS;
    let wide = 10_703 * c[2] + 4433 * c[6];
    let narrow = 4433 * c[2] - 10_704 * c[6];
    let even = [sum + wide, difference + narrow, difference - narrow, sum - wide];
    let odd = [
        11_363 * c[1] + 9633 * c[3] + 6437 * c[5] + 2260 * c[7],
        9633 * c[1] - 2259 * c[3] - 11_362 * c[5] - 6436 * c[7],
        6437 * c[1] - 11_362 * c[3] + 2261 * c[5] + 9633 * c[7],
        2260 * c[1] - 6436 * c[3] + 9633 * c[5] - 11_363 * c[7],
    ];
    std::array::from_fn(|i| if i < 4 { even[i] + odd[i] } else { even[7 - i] - odd[7 - i] })
}

/// Divides by 2^bits, to the nearest.
fn rounded(value: i64, bits: u32) -> i64 {
    (value + (1 << (bits - 1))) >> bits
}

/// The samples of a block.
fn samples(coefficients: &[i16; 64], quantization: &[u16; 64]) -> [[u8; 8]; 8] {
    let mut columns = [[0; 8]; 8];
    for (x, column) in columns.iter_mut().enumerate() {
        let coefficient =
            |y| i64::from(coefficients[8 * y + x]) * i64::from(quantization[8 * y + x]);
        let values = transformed(std::array::from_fn(coefficient));
        *column = values.map(|value| rounded(value, FACTOR_BITS - KEPT_BITS));
    }
    std::array::from_fn(|y| {
        let values = transformed(columns.map(|column| column[y]));
        values.map(|value| {
            let value = rounded(value, FACTOR_BITS + KEPT_BITS + 3);
            // libjpeg looks values up in a table of ten bits; those of sound files fit.
            (((value + 512) & 1023) - 512 + 128).clamp(0, 255) as u8
        })
    })
}

/// The samples of a component, row by row, of whole blocks.
fn plane(component: &Component) -> Option<Vec<u8>> {
    let Component { blocks: [columns, rows], stride, coefficients, quantization, .. } = component;
    let quantization = quantization.as_ref()?;
    let mut plane = vec![0; 64 * columns * rows];
    plane.par_chunks_mut(64 * columns).enumerate().for_each(|(row, lines)| {
        for column in 0..*columns {
            let block = samples(&coefficients[row * stride + column], quantization);
            for (y, values) in block.iter().enumerate() {
                lines[8 * (y * columns + column)..][..8].copy_from_slice(values);
            }
        }
    });
    Some(plane)
}

/// Row `y` of the picture from a component's samples: a triangle filter where it is half as wide or high, else copies.
fn upsampled(
    component: &Component,
    plane: &[u8],
    [across, down]: [usize; 2],
    y: usize,
    out: &mut [u8],
) {
    let Component { size: [width, height], blocks, .. } = *component;
    let row = |y: usize| &plane[8 * blocks[0] * y..][..width];
    let near = row(y / down);
    let beyond =
        if y.is_multiple_of(2) { (y / 2).saturating_sub(1) } else { (y / 2 + 1).min(height - 1) };
    match [across, down] {
        [2, 1] if width > 2 => doubled(|x| near[x].into(), width, [1, 2], 2, out),
        [2, 2] if width > 2 => {
            let far = row(beyond);
            doubled(|x| 3 * u32::from(near[x]) + u32::from(far[x]), width, [8, 7], 4, out);
        }
        [1, 2] => {
            let bias = [1, 2][y % 2];
            for ((out, &near), &far) in out.iter_mut().zip(near).zip(row(beyond)) {
                *out = ((3 * u32::from(near) + u32::from(far) + bias) >> 2) as u8;
            }
        }
        _ => out.iter_mut().enumerate().for_each(|(x, out)| *out = near[x / across]),
    }
}

/// Twice as wide: three parts of the nearer value and one of the other; an edge is its own neighbour.
fn doubled(value: impl Fn(usize) -> u32, width: usize, bias: [u32; 2], shift: u32, out: &mut [u8]) {
    for (x, out) in out.iter_mut().enumerate() {
        let i = x / 2;
        let other = if x.is_multiple_of(2) { i.saturating_sub(1) } else { (i + 1).min(width - 1) };
        *out = ((3 * value(i) + value(other) + bias[x % 2]) >> shift) as u8;
    }
}

/// ITU T.871, in 16 bits behind the point.
fn rgb_from_ycc([y, cb, cr]: [u8; 3]) -> [u8; 3] {
    let (y, cb, cr) = (i32::from(y), i32::from(cb) - 128, i32::from(cr) - 128);
    let half = 1 << 15;
    [
        y + ((91_881 * cr + half) >> 16),
        y + ((-22_554 * cb - 46_802 * cr + half) >> 16),
        y + ((116_130 * cb + half) >> 16),
    ]
    .map(|value| value.clamp(0, 255) as u8)
}

/// The image; none where a component is missing, or is sampled in a way that libjpeg refuses.
pub(super) fn image(picture: &Picture, colors: Colors) -> Option<Image> {
    let [width, height] = picture.size;
    let components = &picture.components;
    let planes = components.iter().map(plane).collect::<Option<Vec<_>>>()?;
    let factor = |component: &Component| {
        let [h, v] = component.sampling;
        let whole = picture.sampling[0].is_multiple_of(h) && picture.sampling[1].is_multiple_of(v);
        whole.then_some([picture.sampling[0] / h, picture.sampling[1] / v])
    };
    let factors = components.iter().map(factor).collect::<Option<Vec<_>>>()?;
    let mut image = Image::filled(width as u32, height as u32, [0.0; 3]);
    let (red, rest) = image.data.split_at_mut(width * height);
    let (green, blue) = rest.split_at_mut(width * height);
    let rows = red.par_chunks_mut(width).zip(green.par_chunks_mut(width));
    rows.zip(blue.par_chunks_mut(width)).enumerate().for_each(|(y, ((red, green), blue))| {
        let mut lines = [(); 3].map(|()| vec![0; width]);
        for ((component, plane), (factors, line)) in
            components.iter().zip(&planes).zip(factors.iter().zip(&mut lines))
        {
            upsampled(component, plane, *factors, y, line);
        }
        for x in 0..width {
            let values = [0, 1, 2].map(|c| lines[c][x]);
            let rgb = match colors {
                Colors::Grey => [values[0]; 3],
                Colors::Rgb => values,
                Colors::Ycc => rgb_from_ycc(values),
            };
            [red[x], green[x], blue[x]] = rgb.map(|value| f32::from(value) / 255.0);
        }
    });
    Some(image)
}
