//! A contact sheet: small images of many photographs, dark and lit.

use std::fmt::Write as _;

use nightsplat_core::natural;
use nightsplat_photographs::image::Image;

use super::{Picture, data_uri, escape};

/// The most photographs of a sheet.
const MOST: usize = 240;
/// The pixels of all images together, which bound the bytes of a page; and the widths of an image.
const PIXELS: f64 = 8e6;
const WIDTHS: [f64; 2] = [96.0, 320.0];
/// Quality of the JPEGs.
const QUALITY: u8 = 82;

/// Small images of photographs beside what they become.
#[derive(Clone, Debug, Default)]
pub struct ContactSheet {
    /// The heading.
    pub title: String,
    cells: Vec<SheetCell>,
    /// The number of photographs, and of those between two that are shown.
    count: usize,
    stride: usize,
}

/// A photograph.
#[derive(Clone, Debug)]
struct SheetCell {
    name: String,
    /// What is wrong with it, or nothing.
    mark: String,
    /// Width and height, pixels.
    size: [u32; 2],
    /// Dark and lit, as data URIs.
    images: [String; 2],
}

impl ContactSheet {
    /// An empty sheet for `count` photographs.
    pub fn new(title: &str, count: usize) -> Self {
        let stride = count.div_ceil(MOST).max(1);
        Self { title: title.to_owned(), cells: vec![], count, stride }
    }

    /// Whether the photograph with this index is shown: all are, or evenly spread ones and those with a mark.
    pub fn shows(&self, index: usize, mark: &str) -> bool {
        index.is_multiple_of(self.stride) || (!mark.is_empty() && self.cells.len() < 2 * MOST)
    }

    /// A photograph at the size of the sheet.
    pub fn shrunk(&self, image: &Image) -> Image {
        let shown = self.count.clamp(1, MOST) as f64;
        let aspect = f64::from(image.height) / f64::from(image.width.max(1));
        let [least, most] = WIDTHS;
        let width = (PIXELS / (2.0 * shown * aspect.max(1e-3))).sqrt().clamp(least, most);
        Picture::shrunk("", String::new(), image, width as u32).image
    }

    /// Adds a photograph, dark and lit, with what is wrong with it.
    pub fn add(&mut self, name: &str, mark: &str, images: [&Image; 2]) {
        let images = images.map(|image| self.shrunk(image));
        let size = [images[0].width, images[0].height];
        let images = images.map(|image| data_uri::jpeg_of_quality(&image, QUALITY));
        self.cells.push(SheetCell { name: name.to_owned(), mark: mark.to_owned(), size, images });
    }

    /// The sheet as a section of a page, in the order of the names.
    pub(super) fn html(&self) -> String {
        let mut cells: Vec<&SheetCell> = self.cells.iter().collect();
        cells.sort_by(|a, b| natural::compare(&a.name, &b.name));
        let title = escape(&self.title);
        let mut html = format!("<section>\n<h2>{title}</h2>\n");
        // Writing to a string cannot fail, so the results below are ignored.
        if cells.len() < self.count {
            let _ = writeln!(html, "<p>{} of {} photographs.</p>", cells.len(), self.count);
        }
        html.push_str("<div class=\"sheet\">\n");
        for SheetCell { name, mark, size: [width, height], images: [dark, lit] } in cells {
            let (name, mark) = (escape(name), escape(mark));
            let class = if mark.is_empty() { "" } else { " class=\"bad\"" };
            let picture = |uri: &str, kind: &str| {
                format!(
                    "<img loading=\"lazy\" src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"{name}, {kind}\">"
                )
            };
            let _ = writeln!(
                html,
                "<figure{class}><div>{}{}</div><figcaption>{name} <b>{mark}</b></figcaption></figure>",
                picture(dark, "dark"),
                picture(lit, "lit")
            );
        }
        html.push_str("</div>\n</section>\n");
        html
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_shows_every_photograph_in_order_and_is_bounded_for_large_sets() {
        let image = Image::filled(640, 480, [0.1; 3]);
        let mut sheet = ContactSheet::new("All", 12);
        for name in ["10", "9", "1", "12"] {
            assert!(sheet.shows(sheet.cells.len(), ""));
            sheet.add(name, if name == "9" { "blurred" } else { "" }, [&image, &image]);
        }
        let html = sheet.html();
        let at = |name: &str| html.find(&format!("alt=\"{name}, dark\"")).unwrap();
        assert!(at("1") < at("9") && at("9") < at("10") && at("10") < at("12"));
        assert_eq!(html.matches("class=\"bad\"").count(), 1);
        assert_eq!(html.matches("data:image/jpeg").count(), 8);
        assert_eq!(sheet.shrunk(&image).width, 320);

        let large = ContactSheet::new("All", 3000);
        assert!((0..3000).filter(|&index| large.shows(index, "")).count() <= MOST);
        assert!(large.shows(1, "blurred"));
        let small = large.shrunk(&image);
        assert!(small.width >= 96 && 2 * MOST * small.pixel_count() < 9_000_000, "{}", small.width);
    }
}
