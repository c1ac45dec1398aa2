//! The table of attributes as GLSL.

use std::fmt::Write as _;

use table::{ATTRIBUTES, Width};

#[path = "../src/splats/attributes.rs"]
#[allow(dead_code, unreachable_pub, reason = "the crate sees more of the table than the shaders")]
mod table;

/// The include that shaders see the table as.
pub(crate) const INCLUDE: &str = "attributes.glsl";

/// Where the planes of the attributes begin.
pub(crate) fn glsl() -> String {
    let (rest, fixed) = ATTRIBUTES.split_last().expect("there are attributes");
    assert!(rest.width == Width::Rest && fixed.last().is_some_and(|s| s.width == Width::Features));
    let mut out = "// Made by build.rs from src/splats/attributes.rs.\n\n".to_owned();
    for spec in fixed {
        let (name, column) = (spec.name.to_uppercase(), spec.attribute.column(0));
        writeln!(out, "const uint {name}_COLUMN = {column};  // {}", spec.content)
            .expect("writing to a string");
    }
    let columns: Vec<String> =
        fixed.iter().map(|spec| format!("{}_COLUMN", spec.name.to_uppercase())).collect();
    out + &format!(
        "
// Where a plane begins; plane PLANE_COUNT is where the last ends.
const uint PLANE_COUNT = {};
uint plane_column(uint plane, uint feature_count, uint column_count) {{
    const uint COLUMNS[PLANE_COUNT - 1] = uint[]({});
    if (plane < PLANE_COUNT - 1) return COLUMNS[plane];
    return plane < PLANE_COUNT ? FEATURES_COLUMN + feature_count : column_count;
}}
",
        ATTRIBUTES.len(),
        columns.join(", ")
    )
}
