//! What shows photographs, scores and runs, without Vulkan: a self-contained HTML page of tables, charts and images,
//! without external resources, and other files. Part of `nightsplat`, whose API is what it exports of it.
//!
//! - [`colour_map`]: numbers as colours
//! - [`tensorboard`]: event files for `TensorBoard`
//! - [`video`]: frames as a video

use std::fmt::Write as _;

use nightsplat_photographs::image::Image;

pub use self::chart::{Chart, Mark, Series, VerticalLine};
pub use self::data_uri::{base64, jpeg, jpeg_of_quality};
pub use self::distribution::{Distribution, distributions};
pub use self::sheet::ContactSheet;
pub use self::table::{Best, Column, NumberTable};

mod axis;
mod chart;
pub mod colour_map;
mod data_uri;
mod distribution;
mod labels;
mod sheet;
mod table;
pub mod tensorboard;
pub mod video;

/// A page. All text is escaped.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// The heading, also the window's title.
    pub title: String,
    /// A page to look into, first of all: address and text.
    pub window: Option<[String; 2]>,
    /// The paragraphs under the heading.
    pub intro: Vec<String>,
    /// Links under the introduction: address and text.
    pub links: Vec<[String; 2]>,
    /// Contact sheets, in order.
    pub sheets: Vec<ContactSheet>,
    /// Rows of images, in order.
    pub comparisons: Vec<Comparison>,
    /// Tables of text, in order.
    pub facts: Vec<TextTable>,
    /// Tables of numbers, in order.
    pub tables: Vec<NumberTable>,
    /// Charts, in order.
    pub charts: Vec<Chart>,
}

/// A table of text.
#[derive(Clone, Debug, Default)]
pub struct TextTable {
    /// The caption.
    pub title: String,
    /// A name and its value in each row.
    pub rows: Vec<[String; 2]>,
}

/// Images of one view side by side.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    /// The view's name.
    pub title: String,
    /// From left to right.
    pub pictures: Vec<Picture>,
}

/// An image with a caption.
#[derive(Clone, Debug)]
pub struct Picture {
    /// What it shows.
    pub caption: String,
    /// Its scores in a few words, or empty.
    pub scores: String,
    /// The image, embedded as an 8-bit PNG.
    pub image: Image,
}

impl Picture {
    /// An image shrunk to at most `width` pixels.
    pub fn shrunk(caption: &str, scores: String, image: &Image, width: u32) -> Self {
        let width = image.width.min(width);
        let height = u64::from(image.height) * u64::from(width) / u64::from(image.width.max(1));
        let image = image.resized(width, height as u32);
        Self { caption: caption.to_owned(), scores, image }
    }
}

impl Report {
    /// The page as HTML: the first table of text, images, the other tables, charts.
    pub fn html(&self) -> String {
        let mut facts = self.facts.iter().map(TextTable::html);
        let first = facts.next().unwrap_or_default() + &self.pictures_html();
        let others = facts.collect::<String>() + &self.tables_html() + &self.charts_html();
        self.page(&(first + &others))
    }

    /// The page as HTML with the charts first and the tables last.
    pub fn html_charts_first(&self) -> String {
        self.page(&(self.charts_html() + &self.pictures_html() + &self.tables_html()))
    }

    fn tables_html(&self) -> String {
        self.tables.iter().map(NumberTable::html).collect()
    }

    /// The charts as HTML, a figure each.
    pub fn charts_html(&self) -> String {
        let figure = |chart: &Chart| format!("<figure class=\"plot\">{}</figure>\n", chart.svg());
        let plots: String = self.charts.iter().map(figure).collect();
        if plots.is_empty() { plots } else { format!("<div class=\"plots\">\n{plots}</div>\n") }
    }

    fn pictures_html(&self) -> String {
        let sheets = self.sheets.iter().map(ContactSheet::html);
        sheets.chain(self.comparisons.iter().map(Comparison::html)).collect()
    }

    /// The page around its body.
    pub fn page(&self, body: &str) -> String {
        let title = escape(&self.title);
        let mut html = format!(
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{}</style>\n</head>\n<body>\n<h1>{title}</h1>\n",
            include_str!("style.css")
        );
        // Writing to a string cannot fail, so the results below are ignored.
        if let Some([address, text]) = &self.window {
            let (address, text) = (escape(address), escape(text));
            let frame = format!("<iframe src=\"{address}\" title=\"{text}\"></iframe>");
            let _ = writeln!(html, "{frame}\n<p><a href=\"{address}\">{text}</a></p>");
        }
        for paragraph in &self.intro {
            let _ = writeln!(html, "<p>{}</p>", escape(paragraph));
        }
        for [address, text] in &self.links {
            let (address, text) = (escape(address), escape(text));
            let _ = writeln!(html, "<p><a href=\"{address}\">{text}</a></p>");
        }
        html + body + "</body>\n</html>\n"
    }
}

impl TextTable {
    fn html(&self) -> String {
        let row = |[name, value]: &[String; 2]| {
            format!("<tr><th scope=\"row\">{}</th><td>{}</td></tr>\n", escape(name), escape(value))
        };
        let rows: String = self.rows.iter().map(row).collect();
        let title = escape(&self.title);
        format!(
            "<table class=\"facts\">\n<caption>{title}</caption>\n<tbody>\n{rows}</tbody>\n</table>\n"
        )
    }
}

impl Comparison {
    fn html(&self) -> String {
        let mut html =
            format!("<section>\n<h2>{}</h2>\n<div class=\"pictures\">\n", escape(&self.title));
        for Picture { caption, scores, image } in &self.pictures {
            let caption = escape(caption);
            let _ = writeln!(
                html,
                "<figure><img src=\"{}\" width=\"{}\" height=\"{}\" alt=\"{caption}\">\
                 <figcaption><b>{caption}</b> <span>{}</span></figcaption></figure>",
                data_uri::png(image),
                image.width,
                image.height,
                escape(scores)
            );
        }
        html.push_str("</div>\n</section>\n");
        html
    }
}

/// Escapes text for HTML and SVG, also within a quoted attribute.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
    }
    escaped
}
