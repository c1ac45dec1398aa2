//! One page with the model, its viewer, and images to compare with. It opens from disk and needs only WebGL 2. Without
//! the model it is the page of `view`, which asks its server for model, images and progress.
//!
//! The viewer projects, shades and blends as the kernels do: a test view on the page equals the render of `eval` up to
//! the rounding of the model to half floats.

mod sharing;

use glam::{DAffine3, DVec3};
use half::f16;
use nightsplat_core::camera::{Camera, CameraModel, CameraPath};
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::Image;
use nightsplat_report::{base64, escape, jpeg};
use serde_json::{Value, json};

pub use self::sharing::Sharing;
use super::{GENERATOR, Provenance, gzip};
use crate::gaussians::{Gaussians, ModelFacts, rest_coefficients};

/// The scripts of the page, in one scope.
const VIEWER: [&str; 9] = [
    include_str!("viewer/draw.js"),
    include_str!("viewer/camera.js"),
    include_str!("viewer/stage.js"),
    include_str!("viewer/fly.js"),
    include_str!("viewer/compare.js"),
    include_str!("viewer/edit.js"),
    include_str!("viewer/frusta.js"),
    include_str!("viewer/live.js"),
    include_str!("viewer/page.js"),
];

/// The most cameras that tell the page where photographs were taken; of more, evenly spread ones.
const MOST_CAMERAS: usize = 96;
/// The poses of the automatic flight.
const FLIGHT: usize = 96;

/// A bookmark: a camera and images of its view.
#[derive(Clone, Debug)]
pub struct Bookmark {
    /// The view's name.
    pub name: String,
    /// A pinhole camera in the coordinates of the Gaussians.
    pub camera: Camera,
    /// Captions and images.
    pub pictures: Vec<(String, PageImage)>,
}

/// An image to compare with.
#[derive(Clone, Debug)]
pub enum PageImage {
    /// Part of the page.
    Embedded(Image),
    /// Fetched when it is shown, from an address relative to the page.
    At(String),
}

/// What the shaders of a page have in common with the kernels, in GLSL.
#[derive(Clone, Copy, Debug)]
pub struct SharedGlsl {
    /// Names and values; that of `ALPHA_MAX` is of models that state none.
    pub constants: &'static [(&'static str, f64)],
    /// The basis of spherical harmonics.
    pub harmonics: &'static str,
}

/// The contents of a page.
#[derive(Clone, Debug)]
pub struct ModelPage<'a> {
    /// Its title, and how links show it.
    pub sharing: Sharing,
    /// In the colours that viewers expect; `None`: fetched from the page's server, as often as they change.
    pub gaussians: Option<&'a Gaussians>,
    /// Provenance, shown on the page.
    pub provenance: Provenance,
    /// The page opens at the first.
    pub bookmarks: Vec<Bookmark>,
    /// All cameras of the dataset, as those of the bookmarks: where the page's camera may go, and the automatic flight.
    pub cameras: Vec<Camera>,
    /// Whether the page shows cameras in space as it opens.
    pub shows_cameras: bool,
    /// The world position that the coordinates of the Gaussians are relative to.
    pub origin: DVec3,
    /// The checksum of the model by which edit lists name it; `None`: the page edits nothing, or its server knows it.
    pub fingerprint: Option<String>,
    /// Near plane, in the coordinates of the Gaussians.
    pub near: f64,
    /// The up direction, a unit vector in the coordinates of the Gaussians.
    pub up: DVec3,
    /// The lamp that lit the photographs, which the page's camera can carry: the fields of the viewer's `lamp`.
    pub lamp: Option<Value>,
}

impl ModelPage<'_> {
    /// The page as HTML.
    pub fn html(&self, shared: &SharedGlsl) -> Result<String> {
        let Self { sharing, gaussians, provenance, bookmarks, cameras, up, .. } = self;
        let other = bookmarks.iter().find(|bookmark| bookmark.camera.model != CameraModel::Pinhole);
        if let Some(Bookmark { name, .. }) = other {
            return Err(Error::Usage(format!(
                "view {name} is a fisheye, and the page renders pinhole cameras; load its dataset with --undistort"
            )));
        }
        let seen = cameras.iter().step_by(cameras.len().div_ceil(MOST_CAMERAS).max(1));
        let scene = json!({
            "generator": GENERATOR,
            "provenance": provenance.lines(),
            "isLive": gaussians.is_none(),
            "showsCameras": self.shows_cameras,
            "model": self.fingerprint,
            "origin": self.origin.to_array(),
            "near": self.near,
            "up": up.to_array(),
            "lamp": self.lamp,
            "views": bookmarks.iter().map(view).collect::<Vec<_>>(),
            "cameras": seen.map(lens_and_pose).collect::<Vec<_>>(),
            "path": flight(cameras, *up)?,
        });
        let packed = |gaussians: &Gaussians| Ok::<_, Error>(base64(&gzip(&packed(gaussians))?));
        let model = gaussians.map(packed).transpose()?.unwrap_or_default();
        let shader = |text| shared.shader(text, &provenance.facts);
        let (style, viewer) = (include_str!("viewer/style.css"), VIEWER.concat());
        let parts = [
            ("@HEAD@", sharing.head(&viewer, style, gaussians.is_none())),
            ("@TITLE@", escape(&sharing.title)),
            ("@TEXT@", sharing.paragraph()),
            ("@POSTER@", sharing.embedded()),
            ("@STYLE@", style.to_owned()),
            // No `<` in the data may end its script element.
            ("@SCENE@", scene.to_string().replace('<', "\\u003c")),
            ("@VERTEX@", shader(include_str!("viewer/splat.vert"))),
            ("@FRAGMENT@", shader(include_str!("viewer/splat.frag"))),
            ("@VIEWER@", viewer),
            ("@MODEL@", model),
        ];
        let mut html = String::new();
        let mut rest = include_str!("viewer/page.html");
        while let Some((at, (mark, part))) = parts
            .iter()
            .filter_map(|part| Some((rest.find(part.0)?, part)))
            .min_by_key(|found| found.0)
        {
            html.push_str(&rest[..at]);
            html.push_str(part);
            rest = &rest[at + mark.len()..];
        }
        Ok(html + rest)
    }
}

/// The same camera in a world whose origin is moved to `origin`.
pub fn moved(camera: &Camera, origin: DVec3) -> Camera {
    let DAffine3 { matrix3, translation } = camera.view_from_world;
    let view_from_world = DAffine3 { matrix3, translation: translation + matrix3 * origin };
    Camera { view_from_world, ..*camera }
}

impl SharedGlsl {
    /// A shader of the page, with the constants and functions that it shares with the kernels.
    fn shader(&self, text: &str, facts: &ModelFacts) -> String {
        let float = |(name, value): &(&str, f64)| {
            let stated = facts.max_alpha.filter(|_| *name == "ALPHA_MAX").map(f64::from);
            format!("const float {name} = {:?};\n", stated.unwrap_or(*value))
        };
        let floats: String = self.constants.iter().map(float).collect();
        let constants = format!("{floats}const bool ANTIALIASED = {};", facts.antialiased);
        text.replace("@CONSTANTS@", &constants).replace("@HARMONICS@", self.harmonics)
    }
}

/// World to view along the automatic flight, which is closed; none through fewer than two cameras.
fn flight(cameras: &[Camera], up: DVec3) -> Result<Vec<[f32; 12]>> {
    if cameras.len() < 2 {
        return Ok(vec![]);
    }
    let path = CameraPath::suited_about(cameras, up);
    let pose = |camera: &Camera| camera.view_from_world.to_cols_array().map(|value| value as f32);
    let mut poses: Vec<_> = path.cameras_about(cameras, up, FLIGHT)?.iter().map(pose).collect();
    if path == CameraPath::Interpolate {
        // From the last camera back again.
        let back: Vec<_> = poses.iter().rev().copied().collect();
        poses.extend(back);
    }
    Ok(poses)
}

fn lens_and_pose(camera: &Camera) -> Value {
    let Camera { width, height, focal, principal_point, view_from_world, .. } = camera;
    json!({
        "size": [width, height],
        "focal": focal.to_array(),
        "principalPoint": principal_point.to_array(),
        "viewFromWorld": view_from_world.to_cols_array(),
    })
}

fn view(bookmark: &Bookmark) -> Value {
    let Bookmark { name, camera, pictures } = bookmark;
    let pictures = pictures.iter().map(|(label, picture)| {
        let image = match picture {
            PageImage::Embedded(image) => jpeg(image),
            PageImage::At(address) => address.clone(),
        };
        json!({ "label": label, "image": image })
    });
    let mut view = lens_and_pose(camera);
    view["name"] = name.as_str().into();
    view["pictures"] = pictures.collect();
    view
}

/// The model as the viewer reads it: the number of Gaussians and the SH degree in 32 bits each, positions as floats,
/// then the other attributes as half floats: opacity, log scales, rotation and coefficients, Gaussian by Gaussian.
/// Degrees whose coefficients are all 0 are omitted.
pub fn packed(gaussians: &Gaussians) -> Vec<u8> {
    let gaussians = &gaussians.with_sh_degree(gaussians.sh_degree_in_use());
    let sh_degree = gaussians.shape.sh_degree;
    let mut bytes = [gaussians.count as u32, sh_degree].map(u32::to_le_bytes).concat();
    bytes.extend_from_slice(bytemuck::cast_slice(gaussians.means()));
    let coefficients = rest_coefficients(sh_degree);
    let mut push =
        |value: f32| bytes.extend(f16::from_f32(value.clamp(-65_504.0, 65_504.0)).to_le_bytes());
    gaussians.raw_opacities().iter().for_each(|&value| push(value));
    gaussians.log_scales().iter().flat_map(|scale| scale.to_array()).for_each(&mut push);
    gaussians.quats().iter().flat_map(|&quat| super::unit(quat)).for_each(&mut push);
    for (i, dc) in gaussians.dc().iter().enumerate() {
        dc.to_array().into_iter().for_each(&mut push);
        let rest = &gaussians.rest()[coefficients * i..][..coefficients];
        rest.iter().flat_map(|value| value.to_array()).for_each(&mut push);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::drawn;
    use nightsplat_core::camera::KannalaBrandt;

    const SHARED: SharedGlsl = SharedGlsl {
        constants: &[("ALPHA_MAX", 0.99), ("DILATION", 0.3)],
        harmonics: "void sh_basis()",
    };

    #[test]
    fn a_page_is_one_file_and_no_name_in_it_ends_a_script() {
        let gaussians = drawn(5, 1);
        let camera = Camera {
            width: 40,
            height: 30,
            focal: glam::DVec2::splat(35.0),
            principal_point: glam::DVec2::new(20.0, 15.0),
            model: CameraModel::Pinhole,
            view_from_world: DAffine3::IDENTITY,
        };
        let evil = "</script><b>@MODEL@";
        let picture = PageImage::Embedded(Image::from_fn(4, 3, |_, _| [0.5; 3]));
        let picture = (evil.to_owned(), picture);
        let page = ModelPage {
            sharing: Sharing {
                title: evil.to_owned(),
                text: evil.to_owned(),
                ..Sharing::default()
            },
            gaussians: Some(&gaussians),
            provenance: Provenance { dataset: evil.to_owned(), ..Provenance::default() },
            bookmarks: vec![Bookmark { name: evil.to_owned(), camera, pictures: vec![picture] }],
            cameras: vec![camera; 200],
            shows_cameras: false,
            origin: DVec3::ZERO,
            fingerprint: None,
            near: 0.2,
            up: DVec3::NEG_Y,
            lamp: None,
        };
        let html = page.html(&SHARED).unwrap();
        let mut of_fisheye = page.clone();
        of_fisheye.bookmarks[0].camera.model = CameraModel::Fisheye(KannalaBrandt::default());
        let refused = of_fisheye.html(&SHARED).unwrap_err().to_string();
        assert!(refused.contains("fisheye") && refused.contains("undistort"), "{refused}");
        assert!(!html.contains("<b>"));
        let constant = |name: &str, value: f64| format!("const float {name} = {value:?};");
        assert!(html.contains(&constant("DILATION", 0.3)) && html.contains("void sh_basis("));
        assert_eq!(html.matches(&constant("ALPHA_MAX", 0.99)).count(), 2);
        assert!(html.contains("const bool ANTIALIASED = false;"));
        let facts = ModelFacts { antialiased: true, max_alpha: Some(0.5), ..Default::default() };
        let provenance = Provenance { facts, ..Provenance::default() };
        let compensated = ModelPage { provenance, ..page.clone() }.html(&SHARED).unwrap();
        assert!(compensated.contains("const bool ANTIALIASED = true;"));
        assert_eq!(compensated.matches(&constant("ALPHA_MAX", 0.5)).count(), 2);
        let lamp = Some(json!({ "reference_distance": 1.0 }));
        let lit = ModelPage { lamp, ..page.clone() }.html(&SHARED).unwrap();
        assert!(lit.contains("\"reference_distance\":1.0") && html.contains("\"lamp\":null"));
        assert_eq!(html.matches("<script").count(), html.matches("</script>").count());
        assert!(html.contains("<meta property=\"og:title\"") && !html.contains("og:image"));
        assert!(html.contains("script-src 'sha256-") && !html.contains("-inline"));
        let poses = html.matches("\"viewFromWorld\"").count();
        assert_eq!(poses, 1 + 67, "of 200 cameras, every third");
        for outside in ["http://", "https://", "src=\"/", "@import"] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert_eq!(packed(&gaussians).len(), 8 + 5 * (12 + 2 * (1 + 3 + 4 + 12)));
    }
}
