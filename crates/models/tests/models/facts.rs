//! Facts that files state beside their Gaussians.

use std::fs;

use nightsplat_core::Error;
use nightsplat_models::files;
use nightsplat_models::gaussians::{Gaussians, ModelFacts, ply};

use crate::common::{Folder, says};

#[test]
fn an_invalid_fact_in_a_file_is_an_error_of_one_line() {
    let folder = Folder::empty();
    let path = folder.path("model.ply");
    let facts = ModelFacts { near: Some(0.2), max_alpha: Some(0.99), ..ModelFacts::default() };
    // All zeros: the file is text.
    ply::save_with_comments(&Gaussians::zeros(2, 0), &path, &facts.comments()).unwrap();
    let whole = folder.text("model.ply");
    let stating = |comment: &str| {
        fs::write(&path, whole.replacen("element", &format!("comment {comment}\nelement"), 1))
            .unwrap();
        files::read(&path).map(|(_, facts)| facts)
    };
    let problem = |comment: &str| {
        let error = stating(comment).unwrap_err();
        assert!(matches!(error, Error::Input { .. }), "{error:?}");
        let error = error.to_string();
        let (_, problem) = error.split_once("model.ply: ").unwrap();
        let fact = problem.strip_suffix("; export the model again");
        fact.unwrap_or_else(|| panic!("no remedy: {problem}")).to_owned()
    };
    let above_0 = ["x", "-1", "0", "NaN", "inf", ""]
        .map(|near| ("nightsplat near", near, "states near", "a finite number above 0"));
    for (comment, value, verb, rule) in above_0.into_iter().chain([
        ("nightsplat max_alpha", "1", "states max_alpha", "a finite number between 0 and 1"),
        ("world = position +", "1 2", "names the origin", "three finite numbers"),
    ]) {
        let expected = format!("line 5 {verb} `{value}`, which is not {rule}");
        assert_eq!(problem(&format!("{comment} {value}")), expected);
    }
    let neither = "line 5 states raw_colors `on`, which is neither true nor false";
    assert_eq!(problem("nightsplat raw_colors on"), neither);
    // Facts of later versions are skipped.
    assert_eq!(stating("nightsplat later 1 2").unwrap(), facts);

    fs::write(&path, "solid cube").unwrap();
    let error = files::read(&path).unwrap_err().to_string();
    says(&error, &["model.ply: is not a model: neither PLY, SPZ nor SOG"]);
}
