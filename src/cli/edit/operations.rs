//! The operations of `edit` on the command line, in its order.

use std::path::Path;

use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, Error, FromArgMatches};
use glam::DVec3;
use nightsplat_models::edit::operation::{Operation, Region, Scale};

use crate::results::run_export::up::Up;

/// Operations in the order of the command line.
#[derive(Clone, Debug)]
pub(super) struct Operations(Vec<Operation>);

/// Reads the value of an option.
type Parse = fn(&str) -> Result<Operation, String>;

/// An option with a value: name, value, help, and what reads it.
type Row = (&'static str, &'static str, &'static str, Parse);

const ROWS: [Row; 10] = [
    (
        "crop",
        "REGION",
        "Keep the Gaussians in a box X0,Y0,Z0,X1,Y1,Z1, in a sphere X,Y,Z,R, or, for cameras, in the sphere around \
         what the cameras look at that contains them, and those outside that training views show",
        crop,
    ),
    ("opacity-min", "O", "Remove Gaussians of a lower opacity, 0 to 1", |text| {
        Ok(Operation::OpacityMin(number(text)?))
    }),
    (
        "max-gaussians",
        "N",
        "Keep the N Gaussians that contribute most to the training views",
        |text| {
            let count = text.parse().map_err(|_| "is not a whole number".to_owned())?;
            Ok(Operation::MaxGaussians(count))
        },
    ),
    (
        "sh-degree",
        "D",
        "Drop the colours' SH coefficients above degree D, 0 to 3; a higher degree adds zeros",
        |text| {
            let degree = text.parse().map_err(|_| "is not a whole number".to_owned())?;
            Ok(Operation::ShDegree(degree))
        },
    ),
    (
        "up",
        "DIRECTION",
        "Rotate so that this direction is up, which is -y in PLY and SOG: x, y, z, -x, -y, -z, X,Y,Z, or auto for that \
         of the photographs",
        up,
    ),
    (
        "scale",
        "SCALE",
        "Scale about the origin: a factor; X,Y,Z:X,Y,Z=L, two points whose distance becomes L; or a file with a name, \
         X, Y and Z on each line, the positions of cameras in metres",
        scale,
    ),
    ("move", "X,Y,Z", "Move by a vector", |text| Ok(Operation::Move(vector(text)?))),
    (
        "rotate",
        "AXIS:DEGREES",
        "Rotate about an axis through the origin, such as y:90 or 1,1,0:37, with the view-dependent colours",
        rotate,
    ),
    (
        "merge",
        "MODEL",
        "Add the Gaussians of another model or run, at their own coordinates",
        |text| Ok(Operation::Merge { file: text.into(), hash: None }),
    ),
    ("floaters", "", "", |_| Ok(Operation::Floaters)),
];

const FLOATERS: &str = "floaters";
const FLOATERS_HELP: &str = "Remove the Gaussians that the training views contradict, and those that float unseen; \
                             says how many";

impl Operations {
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Operation> {
        self.0.iter()
    }
}

impl Args for Operations {
    fn augment_args(command: Command) -> Command {
        let values = ROWS.iter().filter(|(name, ..)| *name != FLOATERS);
        let command = values.fold(command, |command, &(name, value, help, parse)| {
            let parser = move |text: &str| {
                let operation = parse(text)?;
                operation.check()?;
                Ok::<_, String>(operation)
            };
            command.arg(
                Arg::new(name)
                    .long(name)
                    .value_name(value)
                    .help(help)
                    .help_heading(HEADING)
                    .action(ArgAction::Append)
                    .allow_hyphen_values(true)
                    .value_parser(parser),
            )
        });
        let floaters = Arg::new(FLOATERS).long(FLOATERS).help(FLOATERS_HELP);
        command.arg(floaters.help_heading(HEADING).action(ArgAction::SetTrue))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

const HEADING: &str = "Operations";

impl FromArgMatches for Operations {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let mut operations: Vec<(usize, Operation)> = vec![];
        for (name, ..) in &ROWS {
            if matches.value_source(name) != Some(ValueSource::CommandLine) {
                continue;
            }
            let indices = matches.indices_of(name).unwrap_or_default();
            if *name == FLOATERS {
                operations.extend(indices.map(|index| (index, Operation::Floaters)));
            } else {
                let values = matches.get_many::<Operation>(name).unwrap_or_default();
                operations.extend(indices.zip(values.cloned()));
            }
        }
        operations.sort_by_key(|(index, _)| *index);
        Ok(Self(operations.into_iter().map(|(_, operation)| operation).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

fn number(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| format!("`{text}` is not a finite number"))
}

fn numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split(',').map(number).collect()
}

fn vector(text: &str) -> Result<DVec3, String> {
    let three = <[f64; 3]>::try_from(numbers(text)?);
    three.map(DVec3::from_array).map_err(|_| format!("`{text}` is not X,Y,Z"))
}

fn crop(text: &str) -> Result<Operation, String> {
    if text == "cameras" {
        return Ok(Operation::Crop(Region::Cameras));
    }
    match *numbers(text)? {
        [x, y, z, radius] => Ok(Operation::Crop(Region::Sphere(DVec3::new(x, y, z), radius))),
        [a, b, c, d, e, f] => {
            Ok(Operation::Crop(Region::Box(DVec3::new(a, b, c), DVec3::new(d, e, f))))
        }
        _ => Err("takes X0,Y0,Z0,X1,Y1,Z1 for a box, X,Y,Z,R for a sphere, or cameras".to_owned()),
    }
}

fn direction(text: &str) -> Result<DVec3, String> {
    match text.parse::<Up>() {
        Ok(Up::Direction(direction)) => Ok(direction),
        _ => Err(format!("`{text}` names no direction; x, y, z, -x, -y, -z or X,Y,Z")),
    }
}

fn up(text: &str) -> Result<Operation, String> {
    Ok(Operation::Up(if text == "auto" { None } else { Some(direction(text)?) }))
}

fn rotate(text: &str) -> Result<Operation, String> {
    let (axis, degrees) = text.rsplit_once(':').ok_or("takes AXIS:DEGREES, such as y:90")?;
    Ok(Operation::Rotate { axis: direction(axis)?, degrees: number(degrees)? })
}

fn scale(text: &str) -> Result<Operation, String> {
    if let Ok(factor) = text.trim().parse() {
        return Ok(Operation::Scale(Scale::Factor(factor)));
    }
    if let Some((points, length)) = text.split_once('=')
        && let Some((from, to)) = points.split_once(':')
    {
        let (from, to, length) = (vector(from)?, vector(to)?, number(length)?);
        return Ok(Operation::Scale(Scale::Points { from, to, length }));
    }
    if Path::new(text).is_file() {
        return Ok(Operation::Scale(Scale::Cameras(text.into())));
    }
    Err("is neither a factor, nor X,Y,Z:X,Y,Z=LENGTH, nor a file with camera positions".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(line: &str) -> Result<Vec<Operation>, Error> {
        let command = Operations::augment_args(Command::new("edit"));
        let matches = command.try_get_matches_from(line.split(' '))?;
        Ok(Operations::from_arg_matches(&matches)?.0)
    }

    #[test]
    fn operations_keep_the_order_of_the_command_line() {
        let line =
            "edit --move 1,0,0 --rotate -x:90 --floaters --move=-1,0,0 --crop 0,0,0,2 --scale 2";
        let expected = [
            Operation::Move(DVec3::X),
            Operation::Rotate { axis: DVec3::NEG_X, degrees: 90.0 },
            Operation::Floaters,
            Operation::Move(DVec3::NEG_X),
            Operation::Crop(Region::Sphere(DVec3::ZERO, 2.0)),
            Operation::Scale(Scale::Factor(2.0)),
        ];
        assert_eq!(parsed(line).unwrap(), expected);
        assert!(parsed("edit").unwrap().is_empty());
    }

    #[test]
    fn values_that_are_none_are_refused_with_what_an_option_takes() {
        for (line, part) in [
            ("--scale 0", "a scale of 0 is none"),
            ("--scale nan", "a scale of NaN is none"),
            ("--scale 0,0,0:0,0,0=1", "a scale of inf is none"),
            ("--scale nowhere.csv", "neither a factor"),
            ("--crop 1,2", "for a box"),
            ("--crop 0,0,0,nan", "`nan` is not a finite number"),
            ("--crop 1,1,1,0,0,0", "the lower numbers first"),
            ("--rotate 90", "AXIS:DEGREES"),
            ("--rotate 0,0,0:90", "names no direction"),
            ("--move 1,2", "is not X,Y,Z"),
            ("--opacity-min 1.5", "an opacity of 1.5 is none"),
            ("--max-gaussians 0", "would leave nothing"),
            ("--sh-degree 4", "an SH degree of 4 is none"),
            ("--up sideways", "names no direction"),
        ] {
            let refused = parsed(&format!("edit {line}")).unwrap_err().to_string();
            assert!(refused.contains(part), "{line}: {refused}");
        }
    }
}
