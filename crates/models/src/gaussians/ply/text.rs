//! The vertices of a PLY in text, a line each.

use nightsplat_core::ply::{PlyHeader, PlyScalar};
use rayon::prelude::*;

/// The vertices as a binary little-endian file has them, with zeros for numbers other than floats, which no Gaussian
/// has. Lines after them are those of other elements.
pub(super) fn vertices(header: &PlyHeader, body: &[u8]) -> Result<Vec<u8>, String> {
    let PlyHeader { count, stride, ref properties, has_more, .. } = *header;
    let text = std::str::from_utf8(body)
        .map_err(|_| "is a PLY of format ascii with bytes that are no text")?;
    let mut lines = text.lines().filter(|line| !line.trim().is_empty());
    let vertices: Vec<&str> = lines.by_ref().take(count).collect();
    if vertices.len() < count {
        let lines = vertices.len();
        return Err(format!(
            "is truncated: {count} vertices need a line each, the file has {lines}"
        ));
    }
    if lines.next().is_some() && !has_more {
        return Err(format!("has more lines than its {count} vertices need"));
    }
    // A number takes two bytes of text at least.
    let size = count.checked_mul(stride).filter(|size| size / 8 <= body.len());
    let mut bytes = vec![0; size.ok_or("is truncated: its lines are shorter than vertices")?];
    let pairs = bytes.par_chunks_exact_mut(stride.max(1)).zip(vertices).enumerate();
    let problem = pairs.find_map_first(|(index, (bytes, line))| {
        let mut words = line.split_ascii_whitespace();
        for property in properties {
            let Some(word) = words.next() else {
                return Some(format!("vertex {index} has fewer than {} numbers", properties.len()));
            };
            if property.kind == PlyScalar::Float(4) {
                let Ok(value) = word.parse::<f32>() else {
                    return Some(format!("vertex {index}: `{}` is no number", property.name));
                };
                bytes[property.at..property.at + 4].copy_from_slice(&value.to_le_bytes());
            }
        }
        let more = words.next().is_some();
        more.then(|| format!("vertex {index} has more than {} numbers", properties.len()))
    });
    problem.map_or(Ok(bytes), Err)
}

#[cfg(test)]
mod tests {
    use super::super::*;

    #[test]
    fn a_file_of_text_is_read_as_a_binary_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        let mut model = Gaussians::zeros(300, 1);
        for (index, value) in (0..).zip(&mut model.parameters) {
            *value = (index as f32 * 0.37).sin() * 1e-3;
        }
        save(&model, &path).unwrap();
        let bytes = fs::read(&path).unwrap();
        let header = PlyHeader::parse(&bytes).unwrap();
        let head = String::from_utf8(bytes[..header.length].to_vec()).unwrap();
        let head = head
            .replace("binary_little_endian", "ascii")
            .replace("end_header", "property uchar tag\nelement face 1\nend_header");
        let vertex = |vertex: &[u8]| {
            let values: Vec<f32> = bytemuck::pod_collect_to_vec(vertex);
            values.iter().map(|value| format!("{value:e} ")).collect::<String>() + "255\n"
        };
        let lines: Vec<String> =
            bytes[header.length..].chunks_exact(header.stride).map(vertex).collect();
        let read = |lines: &[String], last: &str| {
            parse(format!("{head}{}{last}", lines.concat()).as_bytes()).map(|(read, _)| read)
        };
        assert_eq!(read(&lines, "\n3 0 1 2\n").unwrap(), model);
        let crlf: Vec<String> = lines.iter().map(|line| line.replace('\n', "\r\n")).collect();
        assert_eq!(read(&crlf, "").unwrap(), model);
        for (line, part) in [
            ("", "300 vertices need a line each, the file has 299"),
            ("1 2\n", "vertex 299 has fewer than"),
            (&format!("1 {}", lines[0]), "vertex 299 has more than"),
            (&lines[0].replacen("0e0", "0,5", 1), "is no number"),
            (&lines[0].replacen("0e0", "-nan", 1), "vertex 299: `x` is NaN"),
        ] {
            let problem = read(&lines[1..], line).unwrap_err();
            assert!(problem.contains(part), "{line}: {problem}");
        }
        let many = head.replace("vertex 300", &format!("vertex {}", usize::MAX));
        assert!(parse((many + "1 2\n").as_bytes()).unwrap_err().contains("truncated"));
    }
}
