//! Photographs in memory, in the fewest bits that restore every value.

use crate::image::Image;

/// A photograph whose values are 8-bit or 16-bit codes, or arbitrary.
#[derive(Clone, Debug)]
pub(super) struct Packed {
    width: u32,
    height: u32,
    values: Values,
}

#[derive(Clone, Debug)]
enum Values {
    Eight(Vec<u8>),
    Sixteen(Vec<u16>),
    Any(Vec<f32>),
}

const EIGHT: f32 = 255.0;
const SIXTEEN: f32 = 65_535.0;

impl Packed {
    pub(super) fn new(image: &Image) -> Self {
        let values = match codes(image) {
            Some(EIGHT) => {
                Values::Eight(image.data.iter().map(|x| (x * EIGHT).round() as u8).collect())
            }
            Some(_) => {
                Values::Sixteen(image.data.iter().map(|x| (x * SIXTEEN).round() as u16).collect())
            }
            None => Values::Any(image.data.clone()),
        };
        Self { width: image.width, height: image.height, values }
    }

    /// The bytes of memory that it takes.
    pub(super) fn bytes(&self) -> u64 {
        let bytes = match &self.values {
            Values::Eight(codes) => size_of_val(codes.as_slice()),
            Values::Sixteen(codes) => size_of_val(codes.as_slice()),
            Values::Any(values) => size_of_val(values.as_slice()),
        };
        bytes as u64
    }

    pub(super) fn image(&self) -> Image {
        let data = match &self.values {
            Values::Eight(codes) => codes.iter().map(|&code| f32::from(code) / EIGHT).collect(),
            Values::Sixteen(codes) => codes.iter().map(|&code| f32::from(code) / SIXTEEN).collect(),
            Values::Any(values) => values.clone(),
        };
        Image { width: self.width, height: self.height, data }
    }
}

/// The largest code, such that all values are exact multiples of its inverse; `None` if there is none.
fn codes(image: &Image) -> Option<f32> {
    [EIGHT, SIXTEEN].into_iter().find(|&steps| {
        let is_code = |&value: &f32| {
            let code = (value * steps).round();
            (0.0..=steps).contains(&code) && (code / steps).to_bits() == value.to_bits()
        };
        image.data.iter().all(is_code)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photograph_is_restored_to_the_bit_from_the_fewest_bytes() {
        let of = |value: &dyn Fn(u32) -> f32| Image::from_fn(16, 16, |x, y| [value(16 * y + x); 3]);
        let eight = of(&|i| i as f32 / 255.0);
        let sixteen = of(&|i| (251 * i + i % 2) as f32 / 65_535.0);
        let any = of(&|i| i as f32 * 1e-3 - 0.1);
        let nan = of(&|_| f32::NAN);
        for (image, bytes) in [(eight, 1), (sixteen, 2), (any, 4), (nan, 4)] {
            let packed = Packed::new(&image);
            assert_eq!(packed.bytes(), bytes * 3 * 256);
            let back = packed.image();
            let bits =
                |image: &Image| -> Vec<u32> { image.data.iter().map(|x| x.to_bits()).collect() };
            assert_eq!(bits(&back), bits(&image));
        }
    }
}
