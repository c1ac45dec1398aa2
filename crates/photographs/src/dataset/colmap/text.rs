//! The text encoding: one record per line (images: two), fields separated by spaces, `#` for comments.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use glam::DVec3;
use nightsplat_core::camera::Lens;
use nightsplat_core::{Error, Result};

use super::{ModelImage, ModelPoint, lens, pose};
use crate::tree;

pub(super) fn cameras(path: &Path) -> Result<BTreeMap<u32, Lens>> {
    let text = tree::text(path)?;
    let camera = |(number, line)| {
        let mut fields = Fields::new(path, number, line);
        let (id, model): (u32, String) = (fields.next("camera id")?, fields.next("model")?);
        let (width, height) = (fields.side("width")?, fields.side("height")?);
        let parameters = fields.rest("parameter")?;
        let lens = lens(&model, width, height, &parameters);
        Ok((id, lens.map_err(|problem| Error::input(path, format!("camera {id} {problem}")))?))
    };
    records(&text).map(camera).collect()
}

pub(super) fn images(path: &Path) -> Result<Vec<ModelImage>> {
    let text = tree::text(path)?;
    let mut lines = lines(&text).peekable();
    let mut images = Vec::new();
    while let Some((number, line)) = lines.next() {
        if line.is_empty() {
            continue;
        }
        let mut fields = Fields::new(path, number, line);
        let id = fields.next("image id")?;
        let mut numbers = [0.0; 7];
        for value in &mut numbers {
            *value = fields.next("pose")?;
        }
        let [w, x, y, z, tx, ty, tz] = numbers;
        let camera = fields.next("camera id")?;
        let name = fields.line.trim().to_owned();
        if name.is_empty() {
            return Err(fields.error("name"));
        }
        images.push(ModelImage {
            id,
            camera,
            name,
            view_from_world: pose([w, x, y, z], [tx, ty, tz]),
        });
        // The line of keypoints, empty if there are none, which the tracks of points repeat. Scripts omit it.
        lines.next_if(|(_, line)| !is_image(line));
    }
    Ok(images)
}

/// Whether a line is that of an image, and not of keypoints, which are three numbers each.
fn is_image(line: &str) -> bool {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let are_numbers = |fields: &[&str]| fields.iter().all(|field| field.parse::<f64>().is_ok());
    let are_keypoints = fields.len().is_multiple_of(3) && are_numbers(&fields);
    let is_whole = |field: &str| field.parse::<u32>().is_ok();
    !are_keypoints
        && fields.len() >= 10
        && is_whole(fields[0])
        && are_numbers(&fields[1..8])
        && is_whole(fields[8])
}

pub(super) fn points(path: &Path) -> Result<BTreeMap<u64, ModelPoint>> {
    let text = tree::text(path)?;
    let point = |(number, line)| {
        let mut fields = Fields::new(path, number, line);
        let id: u64 = fields.next("point id")?;
        let position = DVec3::new(fields.next("x")?, fields.next("y")?, fields.next("z")?);
        let _color: [f64; 3] = [fields.next("red")?, fields.next("green")?, fields.next("blue")?];
        let _error: f64 = fields.next("error")?;
        let track: Vec<u32> = fields.rest("track")?;
        if !track.len().is_multiple_of(2) {
            return Err(fields.error("keypoint"));
        }
        Ok((id, ModelPoint { position, images: track.into_iter().step_by(2).collect() }))
    };
    records(&text).map(point).collect()
}

/// Numbered from 1, without comments, trimmed.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    lines.filter(|(_, line)| !line.starts_with('#'))
}

fn records(text: &str) -> impl Iterator<Item = (usize, &str)> {
    lines(text).filter(|(_, line)| !line.is_empty())
}

struct Fields<'a> {
    path: &'a Path,
    number: usize,
    line: &'a str,
}

impl<'a> Fields<'a> {
    fn new(path: &'a Path, number: usize, line: &'a str) -> Self {
        Self { path, number, line }
    }

    fn next<T: FromStr>(&mut self, what: &str) -> Result<T> {
        let line = self.line.trim_start();
        let (field, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        self.line = rest;
        field.parse().map_err(|_| self.error(what))
    }

    /// A number of pixels; tools also write 500.0.
    fn side(&mut self, what: &str) -> Result<u64> {
        let pixels: f64 = self.next(what)?;
        let is_whole = pixels.fract() == 0.0 && (0.0..=u64::MAX as f64).contains(&pixels);
        if is_whole { Ok(pixels as u64) } else { Err(self.error(what)) }
    }

    fn rest<T: FromStr>(&mut self, what: &str) -> Result<Vec<T>> {
        let rest = std::mem::take(&mut self.line);
        rest.split_whitespace().map(|field| field.parse().map_err(|_| self.error(what))).collect()
    }

    fn error(&self, what: &str) -> Error {
        let problem =
            format!("line {} has no readable {what}; copy it again or export it anew", self.number);
        Error::input(self.path, problem)
    }
}
