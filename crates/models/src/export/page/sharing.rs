//! What a page says of itself to those who open or link it: title, text, poster, and what its browser may do.

use nightsplat_core::Result;
use nightsplat_photographs::image::{Image, ImageFile};
use nightsplat_report::{base64, escape, jpeg_of_quality};
use sha2::{Digest, Sha256};

/// The widths of a poster, pixels: beside the page, where services that show a link fetch it, and within the page.
const POSTER_WIDTH: u32 = 1200;
const EMBEDDED_WIDTH: u32 = 480;
const POSTER_QUALITY: u8 = 85;
const EMBEDDED_QUALITY: u8 = 60;

/// The title of a page, and how links show it.
#[derive(Clone, Debug, Default)]
pub struct Sharing {
    /// The window's title, and the first line over the picture.
    pub title: String,
    /// A sentence below the title; may be empty.
    pub text: String,
    /// Shown until the model is.
    pub poster: Option<Image>,
    /// The address at which the poster will lie. Services that show a link read no picture from within a page.
    pub poster_address: Option<String>,
}

impl Sharing {
    /// Policy, description and Open Graph tags of a page with this script and style, which asks its server or not.
    pub(super) fn head(&self, script: &str, style: &str, asks: bool) -> String {
        let hash = |text: &str| format!("'sha256-{}'", base64(&Sha256::digest(text)));
        let (script, style) = (hash(script), hash(style));
        let server = if asks { " 'self'; connect-src 'self'" } else { "" };
        let policy = format!(
            "default-src 'none'; script-src {script}; style-src {style}; worker-src blob:; base-uri 'none'; \
             form-action 'none'; img-src data: blob:{server}"
        );
        let mut head =
            format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n");
        let mut tag = |kind: &str, name: &str, content: &str| {
            head += &format!("<meta {kind}=\"{name}\" content=\"{}\">\n", escape(content));
        };
        if asks {
            return head;
        }
        tag("property", "og:type", "website");
        tag("property", "og:title", &self.title);
        if !self.text.is_empty() {
            tag("name", "description", &self.text);
            tag("property", "og:description", &self.text);
        }
        if let Some(address) = &self.poster_address {
            tag("property", "og:image", address);
            tag("property", "og:image:alt", &self.title);
            tag("name", "twitter:card", "summary_large_image");
        }
        head
    }

    /// The text as a paragraph.
    pub(super) fn paragraph(&self) -> String {
        if self.text.is_empty() { String::new() } else { format!("<p>{}</p>", escape(&self.text)) }
    }

    /// The poster as an element of the page.
    pub(super) fn embedded(&self) -> String {
        let Some(poster) = &self.poster else { return String::new() };
        let uri = jpeg_of_quality(&narrowed(poster, EMBEDDED_WIDTH), EMBEDDED_QUALITY);
        format!("<img id=\"poster\" src=\"{uri}\" alt=\"\">")
    }

    /// The poster as a JPEG file, for services that show links.
    pub fn poster_file(&self) -> Result<Option<Vec<u8>>> {
        let file = |poster: &Image| narrowed(poster, POSTER_WIDTH).to_jpeg(POSTER_QUALITY);
        self.poster.as_ref().map(file).transpose()
    }
}

/// The image, no wider than this.
fn narrowed(image: &Image, most: u32) -> Image {
    let width = image.width.min(most);
    image.resized(
        width,
        (u64::from(image.height) * u64::from(width) / u64::from(image.width.max(1))) as u32,
    )
}
