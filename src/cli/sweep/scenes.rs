//! A sweep over several datasets: each in its own folder, and the table that papers print.
//!
//! ```text
//! OUT/SCENE/          the sweep of a dataset
//!     index.html      all datasets: a link to the page of each, the table, a bar per point
//!     scenes.md       a row per point, the best mean first, a column per dataset and their mean: PSNR / SSIM / LPIPS
//!     scenes.csv      a row per point and dataset, with every digit
//!     scenes.tex      the rows of scenes.md for LaTeX
//! ```

use anyhow::Result;
use nightsplat_core::output::printable;

use super::SweepArgs;
use crate::Error;
use crate::cli::{finish, tell};
use crate::results::sweep::{SceneResults, SceneTable};

/// Sweeps one dataset after the other, and writes the tables.
pub(super) fn run(args: &SweepArgs) -> Result<()> {
    let datasets = std::iter::once(&args.dataset).chain(&args.more);
    let mut names: Vec<String> = vec![];
    for dataset in datasets.clone() {
        let name =
            dataset.file_name().unwrap_or(dataset.as_os_str()).to_string_lossy().into_owned();
        if names.contains(&name) {
            let problem =
                format!("two datasets are named {name}; rename one, each has a folder of its own");
            return Err(Error::Usage(problem).into());
        }
        names.push(name);
    }
    let (mut scenes, mut failed) = (vec![], vec![]);
    for (dataset, name) in datasets.zip(names) {
        let args_of_scene = SweepArgs {
            dataset: dataset.clone(),
            more: vec![],
            out: args.out.join(&name),
            renders: args.renders.iter().map(|renders| renders.of_scene(&name)).collect(),
            ..args.clone()
        };
        let title = format!("Sweep of {name}");
        let Some((rows, failures)) = super::swept(&args_of_scene, &title, &[], None)? else {
            continue;
        };
        failed.extend(failures.into_iter().map(|failure| (name.clone(), failure)));
        scenes.push(SceneResults { name, rows });
    }
    if scenes.is_empty() {
        return Ok(());
    }
    let table = SceneTable::new(&scenes);
    table.save(&args.out)?;
    if !args.json {
        tell(printable(&table.markdown()).into_owned() + "\n");
        let out = args.out.display();
        finish(
            &format!("{out}/index.html, {out}/scenes.md, {out}/scenes.csv, {out}/scenes.tex"),
            &format!("open {out}/index.html"),
        );
    }
    match failed.first() {
        None => Ok(()),
        Some((scene, first)) => {
            anyhow::bail!("{} points failed; the first: {scene}: {}", failed.len(), first.reason)
        }
    }
}
