//! Loads the views of one lens.

use std::path::PathBuf;
use std::sync::Arc;

use nightsplat_core::camera::{Camera, Lens};
use nightsplat_core::hash::Hasher;
use nightsplat_core::{Error, Result};

use super::Loading;
use crate::dataset::depth::depth_map;
use crate::dataset::loaded::LoadedView;
use crate::dataset::original::Original;
use crate::dataset::packed::Packed;
use crate::dataset::prepare::{Preparation, check_size};
use crate::dataset::shading::Shading;
use crate::dataset::source::ViewFiles;
use crate::dataset::turns::Turns;
use crate::dataset::{MeasuredSize, NormalMap, Split, View};
use crate::image::{ColourCounts, Image, Mask, MaskFile, Orientation, PictureFile};
use crate::tone::MeasuredPhotograph;

/// Loads the views of one lens.
pub(super) struct ViewLoader<'a> {
    pub(super) preparation: Preparation<'a>,
    /// At the world's origin.
    pub(super) camera: Camera,
    /// The pixels of `camera` that a fisheye does not see.
    pub(super) unseen: Vec<usize>,
    pub(super) loading: &'a Loading<'a>,
}

/// A picture of a view.
struct DecodedPicture {
    path: PathBuf,
    /// As it is stored.
    image: Image,
    alpha: Option<Image>,
    turns: Turns,
    /// Whether the file holds linear light.
    is_light: bool,
    /// Its size as it is decoded, if that is known from its header.
    decoded_size: Option<(u32, u32)>,
}

impl DecodedPicture {
    /// Its file, to be read again.
    fn original(&self, lens: &Lens, undistort: bool) -> Original {
        let mut original = Original::new(self.path.clone(), *lens, undistort, self.turns);
        original.decoded_size = self.decoded_size;
        original
    }
}

/// The pixels of a photograph or reference image as loaded, and its file if these are not all of it.
type InMemory = (Option<Image>, Option<Original>);

impl ViewLoader<'_> {
    pub(super) fn load(&self, source: ViewFiles) -> Result<LoadedView> {
        let Self { preparation, camera, unseen, loading } = self;
        let ViewFiles {
            name,
            split,
            view_from_world,
            input,
            reference,
            target,
            mask: mask_file,
            depth,
            normals,
            read,
            turns,
            size,
            ..
        } = source;
        let (options, [read, read_reference]) = (loading.options, read);
        let mut problems = Vec::new();
        let [colours, reference_colours] = loading.colours;
        let mut photograph = self.decode(input, read, turns[0], colours, &mut problems)?;
        if let (Some(balance), Some(photograph)) = (loading.balance, &mut photograph) {
            balance.apply(&mut photograph.image);
        }
        let reference =
            self.decode(reference, read_reference, turns[1], reference_colours, &mut problems)?;
        let picture = photograph.as_ref().or(reference.as_ref());
        let orientation = picture.map(|picture| picture.turns.viewing).unwrap_or_default();
        let mut file_that_hides = None;
        let stored_mask = match picture {
            Some(DecodedPicture { path, image, alpha, turns, .. }) => {
                let decoded = (image, alpha.as_ref());
                let stored = Mask::over(path, decoded, mask_file.as_ref(), options.invert_masks)?;
                let hides = |mask: &&MaskFile| {
                    let is_all = alpha.is_none() && stored.as_ref().is_some_and(Mask::hides_all);
                    is_all && mask.is_inverted == options.invert_masks
                };
                file_that_hides = mask_file.as_ref().filter(hides);
                let stored = loading.borders.hide_borders(stored, (image.width, image.height));
                stored.map(|stored| (stored, path.clone(), turns.loading))
            }
            None => None,
        };
        if let (Some(observer), Some(photograph), Split::Train) =
            (loading.observer, &photograph, split)
        {
            observer(&name, &photograph.image, stored_mask.as_ref().map(|(stored, ..)| stored));
        }
        let mask = stored_mask
            .map(|(stored, path, orientation)| preparation.mask(&stored, &path, orientation));
        let mask = Mask::masked_at(mask.transpose()?.flatten(), preparation.size, unseen);
        let brightness = [&photograph, &reference]
            .map(|decoded| decoded.as_ref().map(|decoded| mean(&decoded.image)));
        let reference_original =
            reference.as_ref().map(|decoded| decoded.original(preparation.lens, options.undistort));
        let is_hidden = mask.as_ref().is_some_and(Mask::hides_all);
        if is_hidden {
            problems.push(match file_that_hides {
                Some(MaskFile { path, .. }) => {
                    let path = path.display();
                    format!("{name}: {path}: the mask is black everywhere; white pixels count")
                }
                None => format!("{name}: no pixel is a number that its mask shows"),
            });
        }
        let shading = Shading::new(options.falloff, options.bands.as_ref(), &name);
        let photograph = photograph
            .filter(|_| !is_hidden)
            .map(|decoded| self.photograph(decoded, mask.as_ref(), shading, split == Split::Train));
        let (image, original) = photograph.transpose()?.unwrap_or_default();
        let reference =
            reference.filter(|_| !is_hidden).map(|decoded| self.reference_image(decoded));
        let (reference, reference_file) = reference.transpose()?.unwrap_or_default();
        let target_file = target.map(|path| self.target(path, turns[0], size)).transpose()?;
        let unused = |problem| tracing::warn!("the depth of view {name} is not used: {problem}");
        let depth = depth.and_then(|path| {
            depth_map(&path, preparation, options.depth.is_disparity).map_err(unused).ok()
        });
        let normals = normals.and_then(|path| {
            let unused = |problem| {
                tracing::warn!("the normals of view {name} are not used: {problem}");
            };
            NormalMap::load(&path, preparation, options.normals.axes).map_err(unused).ok()
        });
        let view = View::new(&name, split, Camera { view_from_world, ..*camera }, image);
        let unit = colours.levels().unit();
        let view =
            View { orientation, original, unit, reference, reference_file, mask, depth, ..view };
        let view = View { target_file, normals, ..view };
        let view = (split == Split::Test || view.has_photograph()).then_some(view);
        Ok(LoadedView { name, view, problems, brightness, reference: reference_original })
    }

    /// Decodes a file; `None`, and a problem, where that is no picture.
    fn decode(
        &self,
        path: Option<PathBuf>,
        read: Option<Arc<PictureFile>>,
        turns: Turns,
        colours: &ColourCounts,
        problems: &mut Vec<String>,
    ) -> Result<Option<DecodedPicture>> {
        let lens = self.preparation.lens;
        let Some(path) = path else { return Ok(None) };
        let options = self.loading.options;
        let file = match read {
            Some(read) => Ok(Arc::unwrap_or_clone(read)),
            None => {
                let file = PictureFile::open(&path);
                file.map(|file| file.reduced(|size| options.decoded_size(size)))
            }
        };
        let decoded_size = file.as_ref().ok().and_then(|file| file.decoded_size().ok());
        if let Ok(file) = &file {
            check_size(&path, file, turns, lens)?;
        }
        let is_light = file.as_ref().is_ok_and(|file| file.is_light(&colours.levels()));
        match file.and_then(|file| file.decode_counted(colours)) {
            Ok((image, alpha)) => {
                Ok(Some(DecodedPicture { path, image, alpha, turns, is_light, decoded_size }))
            }
            Err(error) => {
                problems.push(error.to_string());
                Ok(None)
            }
        }
    }

    /// The photograph of a view; one for training is measured as the options say.
    fn photograph(
        &self,
        decoded: DecodedPicture,
        mask: Option<&Mask>,
        shading: Shading,
        is_training: bool,
    ) -> Result<InMemory> {
        let Self { preparation, loading, .. } = self;
        let options = loading.options;
        let mut original = decoded.original(preparation.lens, options.undistort);
        let DecodedPicture { path, image, turns, is_light, .. } = decoded;
        let whole = preparation.photograph(turns.loading.upright(image), &path, shading)?;
        let whole = if is_light { preparation.shrunk_in_light(whole) } else { whole };
        let is_shrunk = preparation.size != (whole.width, whole.height);
        let is_kept = options.keep != Some(0);
        if is_kept && !is_shrunk {
            return Ok((Some(whole), None));
        }
        (original.balance, original.shading) = (loading.balance, shading);
        original.levels = loading.colours[0].levels();
        original.light_size = is_light.then_some(preparation.size);
        let measured = |image: &Image| match mask {
            Some(mask) => MeasuredPhotograph::measure(&mask.counted(image)),
            None => MeasuredPhotograph::measure(&image.data),
        };
        let at = if is_training { options.measured } else { MeasuredSize::None };
        if at == MeasuredSize::Own {
            original.measured = Some((at, measured(&whole)));
            if is_shrunk {
                let packed = Packed::new(&whole);
                if loading.originals.take(packed.bytes()) {
                    original.store(packed);
                }
            }
        }
        let image = preparation.shrunk(whole);
        if is_kept {
            return Ok((Some(image), Some(original)));
        }
        if at == MeasuredSize::Loaded {
            original.measured = Some((at, measured(&image)));
        }
        let mut hasher = Hasher::default();
        hasher.write(bytemuck::cast_slice(&image.data));
        original.checksum = Some(hasher);
        Ok((None, Some(original)))
    }

    /// The file of a target, which has the size of its photograph, as it is stored or turned as the camera took it.
    fn target(&self, path: PathBuf, turns: Turns, taken: (u32, u32)) -> Result<Original> {
        let size = PictureFile::open(&path)?.size()?;
        let Preparation { lens, size: loaded, .. } = self.preparation;
        let sizes = [taken, (lens.width, lens.height), loaded];
        let loading = match [turns.loading, Orientation::UPRIGHT, turns.viewing.inverse()]
            .into_iter()
            .find(|turn| sizes.contains(&turn.size(size)))
        {
            Some(loading) => loading,
            None => {
                let ([width, height], [w, h]) = (<[u32; 2]>::from(size), <[u32; 2]>::from(taken));
                let problem = format!(
                    "is {width}x{height}, its photograph {w}x{h}; targets have the size of their photographs"
                );
                return Err(Error::input(path, problem));
            }
        };
        let undistort = self.loading.options.undistort;
        Ok(Original::new(path, *lens, undistort, Turns { loading, ..turns }))
    }

    fn reference_image(&self, decoded: DecodedPicture) -> Result<InMemory> {
        let Self { preparation, loading, .. } = self;
        if loading.options.keep == Some(0) {
            let original = decoded.original(preparation.lens, loading.options.undistort);
            return Ok((None, Some(original)));
        }
        let DecodedPicture { path, image, turns, .. } = decoded;
        Ok((Some(preparation.loaded(turns.loading.upright(image), &path)?), None))
    }
}

/// The mean of a subset of an image's values.
fn mean(image: &Image) -> f32 {
    let some = image.data.iter().step_by(97);
    let count = some.len().max(1) as f32;
    some.sum::<f32>() / count
}
