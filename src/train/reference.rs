//! The reference of settings, docs/settings.md, from their rows and the presets.

use std::fmt::Write;

use nightsplat_core::settings::Setting;
use toml::Value;

use super::config::TrainConfig;
use super::layers::values;
use super::preset::Preset;
use super::settings::SETTINGS;
use crate::Result;

/// The text of docs/settings.md: every setting and every preset.
pub fn reference() -> Result<String> {
    let mut text = "# Settings\n\n\
        Every setting of a training run, by its key in `config.toml` and for `train --set KEY=VALUE`, with its \
        option if it has\n\
        one. Precedence, weakest first: default, preset, plan, `--config FILE`, options, `--set`. \
        `train --explain` prints each\n\
        setting with its value and origin, as does `config.toml` of a run. This page is generated from the \
        command's table.\n"
        .to_owned();
    let values = values(&TrainConfig::default())?;
    let mut section = None;
    for row in SETTINGS.iter() {
        let section_of_row = row.key.rsplit_once('.').map_or("", |(section, _)| section);
        if section != Some(section_of_row) {
            let title = if section_of_row.is_empty() {
                "The run".to_owned()
            } else {
                format!("`[{section_of_row}]`")
            };
            let _ = write!(
                text,
                "\n## {title}\n\n| key | default | takes | what it does |\n|---|---|---|---|\n"
            );
            section = Some(section_of_row);
        }
        let default = values.get(row.key.as_ref()).filter(|_| row.absent.is_none());
        let _ = writeln!(
            text,
            "| `{}` | {} | {} | {} |",
            row.key,
            cell(row, default),
            escaped(&row.takes()),
            escaped(&told(row)),
        );
    }
    text += "\n## The presets\n\nDifferences from the defaults, which are `balanced`:\n\n";
    presets(&mut text)?;
    Ok(text)
}

fn told(row: &Setting) -> String {
    let option = row.option.map(|option| format!(" `{option}`")).unwrap_or_default();
    format!("{}.{option}", row.help())
}

/// The table of presets: a row for each setting in which one differs.
fn presets(text: &mut String) -> Result<()> {
    const SHOWN: [Preset; 5] =
        [Preset::Balanced, Preset::Draft, Preset::Fast, Preset::Best, Preset::Paper];
    let of = |preset: Preset| {
        let mut config = TrainConfig::default();
        preset.apply(&mut config)?;
        values(&config)
    };
    let all = SHOWN.into_iter().map(of).collect::<Result<Vec<_>>>()?;
    let names = SHOWN.map(Preset::name).join(" | ");
    let _ = write!(text, "| | {names} |\n|---|---|---|---|---|---|\n");
    for row in SETTINGS.iter() {
        let values = all.iter().map(|values| values.get(row.key.as_ref()));
        let values: Vec<Option<&Value>> = values.collect();
        if values.iter().any(|value| *value != values[0]) {
            let cells = values.iter().map(|value| cell(row, *value));
            let _ = writeln!(text, "| `{}` | {} |", row.key, cells.collect::<Vec<_>>().join(" | "));
        }
    }
    Ok(())
}

/// The value of a setting, or what its absence means.
fn cell(row: &Setting, value: Option<&Value>) -> String {
    let absent = || row.absent.unwrap_or_default().to_owned();
    value.map_or_else(absent, |value| format!("`{value}`"))
}

/// Text escaped for a table cell.
fn escaped(text: &str) -> String {
    text.replace('|', "\\|")
}
