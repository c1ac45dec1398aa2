//! A dataset of varying exposure, made from one in normal light.
//!
//! ```text
//! v = encode(min(1, 2^s decode(x)))^g        for each photograph: s uniform within the stops, ln g within ln gamma
//! ```
//!
//! The paper's third benchmark, Mip-NeRF 360 with varying exposure, cannot be repeated: neither its pictures' generator
//! nor its numbers are published. Luminance-GS, whose pictures they are, changes exposure and gamma; the paper's code
//! describes them as a darkening by gamma. This set is neither of them, and repeatable.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::Path;

use nightsplat_core::camera::{Camera, CameraModel};
use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_core::random::Stream;
use nightsplat_core::{Error, Result, csv};
use nightsplat_photographs::dataset::{Dataset, Split, View};
use nightsplat_photographs::image::{Image, ImageFile, linear_from_srgb, srgb_from_linear};
use nightsplat_photographs::tone::{Exposure, LuminanceHistogram};

/// The variation of a set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variation {
    /// Each photograph is brighter or darker by up to this many stops of linear light.
    pub stops: f64,
    /// The smallest and the largest exponent of encoded values.
    pub gamma: [f64; 2],
    /// Of the drawn numbers.
    pub seed: u64,
}

/// One photograph's stops and exponent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Varied {
    /// Factor on linear light, as a power of two.
    pub stops: f64,
    /// Exponent of encoded values.
    pub gamma: f64,
}

/// Names of the folders and files of a set: varied and clean photographs, and the drawn numbers.
const VARIED: &str = "low";
const CLEAN: &str = "images";
const TABLE: &str = "varied.csv";

impl Variation {
    fn check(&self) -> Result<()> {
        let Self { stops, gamma: [low, high], .. } = *self;
        if !(0.0..=10.0).contains(&stops) {
            return Err(Error::Usage(format!("{stops} stops are not 0 to 10")));
        }
        if !(low >= 0.1 && high <= 10.0 && low <= high) {
            let rule = "two numbers from 0.1 to 10, the lower first";
            return Err(Error::Usage(format!("a gamma of {low},{high} is not {rule}")));
        }
        Ok(())
    }

    /// The numbers of the photograph at this place in the order of names.
    pub fn of_photograph(&self, index: usize) -> Varied {
        let stream = Stream::new(self.seed, 0);
        let draw = |which| stream.uniform(2 * index as u64 + which);
        let [low, high] = self.gamma.map(f64::ln);
        Varied {
            stops: self.stops * (2.0 * draw(0) - 1.0),
            gamma: (low + (high - low) * draw(1)).exp(),
        }
    }
}

impl Varied {
    /// The varied photograph, before it is rounded to 8 bits.
    pub fn applied(self, image: &Image) -> Image {
        let (light, gamma) = (self.stops.exp2() as f32, self.gamma as f32);
        let vary = |&x: &f32| srgb_from_linear((light * linear_from_srgb(x)).min(1.0)).powf(gamma);
        Image { data: image.data.iter().map(vary).collect(), ..*image }
    }
}

/// Writes a COLMAP set: varied photographs, clean ones as references, cameras and points, the split, and a table of the
/// drawn numbers. Warns if the photographs are dark. Returns how many photographs it has.
///
/// # Errors
/// The variation is invalid, a camera is a fisheye, a photograph can no longer be read, or a file cannot be written.
pub fn write(dir: &Path, dataset: &Dataset, variation: &Variation) -> Result<usize> {
    variation.check()?;
    let views: Vec<&View> = dataset.views.iter().filter(|view| view.has_photograph()).collect();
    if let Some(View { name, .. }) =
        views.iter().find(|view| view.camera.model != CameraModel::Pinhole)
    {
        let problem = format!("view {name} is a fisheye; undistort its photographs first");
        return Err(Error::input(&dataset.root, problem));
    }
    let sparse = dir.join("sparse/0");
    for folder in [&dir.join(VARIED), &dir.join(CLEAN), &sparse] {
        create_folder(folder)?;
    }
    let (mut table, mut tests) = ("name,stops,gamma\n".to_owned(), String::new());
    let mut luminances = vec![];
    for (index, view) in views.iter().enumerate() {
        let Some(image) = view.loaded()? else { continue };
        luminances.push(LuminanceHistogram::new(&view.counted(&image)));
        let (name, varied) = (file_name(view), variation.of_photograph(index));
        image.save_png8(dir.join(CLEAN).join(&name))?;
        varied.applied(&image).save_png8(dir.join(VARIED).join(&name))?;
        let numbers = [varied.stops, varied.gamma].map(|number| format!("{number:.6}"));
        table += &csv::line([&view.name, &numbers[0], &numbers[1]]);
        if view.split == Split::Test {
            let _ = writeln!(tests, "{name}");
        }
    }
    if let Some(exposure) =
        Exposure::measure(&luminances, None).filter(|exposure| exposure.weight() > 0.0)
    {
        tracing::warn!(
            "{}: the {} photographs are dark (mean luminance {:.3}): varied exposures of dark photographs have no \
             clean reference",
            dataset.root.display(),
            luminances.len(),
            exposure.mean
        );
    }
    for (name, text) in colmap(&views, dataset) {
        write_whole(&sparse.join(name), text.as_bytes())?;
    }
    write_whole(&dir.join("test.txt"), tests.as_bytes())?;
    write_whole(&dir.join(TABLE), table.as_bytes())?;
    Ok(views.len())
}

fn file_name(view: &View) -> String {
    format!("{}.png", view.name)
}

/// The files of a COLMAP text model: a camera for each view, without keypoints.
fn colmap(views: &[&View], dataset: &Dataset) -> [(&'static str, String); 3] {
    let (mut cameras, mut images, mut points) = (String::new(), String::new(), String::new());
    for (index, view) in views.iter().enumerate() {
        let (id, name) = (index + 1, file_name(view));
        let Camera { width, height, focal, principal_point, view_from_world, .. } = view.camera;
        let (_, turn, shift) = view_from_world.to_scale_rotation_translation();
        let lens = [focal.x, focal.y, principal_point.x, principal_point.y];
        let pose = [turn.w, turn.x, turn.y, turn.z, shift.x, shift.y, shift.z];
        let [lens, pose] = [&lens[..], &pose]
            .map(|all| all.iter().map(f64::to_string).collect::<Vec<_>>().join(" "));
        let _ = writeln!(cameras, "{id} PINHOLE {width} {height} {lens}");
        let _ = writeln!(images, "{id} {pose} {id} {name}\n");
    }
    let ids: HashMap<&str, usize> =
        views.iter().enumerate().map(|(index, view)| (view.name.as_str(), index + 1)).collect();
    for (index, point) in dataset.points.iter().enumerate() {
        let [x, y, z] = point.position.to_array();
        let _ = write!(points, "{} {x} {y} {z} 128 128 128 0", index + 1);
        for view in &point.views {
            if let Some(id) = ids.get(dataset.views[*view as usize].name.as_str()) {
                let _ = write!(points, " {id} 0");
            }
        }
        points.push('\n');
    }
    [("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", points)]
}
