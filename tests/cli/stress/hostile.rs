//! The scene of a case: a small ordinary one, parts of which are made hostile.

use std::ops::Range;

use nightsplat::bench::scene;
use nightsplat::{Error, Result};
use nightsplat_core::camera::TrainingFrame;
use nightsplat_photographs::dataset::{Point, View};
use nightsplat_photographs::exposures::{Affine, table};

use crate::common::prelude::*;

/// A dataset, its first Gaussians unless they come from its points, and the indices of the hostile ones.
pub(super) struct Hostile {
    pub(super) dataset: Dataset,
    pub(super) gaussians: Option<Gaussians>,
    pub(super) config: TrainConfig,
    pub(super) concerned: Range<usize>,
    /// Files named by the configuration.
    pub(super) files: Option<tempfile::TempDir>,
}

/// Enough for every SH degree to be used.
const STEPS: u64 = 3;

/// Neighbours of the hostile Gaussians.
const NEIGHBOURS: usize = 12;

/// Steps that do the same work, in the dataset's world, without density control.
fn config() -> TrainConfig {
    let mut config =
        TrainConfig { steps: STEPS, frame: Some(TrainingFrame::WORLD), ..TrainConfig::bare() };
    config.tone = ToneSettings::new(ToneCurve::Ap3);
    config.schedule.sh_degree_interval = 1;
    config.schedule.initial_rate_factor = 1.0;
    config.schedule.densify_after = i64::MAX as u64;
    config.schedule.resolution_steps = Some([0, 0]);
    config
}

impl Hostile {
    /// `count` Gaussians in the middle of a view of this size, at depth 3 and some pixels wide, and farther neighbours.
    pub(super) fn gaussians(
        count: usize,
        size: [u32; 2],
        made: impl Fn(&mut Gaussians, usize),
    ) -> Self {
        Self::seen_by(scene::camera(size[0], size[1]), count, made)
    }

    /// [`gaussians`] in front of another camera.
    pub(super) fn seen_by(
        camera: Camera,
        count: usize,
        made: impl Fn(&mut Gaussians, usize),
    ) -> Self {
        Self::beside(NEIGHBOURS, camera, count, made)
    }

    /// A single Gaussian without neighbours.
    pub(super) fn alone([width, height]: [u32; 2]) -> Self {
        Self::beside(0, scene::camera(width, height), 1, |_, _| ())
    }

    fn beside(
        neighbours: usize,
        camera: Camera,
        count: usize,
        made: impl Fn(&mut Gaussians, usize),
    ) -> Self {
        let mut gaussians = scene::gaussians(&camera, count + neighbours, 3);
        let stream = Stream::new(14, 0);
        for i in 0..count {
            let draw = |k: u64| stream.normal(8 * i as u64 + k) as f32;
            gaussians.means_mut()[i] = Vec3::new(0.01, 0.02, 3.0);
            gaussians.quats_mut()[i] = [0, 1, 2, 3].map(draw);
            let pixel = (3.0 / camera.focal.x) as f32;
            gaussians.log_scales_mut()[i] =
                Vec3::new(4.0, 2.5, 1.5).map(|pixels| (pixels * pixel).ln());
            gaussians.raw_opacities_mut()[i] = 0.0;
            gaussians.dc_mut()[i] = Vec3::new(0.2, -0.4, 0.1);
            made(&mut gaussians, i);
        }
        let photograph = scene::dark(camera.width, camera.height);
        let dataset = Dataset {
            root: PathBuf::from("a hostile set"),
            views: vec![View::new("view", Split::Train, camera, Some(photograph))],
            points: vec![Point { position: DVec3::Z, views: vec![0] }],
            skipped: vec![],
        };
        Self {
            dataset,
            gaussians: Some(gaussians),
            config: config(),
            concerned: 0..count,
            files: None,
        }
    }

    /// No hostile Gaussian, but a photograph.
    pub(super) fn photograph(color: impl Fn(u32, u32) -> [f32; 3]) -> Self {
        let mut hostile = Self::gaussians(1, [32, 24], |_, _| ());
        hostile.dataset.views[0].image = Some(Image::from_fn(32, 24, color));
        hostile
    }

    /// Photographs in EXR files, read by the loader; `value` of linear light, column and row. The first Gaussians are
    /// the dataset's own.
    pub(super) fn exr(value: impl Fn(f32, u32, u32) -> f32) -> Result<Self> {
        let config = config();
        let files = tempfile::tempdir()
            .map_err(|error| Error::output(std::env::temp_dir(), error.to_string()))?;
        let options = small_set(4, [32, 24], 14);
        nightsplat_synth::write(files.path(), &options)?;
        let low = files.path().join("low");
        for name in 0..options.views {
            let png = low.join(format!("{name:03}.png"));
            let mut image = Image::load(&png)?;
            let (width, pixels) = (image.width as usize, image.pixel_count());
            for (at, linear) in image.data.iter_mut().enumerate() {
                let (x, y) = (at % pixels % width, at % pixels / width);
                *linear = value(linear_from_srgb(*linear), x as u32, y as u32);
            }
            // The content determines the format, not the file's name.
            image.save_exr_as_stored(&png)?;
        }
        let dataset = Dataset::load(files.path(), &config.load_options())?;
        Ok(Self { dataset, gaussians: None, config, concerned: 0..0, files: Some(files) })
    }

    /// With learned exposures, where that of the first view starts with a gain.
    pub(super) fn exposed(mut self, gain: f32) -> Result<Self> {
        let files = tempfile::tempdir()
            .map_err(|error| Error::output(std::env::temp_dir(), error.to_string()))?;
        let path = files.path().join("exposures.csv");
        let affine = Affine { gain: [gain.into(); 3], bias: [0.0; 3] };
        // Exposures are relative to their mean, so another view starts without one.
        let mut other = self.dataset.views[0].clone();
        other.name = "view without gain".to_owned();
        table::save(&path, &[(self.dataset.views[0].name.clone(), affine)])?;
        self.dataset.views.push(other);
        self.config.exposure.learn = true;
        self.config.exposure.start = Some(path);
        self.files = Some(files);
        Ok(self)
    }
}

/// At the origin, with a focal length in pixels.
pub(super) fn camera_of_focal(focal: f64, [width, height]: [u32; 2]) -> Camera {
    Camera { focal: DVec2::splat(focal), ..scene::camera(width, height) }
}
