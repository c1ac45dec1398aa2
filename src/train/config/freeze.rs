//! Attributes that a training leaves as they are.

use std::fmt;
use std::str::FromStr;

use nightsplat_models::attributes::{ATTRIBUTES, Attribute, AttributeSpec, Width};
use serde::{Deserialize, Serialize};

use crate::Error;

/// Attributes of the given Gaussians that are not trained.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Freeze(Vec<Attribute>);

/// The name of an attribute, without what its number stands for.
fn name(spec: &AttributeSpec) -> &'static str {
    spec.name.trim_start_matches("raw_").trim_start_matches("log_")
}

impl Freeze {
    /// The syntax.
    pub(crate) const FORM: &'static str = "some, not all, of means, quats, scales, opacities, dc, features and rest, \
        separated by commas";

    /// Whether the attribute is frozen.
    pub(crate) fn has(&self, attribute: Attribute) -> bool {
        self.0.contains(&attribute)
    }

    /// Whether the shape of a Gaussian is frozen, or its place: then none is added, moved or pruned.
    pub(crate) fn has_geometry(&self) -> bool {
        use Attribute::{LogScales, Means, Quats, RawOpacities};
        [Means, Quats, LogScales, RawOpacities].iter().any(|attribute| self.has(*attribute))
    }

    /// The columns of the attributes, from the first, that are frozen without a gap: no pass touches their gradients
    /// and moments.
    pub(crate) fn leading_columns(&self) -> u32 {
        let width = |spec: &AttributeSpec| match spec.width {
            Width::Fixed(width) if self.has(spec.attribute) => Some(width as u32),
            _ => None,
        };
        ATTRIBUTES.iter().map_while(width).sum()
    }
}

impl FromStr for Freeze {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let attribute = |text: &str| {
            let is_named = |spec: &&AttributeSpec| text == name(spec) || text == spec.name;
            ATTRIBUTES.iter().find(is_named).map(|spec| spec.attribute)
        };
        let named: Option<Vec<_>> = text.split(',').map(|text| attribute(text.trim())).collect();
        let frozen =
            named.filter(|named| ATTRIBUTES.iter().any(|spec| !named.contains(&spec.attribute)));
        frozen.map(Self).ok_or_else(|| Error::Setting {
            key: "freeze".to_owned(),
            value: text.to_owned(),
            rule: Self::FORM.to_owned(),
        })
    }
}

impl fmt::Display for Freeze {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = self.0.iter().map(|attribute| name(attribute.spec())).collect();
        out.write_str(&names.join(","))
    }
}

impl TryFrom<String> for Freeze {
    type Error = Error;

    fn try_from(text: String) -> Result<Self, Error> {
        text.parse()
    }
}

impl From<Freeze> for String {
    fn from(freeze: Freeze) -> Self {
        freeze.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_are_named_in_any_order_and_others_are_refused_with_their_names() {
        let geometry: Freeze = "means, scales,quats,opacities".parse().unwrap();
        assert_eq!(geometry.to_string(), "means,scales,quats,opacities");
        assert!(geometry.has_geometry() && geometry.leading_columns() == 11);
        let colours: Freeze = "dc,rest".parse().unwrap();
        assert!(!colours.has_geometry() && colours.leading_columns() == 0);
        assert_eq!("means,log_scales".parse::<Freeze>().unwrap().leading_columns(), 3);
        for wrong in ["", "colour", "means,,quats", "means,quats,scales,opacities,dc,features,rest"]
        {
            let refused = wrong.parse::<Freeze>().unwrap_err().to_string();
            assert!(
                refused.contains("must be some, not all, of means, quats, scales"),
                "{refused}"
            );
        }
    }
}
