//! Streamed SOG of a model in tiles, which are read one at a time.

use std::borrow::Cow;
use std::path::PathBuf;

use super::{ExportArgs, own_file, provenance, streamed_line, up};
use crate::Result;
use crate::results::export::Provenance;
use crate::results::export::streamed::{self, Division, Tile};
use crate::results::run;
use crate::splats::joined::Manifest;

/// Writes the tiles of a manifest, and returns the folder and a line on its contents.
pub(super) fn write(args: &ExportArgs, manifest: &Manifest) -> Result<(PathBuf, String)> {
    let config = run::load_config(&args.run)?;
    let (rotation, turned) = args.rotation(&config).unwrap_or_default();
    let facts = config.facts(&config.frame.unwrap_or_default());
    let provenance = Provenance { rotation, facts, ..provenance(args, &config) };
    let tiles: Vec<Tile<'_>> = manifest
        .tiles
        .iter()
        .map(|tile| Tile {
            name: manifest.folder.join(&tile.file),
            count: tile.count,
            load: Box::new(move || Ok(Cow::Owned(up::turned(manifest.read(tile)?, rotation)))),
        })
        .collect();
    let out = args.out.clone().unwrap_or_else(|| own_file(args));
    let division = Division { levels: args.levels, chunk: args.chunk };
    let written = streamed::write(&out, &tiles, &provenance, division)?;
    let line = streamed_line(&out, &written, &turned);
    Ok((out, line))
}
