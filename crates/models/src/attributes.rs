//! The table of the attributes of a Gaussian: columns in memory, learning rates, PLY properties.
//!
//! Parameters are planes in one float array: all means, then all quats, and so on in the order of the rows. Features
//! and higher SH coefficients, whose width depends on the scene, come last.

/// An attribute of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attribute {
    /// Position in the world.
    Means,
    /// Rotation, (w, x, y, z), not normalised.
    Quats,
    /// Natural logarithms of the standard deviations along the rotated axes.
    LogScales,
    /// Opacity before the sigmoid.
    RawOpacities,
    /// SH coefficients of degree 0, RGB; the colour is 0.5 + [`SH_C0`](crate::gaussians::SH_C0) times this.
    Dc,
    /// Blended values in addition to colour, in the order of [`FEATURES`](crate::gaussians::FEATURES).
    Features,
    /// SH coefficients above degree 0, coefficient-major, RGB.
    Rest,
}

/// The description of an attribute.
#[derive(Debug)]
pub struct AttributeSpec {
    /// The attribute of this row.
    pub attribute: Attribute,
    /// The name in config.toml; `NAME_COLUMN` in `include/gaussian.glsl`.
    pub name: &'static str,
    /// Floats per Gaussian.
    pub width: Width,
    /// Adam's initial learning rate (3DGS's `OptimizationParams`).
    pub learning_rate: f64,
    /// The PLY properties (INRIA layout).
    pub ply: Ply,
    /// The attribute's position among the attributes in a PLY file.
    pub ply_place: usize,
}

/// The floats per Gaussian of an attribute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// Fixed.
    Fixed(usize),
    /// The scene's number of features.
    Features,
    /// Three for each SH coefficient above degree 0.
    Rest,
}

/// The names of an attribute's PLY properties.
#[derive(Clone, Copy, Debug)]
pub enum Ply {
    /// One by one.
    Named(&'static [&'static str]),
    /// A prefix and the component's number.
    Numbered(&'static str),
    /// Those of the scene's features.
    Features,
}

/// The rows in the order of the planes.
pub const ATTRIBUTES: [AttributeSpec; 7] = [
    AttributeSpec {
        attribute: Attribute::Means,
        name: "means",
        width: Width::Fixed(3),
        learning_rate: 1.6e-4,
        ply: Ply::Named(&["x", "y", "z"]),
        ply_place: 0,
    },
    AttributeSpec {
        attribute: Attribute::Quats,
        name: "quats",
        width: Width::Fixed(4),
        learning_rate: 1e-3,
        ply: Ply::Numbered("rot_"),
        ply_place: 6,
    },
    AttributeSpec {
        attribute: Attribute::LogScales,
        name: "log_scales",
        width: Width::Fixed(3),
        learning_rate: 5e-3,
        ply: Ply::Numbered("scale_"),
        ply_place: 5,
    },
    AttributeSpec {
        attribute: Attribute::RawOpacities,
        name: "raw_opacities",
        width: Width::Fixed(1),
        learning_rate: 0.05,
        ply: Ply::Named(&["opacity"]),
        ply_place: 4,
    },
    AttributeSpec {
        attribute: Attribute::Dc,
        name: "dc",
        width: Width::Fixed(3),
        learning_rate: 2.5e-3,
        ply: Ply::Numbered("f_dc_"),
        ply_place: 1,
    },
    AttributeSpec {
        attribute: Attribute::Features,
        name: "features",
        width: Width::Features,
        learning_rate: 1.25e-4,
        ply: Ply::Features,
        ply_place: 3,
    },
    AttributeSpec {
        attribute: Attribute::Rest,
        name: "rest",
        width: Width::Rest,
        learning_rate: 1.25e-4,
        ply: Ply::Numbered("f_rest_"),
        ply_place: 2,
    },
];

/// SH coefficients above degree 0: (degree + 1)^2 - 1.
pub const fn rest_coefficients(sh_degree: u32) -> usize {
    ((sh_degree + 1) * (sh_degree + 1) - 1) as usize
}

/// Floats per Gaussian, all attributes together.
pub fn column_count(feature_count: usize, sh_degree: u32) -> usize {
    Attribute::Rest.column(feature_count) + 3 * rest_coefficients(sh_degree)
}

/// The dimensions of a buffer of planes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaneCounts {
    /// The number of Gaussians.
    pub gaussians: usize,
    /// Floats per Gaussian.
    pub columns: usize,
    /// Those of the features.
    pub features: usize,
}

impl PlaneCounts {
    /// Floats of all planes.
    pub fn total(self) -> usize {
        self.gaussians * self.columns
    }

    /// Floats per Gaussian before the SH coefficients above degree 0.
    pub fn before_rest(self) -> usize {
        Attribute::Rest.column(self.features)
    }

    /// SH coefficients above degree 0 per Gaussian, all channels.
    pub fn rest(self) -> usize {
        self.columns.saturating_sub(self.before_rest())
    }
}

/// The values of an attribute of all Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AttributePlane {
    /// The attribute.
    pub attribute: Attribute,
    /// Floats per Gaussian before it.
    pub column: usize,
    /// Its words per Gaussian.
    pub width: usize,
}

impl AttributePlane {
    /// The index of word `k` of Gaussian `i` of `count`: Gaussian by Gaussian or, where that is so for SH coefficients
    /// above degree 0, word by word, each for all Gaussians.
    pub fn index(self, rest_by_column: bool, count: usize, i: usize, k: usize) -> usize {
        let Self { attribute, column, width } = self;
        match rest_by_column && attribute == Attribute::Rest {
            true => (column + k) * count + i,
            false => column * count + width * i + k,
        }
    }
}

/// Every plane, for `column_count` floats per Gaussian, of which `feature_count` are features.
pub fn planes(feature_count: usize, column_count: usize) -> [AttributePlane; ATTRIBUTES.len()] {
    ATTRIBUTES.each_ref().map(|spec| {
        let attribute = spec.attribute;
        let column = attribute.column(feature_count);
        let width = match spec.width {
            Width::Fixed(width) => width,
            Width::Features => feature_count,
            Width::Rest => column_count.saturating_sub(column),
        };
        AttributePlane { attribute, column, width }
    })
}

impl Attribute {
    /// The attribute's row of [`ATTRIBUTES`].
    pub const fn spec(self) -> &'static AttributeSpec {
        &ATTRIBUTES[self as usize]
    }

    /// Floats per Gaussian before this attribute: its plane begins at this times the number of Gaussians.
    pub const fn column(self, feature_count: usize) -> usize {
        let (mut column, mut before) = (0, 0);
        while before < self as usize {
            column += match ATTRIBUTES[before].width {
                Width::Fixed(width) => width,
                Width::Features | Width::Rest => feature_count,
            };
            before += 1;
        }
        column
    }
}
