//! Headers of PLY files whose vertices come first: models of Gaussians, and clouds of points.

/// The remedy for models in formats of other programs.
pub const CONVERTER: &str =
    "convert it with `npx @playcanvas/splat-transform IN OUT.ply`, or save it as PLY in SuperSplat";

/// How vertices are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlyEncoding {
    /// A line each.
    Text,
    /// Binary, the least significant byte first.
    Little,
    /// Binary, the most significant byte first.
    Big,
}

impl PlyEncoding {
    /// Its name in a header.
    pub fn name(self) -> &'static str {
        match self {
            Self::Text => "ascii",
            Self::Little => "binary_little_endian",
            Self::Big => "binary_big_endian",
        }
    }
}

/// The type of a number, with its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlyScalar {
    /// Of whole numbers.
    Signed(usize),
    /// Of whole numbers from 0 on.
    Unsigned(usize),
    /// Of floating point.
    Float(usize),
}

impl PlyScalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::Signed(1),
            "short" | "int16" => Self::Signed(2),
            "int" | "int32" => Self::Signed(4),
            "uchar" | "uint8" => Self::Unsigned(1),
            "ushort" | "uint16" => Self::Unsigned(2),
            "uint" | "uint32" => Self::Unsigned(4),
            "float" | "float32" => Self::Float(4),
            "double" | "float64" => Self::Float(8),
            _ => return None,
        })
    }

    /// Bytes.
    pub fn size(self) -> usize {
        match self {
            Self::Signed(size) | Self::Unsigned(size) | Self::Float(size) => size,
        }
    }
}

/// A number of every vertex.
#[derive(Clone, Debug)]
pub struct PlyProperty {
    /// Its name.
    pub name: String,
    /// The name of its type.
    pub type_name: String,
    /// Its type.
    pub kind: PlyScalar,
    /// Bytes of a vertex before it.
    pub at: usize,
}

/// What a header says of the vertices.
#[derive(Clone, Debug)]
pub struct PlyHeader {
    /// Bytes before the first vertex.
    pub length: usize,
    /// How they are written.
    pub encoding: PlyEncoding,
    /// Vertices.
    pub count: usize,
    /// Bytes per vertex, of a binary file.
    pub stride: usize,
    /// Their numbers, in order.
    pub properties: Vec<PlyProperty>,
    /// Whether other elements follow the vertices.
    pub has_more: bool,
    /// Its comments, each with the number of its line.
    pub comments: Vec<(usize, String)>,
}

/// The longest header that is read, bytes, and the most numbers of a vertex.
const LONGEST_HEADER: usize = 1 << 26;
const MOST_PROPERTIES: usize = 1000;

impl PlyHeader {
    /// Reads no more of a file than its header takes; `None` where it is no PLY.
    pub fn read(file: &mut impl std::io::Read) -> std::io::Result<Option<Result<Self, String>>> {
        use std::io::Read;
        let (mut start, mut wanted) = (vec![], 1 << 16);
        loop {
            let more = wanted - start.len();
            file.take(more as u64).read_to_end(&mut start)?;
            if !start.starts_with(b"ply") {
                return Ok(None);
            }
            match Self::parse(&start) {
                Err(_) if start.len() == wanted && wanted < LONGEST_HEADER => wanted *= 2,
                header => return Ok(Some(header)),
            }
        }
    }

    /// Reads the header at the beginning of a file.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        const END: &[u8] = b"end_header";
        let bytes = &bytes[..bytes.len().min(LONGEST_HEADER)];
        if !bytes.starts_with(b"ply") {
            return Err("is not a PLY file".to_owned());
        }
        let cut_short = "is cut short in the header";
        let end = bytes.windows(END.len()).position(|window| window == END).ok_or(cut_short)?;
        let newline = bytes[end..].iter().position(|&byte| byte == b'\n').ok_or(cut_short)?;
        let mut header = Self {
            length: end + newline + 1,
            encoding: PlyEncoding::Text,
            count: 0,
            stride: 0,
            properties: vec![],
            has_more: false,
            comments: vec![],
        };
        let (mut encoding, mut in_vertices) = (None, false);
        for (number, line) in (1..).zip(String::from_utf8_lossy(&bytes[..end]).lines()) {
            if let Some(comment) = line.trim_start().strip_prefix("comment ") {
                header.comments.push((number, comment.trim_start().to_owned()));
                continue;
            }
            match *line.split_whitespace().collect::<Vec<_>>() {
                ["format", name, ..] => {
                    let all = [PlyEncoding::Text, PlyEncoding::Little, PlyEncoding::Big];
                    let found = all.into_iter().find(|encoding| encoding.name() == name);
                    encoding = Some(found.ok_or_else(|| format!("has the unknown format {name}"))?);
                }
                ["element", "vertex", count] if !in_vertices => {
                    in_vertices = true;
                    header.count =
                        count.parse().map_err(|_| format!("`{count}` is not a vertex count"))?;
                }
                ["element", "chunk", _] if !in_vertices => {
                    return Err(format!("is a compressed PLY of PlayCanvas; {CONVERTER}"));
                }
                ["element", name, _] if !in_vertices => {
                    return Err(format!(
                        "element `{name}` comes before the vertices; only vertices are expected"
                    ));
                }
                ["element", ..] => header.has_more = true,
                ["property", "list", ..] if in_vertices && !header.has_more => {
                    return Err("a list property in the vertices is not supported".to_owned());
                }
                ["property", kind, name] if in_vertices && !header.has_more => {
                    header.push(kind, name)?;
                }
                _ => {}
            }
        }
        header.encoding = encoding.ok_or("does not say its format")?;
        if !in_vertices {
            return Err("has no vertices: `element vertex` is missing".to_owned());
        }
        Ok(header)
    }

    fn push(&mut self, type_name: &str, name: &str) -> Result<(), String> {
        let kind = PlyScalar::from_name(type_name)
            .ok_or_else(|| format!("property `{name}` has the unknown type `{type_name}`"))?;
        if self.properties.len() == MOST_PROPERTIES {
            return Err(format!("has more than {MOST_PROPERTIES} numbers of a vertex"));
        }
        if self.property(name).is_some() {
            return Err(format!("property `{name}` is there twice"));
        }
        let (name, type_name) = (name.to_owned(), type_name.to_owned());
        self.properties.push(PlyProperty { name, type_name, kind, at: self.stride });
        self.stride += kind.size();
        Ok(())
    }

    /// A number of every vertex, with its place among them.
    pub fn property(&self, name: &str) -> Option<(usize, &PlyProperty)> {
        self.properties.iter().enumerate().find(|(_, property)| property.name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_without_an_end_or_with_many_numbers_are_refused() {
        let header = |count: usize| {
            let numbers: String = (0..count).map(|at| format!("property float p{at}\n")).collect();
            format!("ply\nformat ascii 1.0\nelement vertex 0\n{numbers}end_header\n").into_bytes()
        };
        assert_eq!(PlyHeader::parse(&header(1000)).unwrap().properties.len(), 1000);
        let error = PlyHeader::parse(&header(1001)).unwrap_err();
        assert!(error.contains("more than 1000 numbers"), "{error}");
        let mut endless = std::io::Read::chain(&b"ply\ncomment "[..], std::io::repeat(0));
        let error = PlyHeader::read(&mut endless).unwrap().unwrap().unwrap_err();
        assert!(error.contains("cut short in the header"), "{error}");
    }
}
