//! A tone curve of one's own: a formula of t = x / p90, or of the stored value x, with named constants.
//!
//! ```text
//! curve    := formula {"; " name " = " value [" in " low ".." high]}
//! formula  := + - * / ^ of numbers, t or x, pi, constants, and functions of them
//! ```
//!
//! A power binds tighter than a sign, -t^2 = -(t^2), and groups from the right. The formula is evaluated into a
//! [`Table`], which is what kernels apply; a fit evaluates it in dual numbers, so its gradients are exact.

use std::borrow::Cow;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fmt;
use std::str::FromStr;

use nightsplat_core::curves::{Constant, Constants, MAX_CONSTANTS, Real, padded};
use nightsplat_core::{Error, Result};
use winnow::Parser;
use winnow::ascii::{float, multispace0};
use winnow::combinator::{
    Infix, Prefix, alt, delimited, dispatch, expression, fail, preceded, separated,
};
use winnow::stream::Stateful;
use winnow::token::{any, take_while};

use super::Table;

/// Longer formulas are refused: the parser descends into parentheses.
const LONGEST: usize = 300;
/// Knots of the table, at t = u^3 / (1 - u) with u in even steps: dense at black, and up to t = 510.
const KNOTS: u32 = 512;
/// A fall that rounding explains.
const TOLERANCE: f64 = 1e-9;
/// Bounds of a constant that has neither value nor bounds; a fit starts it at 1.
const OPEN: [f64; 2] = [0.01, 100.0];
/// The largest whole exponent of which a negative number has a power.
const LARGEST_POWER: f64 = 64.0;

/// A formula with its constants.
#[derive(Clone, Debug)]
pub struct Expression {
    formula: String,
    root: FormulaNode,
    /// In the order of the formula. The default of one without a value is NaN.
    constants: Vec<Constant>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Function {
    Minus,
    Sum,
    Difference,
    Product,
    Quotient,
    Power,
    Exp,
    Ln,
    Sqrt,
    Tanh,
    Atan,
    Min,
    Max,
}

/// The functions that have names, with the numbers of their arguments.
const FUNCTIONS: [(&str, Function, usize); 7] = [
    ("exp", Function::Exp, 1),
    ("ln", Function::Ln, 1),
    ("sqrt", Function::Sqrt, 1),
    ("tanh", Function::Tanh, 1),
    ("atan", Function::Atan, 1),
    ("min", Function::Min, 2),
    ("max", Function::Max, 2),
];

/// The variables, which come before the constants among the names of a formula.
const VARIABLES: [&str; 2] = ["t", "x"];

#[derive(Clone, Debug)]
enum FormulaNode {
    Number(f64),
    /// A variable or a constant, by its position among the names.
    Name(usize),
    Apply(Function, Vec<Self>),
}

impl FormulaNode {
    /// A function of numbers is a number.
    fn apply(function: Function, arguments: Vec<Self>) -> Self {
        let is_number = arguments.iter().all(|node| matches!(node, Self::Number(_)));
        let node = Self::Apply(function, arguments);
        if is_number { Self::Number(node.value(&[])) } else { node }
    }

    /// The value at these values of the names.
    fn value<T: Real>(&self, values: &[T]) -> T {
        let [zero, one] = [0.0, 1.0].map(T::from_f64);
        let (function, arguments) = match self {
            Self::Number(number) => return T::from_f64(*number),
            Self::Name(index) => return values[*index],
            Self::Apply(function, arguments) => (function, arguments),
        };
        let [a, b] =
            [&arguments[0], &arguments[arguments.len() - 1]].map(|node| node.value(values));
        match function {
            Function::Minus => -a,
            Function::Sum => a + b,
            Function::Difference => a - b,
            Function::Product => a * b,
            Function::Quotient => a / b,
            Function::Power => match arguments[1] {
                Self::Number(n) if n.fract() == 0.0 && n.abs() <= LARGEST_POWER => {
                    let product = (0..n.abs() as u32).fold(one, |product, _| product * a);
                    if n < 0.0 { one / product } else { product }
                }
                _ if a < zero => T::from_f64(f64::NAN),
                _ => a.power(b),
            },
            Function::Exp => a.exp(),
            Function::Ln => a.ln(),
            Function::Sqrt => a.sqrt(),
            Function::Tanh if a < zero => -(-a).tanh(),
            Function::Tanh => a.tanh(),
            Function::Atan => a.atan(),
            Function::Min => a.at_most(b),
            Function::Max => a.at_least(b),
        }
    }

    fn contains(&self, name: usize) -> bool {
        match self {
            Self::Number(_) => false,
            Self::Name(index) => *index == name,
            Self::Apply(_, arguments) => arguments.iter().any(|node| node.contains(name)),
        }
    }
}

/// Two operands and what is between them.
fn two(function: Function, a: FormulaNode, b: FormulaNode) -> winnow::Result<FormulaNode> {
    Ok(FormulaNode::apply(function, vec![a, b]))
}

/// The rest of a formula, and the names that it contains.
type Text<'a> = Stateful<&'a str, &'a RefCell<Vec<String>>>;

fn formula(text: &mut Text<'_>) -> winnow::Result<FormulaNode> {
    expression(delimited(multispace0, operand, multispace0))
        .prefix(dispatch! {preceded(multispace0, any);
            '-' => Prefix(8, |_: &mut _, a| Ok(FormulaNode::apply(Function::Minus, vec![a]))),
            _ => fail,
        })
        .infix(dispatch! {any;
            '+' => Infix::Left(5, |_: &mut _, a, b| two(Function::Sum, a, b)),
            '-' => Infix::Left(5, |_: &mut _, a, b| two(Function::Difference, a, b)),
            '*' => Infix::Left(7, |_: &mut _, a, b| two(Function::Product, a, b)),
            '/' => Infix::Left(7, |_: &mut _, a, b| two(Function::Quotient, a, b)),
            '^' => Infix::Right(9, |_: &mut _, a, b| two(Function::Power, a, b)),
            _ => fail,
        })
        .parse_next(text)
}

fn operand(text: &mut Text<'_>) -> winnow::Result<FormulaNode> {
    alt((delimited('(', formula, ')'), called, named, float.map(FormulaNode::Number)))
        .parse_next(text)
}

fn name<'a>(text: &mut Text<'a>) -> winnow::Result<&'a str> {
    let letter = |c: char| c.is_ascii_alphabetic() || c == '_';
    let rest = take_while(0.., move |c: char| letter(c) || c.is_ascii_digit());
    (take_while(1.., letter), rest).take().parse_next(text)
}

fn called(text: &mut Text<'_>) -> winnow::Result<FormulaNode> {
    let arguments = delimited('(', separated(1..=2, formula, ','), ')');
    let call = |(name, arguments): (&str, Vec<FormulaNode>)| {
        let known = FUNCTIONS.iter().find(|(known, ..)| *known == name);
        let (_, function, _) = known.filter(|(.., count)| *count == arguments.len())?;
        Some(FormulaNode::apply(*function, arguments))
    };
    (name, arguments).verify_map(call).parse_next(text)
}

fn named(text: &mut Text<'_>) -> winnow::Result<FormulaNode> {
    let is_function = |name: &&str| FUNCTIONS.iter().any(|(known, ..)| known == name);
    let name = name.verify(|name: &str| !is_function(&name)).parse_next(text)?;
    if name == "pi" {
        return Ok(FormulaNode::Number(PI));
    }
    let mut names = text.state.borrow_mut();
    let known = names.iter().position(|known| known == name);
    Ok(FormulaNode::Name(known.unwrap_or_else(|| {
        names.push(name.to_owned());
        names.len() - 1
    })))
}

/// A constant of `name = value in low..high`.
fn stated(text: &str) -> Option<Constant> {
    let (name, rest) = text.split_once('=')?;
    let number = |text: &str| text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    let (value, bounds) = match rest.split_once(" in ") {
        Some((value, bounds)) => (value, Some(bounds.split_once("..")?)),
        None => (rest, None),
    };
    let value = number(value)?;
    let bounds = match bounds {
        Some((low, high)) => [number(low)?, number(high)?],
        None => bounds_around(value),
    };
    let is_within = (bounds[0]..=bounds[1]).contains(&value);
    is_within.then(|| constant(name.trim().to_owned(), value, bounds))
}

fn constant(name: String, value: f64, bounds: [f64; 2]) -> Constant {
    let start = if value.is_nan() { 1.0 } else { value };
    Constant { name: Cow::Owned(name), default: value, start, bounds }
}

/// The bounds of a fit around a value without any: from a tenth to ten times it.
fn bounds_around(value: f64) -> [f64; 2] {
    let [low, high] = if value == 0.0 { [-1.0, 1.0] } else { [0.1 * value, 10.0 * value] };
    [low.min(high), low.max(high)]
}

impl FromStr for Expression {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let mut parts = text.split(';');
        let formula_text = parts.next().unwrap_or_default().trim();
        let wrong =
            |problem: String| Error::Usage(format!("the formula `{formula_text}` {problem}"));
        if text.len() > LONGEST {
            let problem = format!("has more than {LONGEST} characters; save its values as .csv");
            return Err(wrong(problem));
        }
        let names = RefCell::new(VARIABLES.map(str::to_owned).to_vec());
        let stream = Stateful { input: formula_text, state: &names };
        let root = formula.parse(stream).map_err(|error| {
            let rest = formula_text.get(error.offset()..).unwrap_or_default();
            let at = if rest.is_empty() { "at its end".to_owned() } else { format!("at `{rest}`") };
            let functions = FUNCTIONS.map(|(name, ..)| name).join(", ");
            wrong(format!("cannot be read {at}; it takes + - * / ^ ( ), pi, and {functions}"))
        })?;
        match [0, 1].map(|variable| root.contains(variable)) {
            [true, true] => {
                return Err(wrong("contains both t and x; use t = x / p90, or x".into()));
            }
            [false, false] => return Err(wrong("contains neither t = x / p90 nor x".into())),
            _ => {}
        }
        let mut names = names.into_inner();
        let open = names.drain(VARIABLES.len()..).map(|name| constant(name, f64::NAN, OPEN));
        let mut constants: Vec<Constant> = open.collect();
        if constants.len() > MAX_CONSTANTS {
            let problem = format!("has {} constants, at most {MAX_CONSTANTS}", constants.len());
            return Err(wrong(problem));
        }
        for part in parts {
            let part = part.trim();
            let stated = stated(part).ok_or_else(|| {
                wrong(format!(
                    "is followed by `{part}`; write NAME = VALUE, or NAME = VALUE in LOW..HIGH around it"
                ))
            })?;
            let constant = constants.iter_mut().find(|constant| constant.name == stated.name);
            match constant {
                Some(constant) => *constant = stated,
                None => return Err(wrong(format!("has no constant `{}`", stated.name))),
            }
        }
        Ok(Self { formula: formula_text.to_owned(), root, constants })
    }
}

/// The formula and the values of its constants, as it is parsed.
impl fmt::Display for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let values = self.constants.iter().filter(|constant| !constant.default.is_nan());
        let values = values.map(|Constant { name, default, .. }| format!("; {name} = {default}"));
        f.pad(&(self.formula.clone() + &values.collect::<String>()))
    }
}

/// The same formula of the same constants, whose values are those of its settings.
impl PartialEq for Expression {
    fn eq(&self, other: &Self) -> bool {
        self.formula == other.formula
    }
}

impl Expression {
    /// The formula without the values of its constants.
    pub fn formula(&self) -> &str {
        &self.formula
    }

    /// Its constants in the order of the formula; the default of one without a value is NaN.
    pub fn constants(&self) -> &[Constant] {
        &self.constants
    }

    /// The same formula with these values of its constants and with the bounds of some; the others keep those that they
    /// state, or get some around their values.
    pub(super) fn with(
        &self,
        values: &[f64],
        bounds: &BTreeMap<String, [f64; 2]>,
    ) -> Result<Self, String> {
        let mut changed = self.clone();
        for (one, &value) in changed.constants.iter_mut().zip(values) {
            let is_new = one.default.is_nan() && !value.is_nan();
            let stated = if is_new { bounds_around(value) } else { one.bounds };
            let bounds = bounds.get(one.name.as_ref()).copied().unwrap_or(stated);
            *one = constant(one.name.to_string(), value, bounds);
        }
        let is_known = |name: &String| self.constants.iter().any(|one| one.name == *name);
        match bounds.keys().find(|name| !is_known(name)) {
            Some(name) => Err(format!("the formula `{}` has no constant `{name}`", self.formula)),
            None => Ok(changed),
        }
    }

    /// Whether it is a function of the stored value x instead of t.
    pub fn is_of_stored(&self) -> bool {
        self.root.contains(1)
    }

    /// The formula at t, or at x, unclamped.
    pub fn at<T: Real>(&self, input: T, constants: &Constants<T>) -> T {
        let mut values = [input; VARIABLES.len() + MAX_CONSTANTS];
        values[VARIABLES.len()..].copy_from_slice(constants);
        self.root.value(&values)
    }

    /// Its values from black on, which kernels interpolate.
    pub(super) fn table(&self, constants: &[f64]) -> Table {
        let knot = |i: u32| {
            let u = f64::from(i) / f64::from(KNOTS);
            u.powi(3) / (1.0 - u)
        };
        let x: Vec<f64> = (0..KNOTS).map(knot).collect();
        let constants = padded(constants);
        // Values far outside of [0, 1] would bend the curve between knots.
        let y = x.iter().map(|&x| self.at(x, &constants).clamp(-1.0, 2.0)).collect();
        Table { is_of_stored: self.is_of_stored(), x, y: vec![y] }
    }

    /// Checks its values: each constant has one, and the curve is finite and never falls.
    pub(super) fn check(&self, values: &[f64]) -> Result<(), String> {
        let formula = &self.formula;
        for (Constant { name, bounds: [low, high], .. }, value) in self.constants.iter().zip(values)
        {
            if value.is_nan() {
                return Err(format!(
                    "the constant {name} of `{formula}` has no value; write `{formula}; {name} = VALUE`, or fit it \
                     with `nightsplat tone fit --family`"
                ));
            }
            let is_range = low < high && low.is_finite() && high.is_finite();
            if !is_range {
                return Err(format!(
                    "the bounds of {name} in `{formula}` are {low} and {high}; give a lower and a higher number"
                ));
            }
        }
        let (padded, variable) = (padded(values), VARIABLES[usize::from(self.is_of_stored())]);
        let with = self.constants.iter().zip(values);
        let with: String =
            with.map(|(constant, value)| format!(", {} = {value}", constant.name)).collect();
        let mut before = 0.0_f64;
        for x in self.table(values).x {
            let y = self.at(x, &padded);
            if !y.is_finite() {
                return Err(format!(
                    "`{formula}` is {y} at {variable} = {x:.4}{with}; it must be finite"
                ));
            }
            let y = y.clamp(0.0, 1.0);
            if y < before - TOLERANCE {
                return Err(format!(
                    "`{formula}` falls at {variable} = {x:.4}{with}; a tone curve must not fall"
                ));
            }
            before = y;
        }
        Ok(())
    }
}
