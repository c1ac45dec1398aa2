//! The formats of model files.

/// The formats of model files that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// In the INRIA layout.
    Ply,
    /// Compressed, of any version.
    Spz,
    /// An archive of images.
    Sog,
}

impl FileKind {
    /// By the first bytes.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [b'p', b'l', b'y', ..] => Some(Self::Ply),
            [b'N', b'G', b'S', b'P', ..] | [0x1f, 0x8b, ..] => Some(Self::Spz),
            [b'P', b'K', ..] => Some(Self::Sog),
            _ => None,
        }
    }
}
