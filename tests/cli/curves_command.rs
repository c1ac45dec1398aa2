//! `nightsplat tone list`, in process.

use clap::Parser;
use nightsplat::cli::tone::list::{ListArgs, text};
use nightsplat_photographs::tone::FAMILIES;
use nightsplat_synth::SyntheticOptions;

use crate::common::command::{Folder, says};

#[derive(Debug, Parser)]
struct Command {
    #[command(flatten)]
    curves: ListArgs,
}

fn parse(arguments: &str) -> Result<ListArgs, clap::Error> {
    let words = std::iter::once("list").chain(arguments.split_whitespace());
    Command::try_parse_from(words).map(|command| command.curves)
}

fn printed(arguments: &str) -> String {
    text(&parse(arguments).unwrap()).unwrap()
}

#[test]
fn every_curve_is_listed_with_its_formula_and_source() {
    let listing = printed("");
    for family in &FAMILIES {
        assert!(listing.lines().any(|line| line.starts_with(family.name)), "{}", family.name);
        assert!(listing.contains(family.formula) && listing.contains(family.source));
    }
    assert!(printed("gamma").contains("a = 0.7199, b = 0.5617"));
}

#[test]
fn values_agree_with_the_formula() {
    let values = printed("gamma hable-2010 linear ap3 --table --at 0.25,1");
    let row = |name: &str| {
        let line = values.lines().find(|line| line.starts_with(name)).unwrap();
        line.split_whitespace().skip(1).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(row("t"), ["0.25", "1"]);
    assert_eq!(row("gamma"), ["0.330", "0.720"]);
    assert_eq!(row("linear"), ["0.250", "1.000"]);
    assert_eq!(row("ap3"), ["0.222", "0.629"]);
    assert!(text(&parse("gamma --table --at=-1").unwrap()).is_err());
}

#[test]
fn curves_are_drawn_with_the_statistics_of_a_dataset() {
    let folder = Folder::empty();
    let options = SyntheticOptions { width: 32, height: 24, ..Default::default() };
    nightsplat_synth::write(folder.path("set"), &options).unwrap();
    folder.write("mine.csv", "0,0\n1,0.7\n2,1\n");
    let curves = "ap3 ase linear lum_preserve per_channel p80 @mine.csv";
    printed(&folder.named(&format!("{curves} --plot @curves.svg --dataset @set")));
    let svg = folder.text("curves.svg");
    assert!(svg.starts_with("<svg xmlns=") && svg.matches("<polyline").count() == 7, "{svg}");
    says(&svg, &[">p10<", ">p90<", ">mean Y<", ">mine<", "--series-0"]);
    assert!(!svg.contains("NaN"));
}

#[test]
fn a_plot_without_names_shows_every_curve_that_is_listed() {
    let folder = Folder::empty();
    let message = printed(&folder.named("--plot @curves.svg"));
    let all = FAMILIES.len() + 1;
    assert!(message.contains(&format!("{all} curves")), "{message}");
    assert_eq!(folder.text("curves.svg").matches("<polyline").count(), all);
}

#[test]
fn an_unknown_curve_is_misuse() {
    let error = parse("gama").unwrap_err();
    assert_eq!(error.exit_code(), 2);
    assert!(error.to_string().contains("sinh_ratio"));
}

#[test]
fn a_formula_is_listed_tabulated_and_plotted_by_its_text() {
    let text = "a*t/(t+b);a=1.2;b=0.3";
    says(&printed(text), &["a*t/(t+b); a = 1.2; b = 0.3\n    a formula of your own"]);
    says(&printed(&format!("{text} t^0.45 --table --at 0.3,1")), &["0.600", "0.923"]);
    let folder = Folder::empty();
    printed(&folder.named(&format!("{text} t^0.45 ap3 --plot @curves.svg")));
    says(&folder.text("curves.svg"), &["a*t/(t+b); a = 1.2; b = 0.3", "t^0.45"]);
    says(&parse("gama").unwrap_err().to_string(), &["the nearest is `gamma`"]);
}
