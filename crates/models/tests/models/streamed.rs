//! Streamed SOG: its index, its chunks, and what is refused.

use std::fs;
use std::io::{Cursor, Write as _};
use std::path::Path;

use glam::DVec3;
use nightsplat_core::Result;
use nightsplat_core::random::Stream;
use nightsplat_models::export::Provenance;
use nightsplat_models::export::streamed::{self, Division, INDEX, TileLoader, Written};
use nightsplat_models::files;
use nightsplat_models::gaussians::Gaussians;
use nightsplat_models::levels::level;
use serde_json::Value;
use zip::write::{SimpleFileOptions, ZipWriter};

use crate::common::{Folder, contents, paths};

/// Tiles of 300 and of 130 Gaussians side by side, each with an origin of its own.
fn tiles() -> [Gaussians; 2] {
    [(300, 0.0), (130, 8.0)].map(|(count, x)| {
        let mut gaussians = Gaussians::zeros(count, 1);
        let stream = Stream::new(count as u64, 3);
        for (index, value) in (0..).zip(&mut gaussians.parameters) {
            *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
        }
        gaussians.means_mut().iter_mut().for_each(|mean| *mean *= 4.0);
        gaussians.log_scales_mut().iter_mut().for_each(|scale| *scale -= 2.0);
        gaussians.origin = DVec3::new(1000.0 + x, -5.0, 0.0);
        gaussians
    })
}

fn written(folder: &Path, models: &[Gaussians], division: Division) -> Result<Written> {
    let name = |index: usize| Path::new("model").join(index.to_string());
    let tiles: Vec<TileLoader<'_>> = models
        .iter()
        .enumerate()
        .map(|(index, model)| TileLoader::whole(&name(index), model))
        .collect();
    streamed::write(folder, &tiles, &Provenance::default(), division)
}

fn index(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join(INDEX)).unwrap()).unwrap()
}

/// The Gaussians of a chunk, given by the path of its description.
fn chunk(folder: &Path, meta: &str) -> Gaussians {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    for path in paths(folder.join(meta).parent().unwrap()) {
        let name = path.file_name().unwrap().to_str().unwrap();
        zip.start_file(name, SimpleFileOptions::default()).unwrap();
        zip.write_all(&fs::read(&path).unwrap()).unwrap();
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), zip.finish().unwrap().into_inner()).unwrap();
    files::read(file.path()).unwrap().0
}

fn corner(node: &Value, which: &str) -> DVec3 {
    let numbers = node["bound"][which].as_array().unwrap();
    DVec3::from_array([0, 1, 2].map(|axis| numbers[axis].as_f64().unwrap()))
}

/// The leaves, from the left; asserts that every other node has two children within its box.
fn leaves(node: &Value) -> Vec<&Value> {
    let Some(children) = node["children"].as_array() else { return vec![node] };
    assert!(children.len() == 2 && node.get("lods").is_none(), "{node}");
    for child in children {
        assert!(corner(child, "min").cmpge(corner(node, "min")).all());
        assert!(corner(child, "max").cmple(corner(node, "max")).all());
    }
    children.iter().flat_map(leaves).collect()
}

/// The largest distance, and the largest differences of scales, opacities and colours, of Gaussians and their nearest.
fn errors(gaussians: &Gaussians, other: &Gaussians) -> [f32; 4] {
    (0..gaussians.count).fold([0.0; 4], |most, i| {
        let offset = (gaussians.origin - other.origin).as_vec3();
        let distance = |j: &usize| (gaussians.means()[i] + offset).distance(other.means()[*j]);
        let j = (0..other.count).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        let opacity =
            |model: &Gaussians, index: usize| 1.0 / (1.0 + (-model.raw_opacities()[index]).exp());
        let error = [
            distance(&j),
            (gaussians.log_scales()[i] - other.log_scales()[j]).abs().max_element(),
            (opacity(gaussians, i) - opacity(other, j)).abs(),
            (gaussians.dc()[i] - other.dc()[j]).abs().max_element(),
        ];
        [0, 1, 2, 3].map(|k| most[k].max(error[k]))
    })
}

#[test]
fn the_index_finds_every_gaussian_of_every_level_once_and_chunks_are_our_levels() {
    let (folder, models) = (Folder::empty(), tiles());
    let division = Division { levels: Some(3), chunk: 160 };
    let Written { counts, chunks } = written(&folder, &models, division).unwrap();
    // Cells of at most 40: eight of 37 or 38, and four of 32 or 33.
    assert_eq!(counts, [430, 4 * 19 + 4 * 19 + 2 * 16 + 2 * 17, 8 * 10 + 2 * 8 + 2 * 9]);
    let index = index(&folder);
    let names = index["filenames"].as_array().unwrap();
    assert_eq!((names.len(), index["version"].as_u64()), (chunks, Some(1)));
    assert_eq!(index["count"], counts.iter().sum::<usize>());
    assert_eq!(index["counts"], serde_json::json!(counts));
    assert_eq!(index["lodLevels"], 3);
    let leaves = leaves(&index["tree"]);
    assert_eq!(leaves.len(), 12);

    let mut ends = vec![0; names.len()];
    let mut found: Vec<Vec<Gaussians>> = vec![vec![]; 3];
    for leaf in &leaves {
        let errors: Vec<f64> = leaf["errors"]
            .as_array()
            .unwrap()
            .iter()
            .map(|error| error.as_f64().unwrap())
            .collect();
        assert!(errors.len() == 3 && errors[0] == 0.0 && errors.is_sorted(), "{errors:?}");
        for (level, found) in found.iter_mut().enumerate() {
            let entry = &leaf["lods"][level.to_string()];
            let [file, offset, count] =
                ["file", "offset", "count"].map(|key| entry[key].as_u64().unwrap() as usize);
            let name = names[file].as_str().unwrap();
            assert!(name.starts_with(&format!("{level}_")), "{name}");
            assert_eq!(offset, ends[file], "{name}: a gap");
            ends[file] += count;
            let indices: Vec<u32> = (offset as u32..(offset + count) as u32).collect();
            let cell = chunk(&folder, name).select(&indices);
            for mean in cell.means() {
                let mean = mean.as_dvec3();
                assert!(
                    mean.cmpge(corner(leaf, "min")).all() && mean.cmple(corner(leaf, "max")).all()
                );
            }
            found.push(cell);
        }
    }
    for (name, end) in names.iter().zip(ends) {
        assert_eq!(chunk(&folder, name.as_str().unwrap()).count, end, "{name}");
        assert!(end <= division.chunk);
    }
    for (k, cells) in found.iter().enumerate() {
        let all = Gaussians::concatenated(&cells.iter().collect::<Vec<_>>());
        assert_eq!(all.origin, models[0].origin);
        for model in &models {
            let errors = errors(&level(model, &[model.count], division.cell(), k), &all);
            let most = [1e-3, 0.1, 0.003, 0.05];
            assert!(errors.iter().zip(most).all(|(error, most)| *error < most), "{k}: {errors:?}");
        }
    }
}

#[test]
fn the_same_tiles_are_the_same_bytes_and_replace_an_earlier_export() {
    let [first, second] = [(); 2].map(|()| Folder::empty());
    let division = Division { levels: None, chunk: 100 };
    let models = tiles();
    written(&first, &models, division).unwrap();
    written(&second, &models[..1], Division { chunk: 16, ..division }).unwrap();
    written(&second, &models, division).unwrap();
    assert!(contents(&first) == contents(&second));
    // 430 Gaussians are 54 on the fourth level.
    assert_eq!(index(&first)["lodLevels"], 4);
}

#[test]
fn a_folder_with_anything_else_and_tiles_that_changed_are_refused_and_nothing_is_lost() {
    let folder = Folder::empty();
    let [model, _] = tiles();
    let division = Division::default();
    folder.write("letter.txt", "mine");
    let problem = written(&folder, std::slice::from_ref(&model), division).unwrap_err().to_string();
    assert!(problem.contains("letter.txt") && contents(&folder).len() == 1, "{problem}");
    fs::remove_file(folder.path("letter.txt")).unwrap();

    let mut tile = TileLoader::whole(Path::new("0007.ply"), &model);
    tile.count += 1;
    let provenance = Provenance::default();
    let problem = streamed::write(&folder, &[tile], &provenance, division).unwrap_err();
    assert!(problem.to_string().contains("0007.ply: has 300 Gaussians, not 301"), "{problem}");
    assert!(!folder.path(INDEX).exists());
    let problem = written(&folder, &[Gaussians::zeros(0, 1)], division).unwrap_err();
    assert!(problem.to_string().contains("without Gaussians"), "{problem}");
}
