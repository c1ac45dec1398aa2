//! The up direction of a model's world, and the rotation of an exported file that follows from it.

use std::str::FromStr;

use glam::{DQuat, DVec3};
use nightsplat_models::export::Format;

use super::ExportOptions;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// Smaller angles are no rotation, radians.
const NO_TURN: f64 = 1e-6;

/// A value of `--up`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Up {
    /// The axes stay as they are.
    Keep,
    /// A unit vector of the dataset's world.
    Direction(DVec3),
}

impl FromStr for Up {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let direction = match text {
            "none" => return Ok(Self::Keep),
            "x" => Some(DVec3::X),
            "y" => Some(DVec3::Y),
            "z" => Some(DVec3::Z),
            "-x" => Some(DVec3::NEG_X),
            "-y" => Some(DVec3::NEG_Y),
            "-z" => Some(DVec3::NEG_Z),
            _ => {
                let numbers: Option<Vec<f64>> =
                    text.split(',').map(|number| number.trim().parse().ok()).collect();
                let three = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
                three.and_then(|numbers| DVec3::from_array(numbers).try_normalize())
            }
        };
        let problem = "names no direction; x, y, z, -x, -y, -z, three numbers X,Y,Z, or none";
        direction.map(Self::Direction).ok_or_else(|| Error::Usage(format!("`{text}` {problem}")))
    }
}

/// The rotation of a file.
#[derive(Clone, Debug)]
pub(crate) struct Turn {
    pub(crate) rotation: DQuat,
    /// Radians.
    pub(crate) angle: f64,
    /// The up direction in the model's world, a unit vector.
    pub(crate) up: DVec3,
    /// The axis of the file that is up.
    pub(crate) axis: &'static str,
}

impl ExportOptions<'_> {
    /// The up direction in the model's world, if given or known: a unit vector.
    pub(super) fn up_of(&self, config: &TrainConfig) -> Option<DVec3> {
        match self.up {
            Some(Up::Direction(up)) => Some(up),
            Some(Up::Keep) => None,
            None => config.up.and_then(|up| DVec3::from_array(up).try_normalize()),
        }
    }

    /// The rotation that maps the model's up direction to that of the format.
    ///
    /// In every format except the page, up is -y of the model's axes, which is +y in GLB, USD and SPZ. These, whose
    /// readers interpret the axes, are rotated by the run's up direction; PLY and SOG only if `--up` is given.
    pub(super) fn turn(&self, config: &TrainConfig) -> Option<Turn> {
        let has_axes =
            matches!(self.format, Format::Glb | Format::Usda | Format::Usdz | Format::Spz(_));
        let is_asked = has_axes || self.up.is_some();
        if self.format == Format::Html || self.up == Some(Up::Keep) || !is_asked {
            return None;
        }
        let Some(up) = self.up_of(config) else {
            tracing::warn!(
                "{}: has no up direction, -y of its axes is used; --up names another",
                self.source.display()
            );
            return None;
        };
        let rotation = DQuat::from_rotation_arc(up, DVec3::NEG_Y);
        let angle = up.angle_between(DVec3::NEG_Y);
        let axis = if has_axes { "+Y" } else { "-Y" };
        (angle > NO_TURN).then_some(Turn { rotation, angle, up, axis })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_direction_is_an_axis_or_three_numbers() {
        let parsed = |text: &str| text.parse::<Up>().unwrap();
        assert_eq!(parsed("none"), Up::Keep);
        assert_eq!(parsed("-z"), Up::Direction(DVec3::NEG_Z));
        assert_eq!(parsed("0, -2,0"), Up::Direction(DVec3::NEG_Y));
        for text in ["up", "1,2", "0,0,0", "1,2,nan", "1,2,3,4", ""] {
            let refused = text.parse::<Up>().unwrap_err().to_string();
            assert!(refused.contains("names no direction; x, y"), "{refused}");
        }
    }
}
