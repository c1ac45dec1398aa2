//! The photographs that are mapped, and the files that they are written to.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nightsplat_core::input::unreadable;
use nightsplat_core::output::is_same_file;
use nightsplat_photographs::dataset::{Borders, Dataset, LoadOptions, Photograph, Split};
use nightsplat_photographs::image::files::{photographs_in, unread_in};
use nightsplat_photographs::image::{
    ColourCounts, Image, Levels, Mask, MaskFile, Orientation, PictureFile,
};
use nightsplat_photographs::tree;
use nightsplat_photographs::white_balance::WhiteBalanceMatrix;

use super::ToneRequest;
use crate::{Error, Result};

/// A photograph to map.
pub(super) struct InputPhotograph {
    /// The file name without extension.
    pub(super) name: String,
    pub(super) input: PathBuf,
    pub(super) reference: Option<PathBuf>,
    /// The split, in a dataset.
    pub(super) split: Option<Split>,
    /// Its mask.
    pub(super) mask: Option<MaskFile>,
    /// The file to write.
    pub(super) target: Option<PathBuf>,
    pub(super) balance: Option<WhiteBalanceMatrix>,
    /// The levels of the set.
    pub(super) levels: Levels,
    /// A large photograph is reduced: it is only measured.
    pub(super) is_reduced: bool,
    /// What the photographs of a dataset do not show at their borders.
    pub(super) borders: Arc<Borders>,
}

impl InputPhotograph {
    /// The photograph as stored, with the indices of pixels that are not finite or hidden by alpha or mask.
    pub(super) fn load(
        &self,
        inverted: bool,
        colours: &ColourCounts,
    ) -> Result<(Image, Vec<usize>)> {
        let file = PictureFile::open(&self.input)?.reduced(|size| self.decoded_size(size));
        let (mut image, alpha) = file.decode_counted(colours)?;
        if let Some(balance) = self.balance {
            balance.apply(&mut image);
        }
        let decoded = (&image, alpha.as_ref());
        let mask = Mask::over(&self.input, decoded, self.mask.as_ref(), inverted)?;
        let mask = self.borders.hide_borders(mask, (image.width, image.height));
        let hidden = mask.as_ref().map(Mask::hidden).unwrap_or_default();
        Ok((image, hidden))
    }

    /// The size at which a photograph or reference image of this size is decoded.
    pub(super) fn decoded_size(&self, size: (u32, u32)) -> (u32, u32) {
        if self.is_reduced { measured_only().decoded_size(size) } else { size }
    }

    /// Image and indices turned upright by Exif; photographs of a dataset stay as stored, as their cameras assume.
    pub(super) fn turned(&self, image: Image, gaps: Vec<usize>) -> (Image, Vec<usize>) {
        let orientation = match self.split {
            None => Orientation::from_file(&self.input),
            Some(_) => Orientation::UPRIGHT,
        };
        let is_gap = |value: &f32| *value > 0.0;
        let gaps = if gaps.is_empty() || orientation == Orientation::UPRIGHT {
            gaps
        } else {
            let mut marked = Image::filled(image.width, image.height, [0.0; 3]);
            gaps.iter().for_each(|&gap| marked.data[gap] = 1.0);
            let marked = orientation.upright(marked).data;
            (0..image.pixel_count()).filter(|&pixel| is_gap(&marked[pixel])).collect()
        };
        (orientation.upright(image), gaps)
    }
}

/// The photographs of the input: a file, those of a folder by name, or those of a dataset.
pub(super) fn listed(request: &ToneRequest<'_>) -> Result<Vec<InputPhotograph>> {
    let &ToneRequest { input, reference, out, curve: (_, ref config), .. } = request;
    std::fs::metadata(input).map_err(|error| unreadable(input, &error))?;
    let is_reduced = out.is_none();
    let mut photographs = if !tree::is_dir(input) {
        vec![plain(input, reference)?]
    } else if Dataset::is_at(input) {
        let loading = if is_reduced { measured_only() } else { LoadOptions::default() };
        let options = LoadOptions { reference: reference.map(Path::to_owned), ..loading };
        let of_dataset = Dataset::photographs(input, &options)?;
        let borders = Arc::new(Borders::of_photographs(&of_dataset, &options));
        let of_view = |Photograph { name, split, input, reference, mask }| InputPhotograph {
            name,
            input,
            reference,
            mask,
            split: Some(split),
            target: None,
            balance: None,
            levels: Levels::default(),
            is_reduced,
            borders: borders.clone(),
        };
        of_dataset.into_iter().map(of_view).collect()
    } else {
        let files = photographs_in(input)?;
        if let Some(line) = unread_in(input) {
            tracing::warn!("{line}");
        }
        let plain = |file: &PathBuf| plain(file, reference);
        let mut all: Vec<InputPhotograph> = files.iter().map(plain).collect::<Result<_>>()?;
        if let Some(line) =
            MaskFile::find_labels(all.iter_mut().filter_map(|one| one.mask.as_mut()))
        {
            tracing::warn!("{line}");
        }
        all
    };
    if photographs.is_empty() {
        return Err(Error::input(input, "contains no PNG, JPEG, WebP, TIFF or EXR image"));
    }
    let named = || photographs.iter().map(|one| (one.name.as_str(), one.input.as_path()));
    let training = photographs.iter().filter(|one| one.split != Some(Split::Test));
    let training: Vec<&Path> = training.map(|one| one.input.as_path()).collect();
    let levels = Levels::of_all(config.light, &training);
    levels.say();
    let balance = config.white_balance.as_ref();
    let balance = balance.map(|balance| balance.matrix(input, named(), levels)).transpose()?;
    for photograph in &mut photographs {
        (photograph.balance, photograph.levels) = (balance, levels);
        photograph.is_reduced = is_reduced;
    }
    if let Some(out) = out {
        set_targets(&mut photographs, out)?;
    }
    Ok(photographs)
}

/// Options with which a large photograph is decoded for its statistics alone.
fn measured_only() -> LoadOptions {
    LoadOptions { max_resolution: 1, ..LoadOptions::default() }
}

/// A photograph outside of a dataset.
fn plain(input: &Path, reference: Option<&Path>) -> Result<InputPhotograph> {
    let stem = input.file_stem().unwrap_or_default();
    let reference = match reference {
        Some(folder) if folder.is_dir() => {
            photographs_in(folder)?.into_iter().find(|file| file.file_stem() == Some(stem))
        }
        Some(file) if file.is_file() => Some(file.to_owned()),
        Some(absent) => return Err(Error::input(absent, "does not exist")),
        None => None,
    };
    let name = stem.to_string_lossy().into_owned();
    let masks = input.with_file_name("masks");
    let file = input.file_name().unwrap_or_default().to_string_lossy();
    let candidates = [format!("{name}.png"), format!("{file}.png")].map(|mask| masks.join(mask));
    let mask = candidates.into_iter().find(|mask| mask.is_file()).map(MaskFile::shown);
    let input = input.to_owned();
    let borders = Arc::default();
    Ok(InputPhotograph {
        name,
        input,
        reference,
        split: None,
        mask,
        target: None,
        balance: None,
        levels: Levels::default(),
        is_reduced: false,
        borders,
    })
}

/// Sets the file that each is written to, refusing duplicates and photographs.
fn set_targets(photographs: &mut [InputPhotograph], (out, extension): (&Path, &str)) -> Result<()> {
    let mut sources: Vec<PathBuf> = vec![];
    for listed in &*photographs {
        sources
            .extend([Some(listed.input.clone()), listed.reference.clone()].into_iter().flatten());
    }
    let mut seen: BTreeMap<String, PathBuf> = BTreeMap::new();
    for listed in photographs {
        let target = out.join(format!("{}.{extension}", listed.name));
        if let Some(other) = seen.insert(listed.name.clone(), listed.input.clone()) {
            let problem = format!(
                "would be written to the same file as {}; rename one of them",
                other.display()
            );
            return Err(Error::input(&listed.input, problem));
        }
        if target.exists() && sources.iter().any(|source| is_same_file(source, &target)) {
            return Err(Error::output(target, "is one of the photographs; choose another --out"));
        }
        listed.target = Some(target);
    }
    Ok(())
}
