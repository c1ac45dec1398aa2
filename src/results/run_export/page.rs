//! The page of a run: its model with bookmarks of views.

use glam::DVec3;
use nightsplat_core::natural;
use nightsplat_models::export::Provenance;
use nightsplat_models::export::page::{Bookmark, ModelPage, PageImage, SharedGlsl, Sharing, moved};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::ToneCurve;
use nightsplat_report::jpeg;
use serde_json::json;

use super::{ExportOptions, has_networks};
use crate::Result;
use crate::gpu::Gpu;
use crate::kernels::camera_pinhole::JACOBIAN_MARGIN;
use crate::kernels::lamp::{LAMP_FARTHEST, LAMP_KNEE, LAMP_LEFT, LAMP_NEAREST};
use crate::kernels::splat::{ALPHA_MIN, DILATION};
use crate::results::eval::ModelRenderer;
use crate::results::finished_run::{FinishedRun, is_model};
use crate::results::run;
use crate::splats::render::RenderSettings;
use crate::targets::Targets;
use crate::train::TrainConfig;

/// What the viewer of a page has in common with the kernels.
pub(crate) const SHARED_GLSL: SharedGlsl = SharedGlsl {
    constants: &[
        ("ALPHA_MIN", ALPHA_MIN),
        ("ALPHA_MAX", RenderSettings::MAX_ALPHA as f64),
        ("DILATION", DILATION),
        ("JACOBIAN_MARGIN", JACOBIAN_MARGIN),
        ("LAMP_NEAREST", LAMP_NEAREST),
        ("LAMP_FARTHEST", LAMP_FARTHEST),
        ("LAMP_KNEE", LAMP_KNEE),
        ("LAMP_LEFT", LAMP_LEFT),
    ],
    harmonics: include_str!("../../../shaders-glsl/include/sh.glsl"),
};

/// The largest share of a page's bytes that photographs take where its size is limited.
const PICTURES: f64 = 0.4;

impl ExportOptions<'_> {
    /// The page without its model, with bookmarks of test views, or of all views if there are none. Its viewer has a
    /// pinhole camera: photographs of a fisheye are undistorted and cropped to 60 degrees off the axis.
    pub(super) fn page(
        &self,
        config: &TrainConfig,
        origin: DVec3,
        provenance: Provenance,
    ) -> Result<ModelPage<'static>> {
        let mut opened = None;
        let (dataset, mut renderer) = if has_networks(config) {
            let undistort = |config: &mut TrainConfig| config.undistort = true;
            let run = FinishedRun::open_with(self.source, self.dataset, &self.opener, undistort)?;
            opened = Some(run.gpu);
            (run.dataset, Some(run.model_renderer))
        } else {
            let config = self.with_dataset(config);
            let mut options = config.load_options();
            options.load_low_test = true;
            options.undistort = true;
            (Dataset::load(&config.dataset, &options)?, None)
        };
        let device = || opened.map_or_else(|| self.opener.open(config), Ok);
        let targets = targets(config, &dataset, device)?;
        let mut bookmarks = self.bookmarks(origin, &dataset, targets, renderer.as_mut())?;
        let sharing = self.sharing(&provenance.dataset, &bookmarks);
        encode(&mut bookmarks, self.max_size.map(|most| (most as f64 * PICTURES) as usize));
        let is_model = is_model(self.source);
        let frame = if is_model { dataset.frame() } else { config.frame.unwrap_or_default() };
        let near = provenance.facts.near.or(config.facts(&frame).near);
        let camera = |view: &View| moved(&view.upright_camera(), origin);
        Ok(ModelPage {
            sharing,
            gaussians: None,
            provenance,
            bookmarks,
            cameras: dataset.views.iter().map(camera).collect(),
            shows_cameras: false,
            origin,
            fingerprint: None,
            near: near.unwrap_or_else(|| RenderSettings::default().near).into(),
            up: self.up_of(config).unwrap_or_else(|| dataset.up()),
            lamp: if is_model {
                None
            } else {
                run::load_lamp(self.source)?.map(|lamp| json!(lamp))
            },
        })
    }

    /// What the page says of itself. Its poster is the first view in normal light: as a reference image or a render, or
    /// as the model was trained on it.
    fn sharing(&self, dataset: &str, bookmarks: &[Bookmark]) -> Sharing {
        let pictures = bookmarks.first().map(|first| first.pictures.as_slice()).unwrap_or_default();
        let poster = pictures.last().and_then(|(_, picture)| match picture {
            PageImage::Embedded(image) => Some(image.clone()),
            PageImage::At(_) => None,
        });
        let file = self.poster_path().and_then(|path| Some(path.file_name()?.to_str()?.to_owned()));
        let folder = self.address.map(|address| match address.rsplit_once('/') {
            Some((folder, page)) if page.ends_with(".html") => folder,
            _ => address.trim_end_matches('/'),
        });
        Sharing {
            title: self.title.map_or_else(|| format!("{dataset} by nightsplat"), str::to_owned),
            text: self.text.unwrap_or_default().to_owned(),
            poster,
            poster_address: folder.zip(file).map(|(folder, file)| format!("{folder}/{file}")),
        }
    }

    /// Bookmarks of evenly spread views, with photographs, reference images or targets, and renders.
    fn bookmarks(
        &self,
        origin: DVec3,
        dataset: &Dataset,
        targets: Option<Targets>,
        mut renderer: Option<&mut ModelRenderer>,
    ) -> Result<Vec<Bookmark>> {
        let mut views: Vec<&View> = dataset.test_views().collect();
        if views.is_empty() {
            views = dataset.views.iter().collect();
        }
        let (all, count) = (views.len(), self.views.clamp(1, views.len().max(1)));
        let bookmark = |number: usize| {
            let view = views[number * all / count];
            let mut pictures: Vec<(&str, Image)> = vec![];
            pictures.extend(view.loaded()?.map(|image| ("photograph", image.into_owned())));
            if let Some(image) = view.loaded_reference()? {
                pictures.push(("reference", image.into_owned()));
            } else if let Some(targets) = &targets {
                pictures.extend(targets.target(view)?.map(|image| ("target", image)));
            }
            if let Some(renderer) = &mut renderer {
                pictures.push(("model with its networks", renderer.render(view)?.output().clone()));
            }
            // A mirrored photograph is of a mirrored world, which the page shows as it is.
            let turned = |(label, image): (&str, Image)| {
                let image = view.orientation.turn().upright(image);
                (label.to_owned(), PageImage::Embedded(image))
            };
            Ok(Bookmark {
                name: view.name.clone(),
                camera: moved(&view.upright_camera(), origin),
                pictures: pictures.into_iter().map(turned).collect(),
            })
        };
        let mut bookmarks = (0..count).map(bookmark).collect::<Result<Vec<_>>>()?;
        bookmarks.sort_by(|a, b| natural::compare(&a.name, &b.name));
        Ok(bookmarks)
    }
}

/// Encodes the images once; as many bytes together as this at most, at smaller sizes.
fn encode(bookmarks: &mut [Bookmark], most: Option<usize>) {
    let encoded = |scale: f64, bookmarks: &[Bookmark]| -> Vec<String> {
        let scaled = |side: u32| (f64::from(side) * scale).round() as u32;
        let encoded = |(_, picture): &(String, PageImage)| match picture {
            PageImage::Embedded(image) => {
                jpeg(&image.resized(scaled(image.width), scaled(image.height)))
            }
            PageImage::At(address) => address.clone(),
        };
        bookmarks.iter().flat_map(|bookmark| &bookmark.pictures).map(encoded).collect()
    };
    let (mut scale, mut images) = (1.0, encoded(1.0, bookmarks));
    let bytes = |images: &[String]| images.iter().map(String::len).sum::<usize>();
    while scale > 0.05 && most.is_some_and(|most| bytes(&images) > most) {
        scale *= 0.75;
        images = encoded(scale, bookmarks);
    }
    let pictures = bookmarks.iter_mut().flat_map(|bookmark| &mut bookmark.pictures);
    pictures.zip(images).for_each(|((_, picture), image)| *picture = PageImage::At(image));
}

/// What makes the targets of views that have a photograph and no reference image, where there are such views and a
/// curve. Without a device the page has no targets.
fn targets(
    config: &TrainConfig,
    dataset: &Dataset,
    gpu: impl FnOnce() -> Result<Gpu>,
) -> Result<Option<Targets>> {
    let lacks = |view: &View| view.has_photograph() && !view.has_reference();
    if config.tone.curve == ToneCurve::None || !dataset.views.iter().any(lacks) {
        return Ok(None);
    }
    match gpu() {
        Ok(gpu) => Targets::new(&gpu, &config.tone, dataset).map(Some),
        Err(error) => {
            tracing::warn!("the page has no targets to compare with: {error}");
            Ok(None)
        }
    }
}
