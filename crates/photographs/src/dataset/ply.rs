//! Points that lie in a PLY file: x, y and z of its vertices, in any of its encodings.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use nightsplat_core::input::unreadable;
use nightsplat_core::ply::{PlyEncoding, PlyHeader, PlyProperty, PlyScalar};
use nightsplat_core::{Error, Result};

use crate::tree;

/// A file of points.
#[derive(Clone, Debug)]
pub(super) struct Cloud {
    pub(super) file: PathBuf,
    /// What a listing applied to its cameras, and perhaps not to the points.
    pub(super) applied: Option<DAffine3>,
}

/// The finite points of a file. Normals and colours are skipped: they may come from normal-light photographs.
pub(super) fn points(path: &Path) -> Result<Vec<DVec3>> {
    let cannot = |error| unreadable(path, &error);
    let no_points =
        |problem: &str| Error::input(path, format!("{problem}; its points are not read"));
    let header = PlyHeader::read(&mut tree::open(path).map_err(cannot)?).map_err(cannot)?;
    let header = header.unwrap_or_else(|| Err("is not a PLY file".to_owned()));
    let header = header.map_err(|problem| no_points(&problem))?;
    let bytes = tree::bytes(path)?;
    if header.properties.iter().any(|property| property.name.starts_with("f_dc_")) {
        return Err(no_points("is a model of Gaussians, not of points"));
    }
    let body = &bytes[header.length..];
    let axes = ["x", "y", "z"].map(|axis| header.property(axis));
    let [Some(x), Some(y), Some(z)] = axes else { return Err(no_points("has no x, y and z")) };
    let points = match header.encoding {
        PlyEncoding::Text => {
            of_text(&String::from_utf8_lossy(body), &header, [x, y, z].map(|(field, _)| field))
        }
        _ => of_bytes(body, &header, [x, y, z].map(|(_, property)| property)),
    };
    let mut points = points.ok_or_else(|| no_points("is cut short or damaged"))?;
    points.retain(|point| point.is_finite());
    Ok(points)
}

fn of_bytes(body: &[u8], header: &PlyHeader, axes: [&PlyProperty; 3]) -> Option<Vec<DVec3>> {
    let body = body.get(..header.count.checked_mul(header.stride)?)?;
    let number = |vertex: &[u8], property: &PlyProperty| {
        let mut bytes = [0; 8];
        let size = property.kind.size();
        bytes[..size].copy_from_slice(&vertex[property.at..property.at + size]);
        if header.encoding == PlyEncoding::Big {
            bytes[..size].reverse();
        }
        value(property.kind, bytes)
    };
    let point = |vertex: &[u8]| DVec3::from_array(axes.map(|property| number(vertex, property)));
    Some(body.chunks_exact(header.stride.max(1)).map(point).collect())
}

/// The value of a number's bytes, the least significant first.
fn value(kind: PlyScalar, bytes: [u8; 8]) -> f64 {
    let unsigned = u64::from_le_bytes(bytes);
    match kind {
        PlyScalar::Float(4) => f64::from(f32::from_bits(unsigned as u32)),
        PlyScalar::Float(_) => f64::from_bits(unsigned),
        PlyScalar::Unsigned(_) => unsigned as f64,
        PlyScalar::Signed(size) => {
            let unused = 64 - 8 * size as u32;
            ((unsigned << unused) as i64 >> unused) as f64
        }
    }
}

/// Of the places of x, y and z in a line.
fn of_text(body: &str, header: &PlyHeader, axes: [usize; 3]) -> Option<Vec<DVec3>> {
    let lines = body.lines().filter(|line| !line.trim().is_empty()).take(header.count);
    let point = |line: &str| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let mut point = DVec3::ZERO;
        for (axis, field) in axes.into_iter().enumerate() {
            point[axis] = fields.get(field)?.parse().ok()?;
        }
        Some(point)
    };
    let points = lines.map(point).collect::<Option<Vec<DVec3>>>()?;
    (points.len() == header.count).then_some(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, body: &[u8]) -> Result<Vec<DVec3>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.ply");
        std::fs::write(&path, [text.as_bytes(), body].concat()).unwrap();
        points(&path)
    }

    const AT: [f64; 3] = [1.5, -2.0, 0.25];

    #[test]
    fn every_encoding_gives_the_same_points() {
        let head = |format: &str, kind: &str| {
            format!(
                "ply\r\nformat {format} 1.0\r\ncomment end\r\nelement vertex 2\r\n\
                 property uchar red\r\nproperty {kind} y\r\nproperty {kind} x\r\n\
                 property int16 k\r\nproperty {kind} z\r\nelement face 0\r\n\
                 property list uchar int vertex_indices\r\nend_header\r\n"
            )
        };
        let expected = [AT.into(), DVec3::new(AT[0], AT[1], 3.0)];
        let text = "7 -2.0 1.5 -3 0.25\n9 -2 1.5 4 3e0\n";
        assert_eq!(read(&head("ascii", "float"), text.as_bytes()).unwrap(), expected);
        let body = |write: &dyn Fn(f64) -> Vec<u8>| {
            let vertex = |z| [vec![7], write(AT[1]), write(AT[0]), vec![0, 1], write(z)].concat();
            [vertex(AT[2]), vertex(3.0)].concat()
        };
        let little = body(&|value| (value as f32).to_le_bytes().to_vec());
        assert_eq!(read(&head("binary_little_endian", "float"), &little).unwrap(), expected);
        let big = body(&|value| value.to_be_bytes().to_vec());
        assert_eq!(read(&head("binary_big_endian", "double"), &big).unwrap(), expected);
        let whole = value(PlyScalar::Signed(2), [0xfe, 0xff, 0, 0, 0, 0, 0, 0]);
        assert_eq!(whole, -2.0);
    }

    #[test]
    fn what_holds_no_points_says_why() {
        let head = |lines: &str| format!("ply\nformat ascii 1.0\n{lines}\nend_header\n");
        let xyz = "property float x\nproperty float y\nproperty float z";
        let cases = [
            ("no ply".to_owned(), "is not a PLY file"),
            (head("element vertex 1\nproperty float x"), "has no x, y and z"),
            (
                head(&format!("element face 1\nelement vertex 1\n{xyz}")),
                "comes before the vertices",
            ),
            (
                head(&format!("element vertex 1\n{xyz}\nproperty float f_dc_0")),
                "a model of Gaussians",
            ),
            (head(&format!("element vertex 2\n{xyz}")), "cut short"),
            (head(&format!("element vertex 99999999999999\n{xyz}")), "cut short"),
        ];
        for (text, expected) in cases {
            let error = read(&text, b"1 2 3\n").unwrap_err().to_string();
            assert!(error.contains(expected), "{expected}: {error}");
        }
        let binary = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex 18446744073709551615\n{xyz}\nend_header\n"
        );
        assert!(read(&binary, &[0; 24]).is_err());
        let nan = read(&head(&format!("element vertex 2\n{xyz}")), b"1 2 3\nnan 0 0\n").unwrap();
        assert_eq!(nan, [DVec3::new(1.0, 2.0, 3.0)]);
    }
}
