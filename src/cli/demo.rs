//! `nightsplat demo`: a small dark dataset, trained with several tone curves.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Result;
use nightsplat_synth::{self, SyntheticOptions};

use super::export::{self, ExportArgs};
use super::sweep::{self, SweepArgs, parsed};
use crate::Error;
use crate::gpu::DeviceChoice;

/// Write a small dark dataset, train on it with several tone curves, and compare the results on a page.
///
/// Takes about four minutes on two processor cores. DIR/index.html is a self-contained page; the dataset is in
/// DIR/dataset, with a run directory per curve next to it. An interrupted demo continues.
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {
    /// Folder to write to: new, empty or with an earlier demo
    #[arg(long, value_name = "DIR", default_value = "demo")]
    pub out: PathBuf,
    /// Steps of each curve; fewer give a coarser picture sooner
    #[arg(long, value_name = "N", default_value_t = 500, value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: u64,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// The default curve and others, including the paper's.
const SWEEP: [&str; 4] = ["--curves", "auto,ase,ap3,linear", "--sh-degree", "1"];
/// The size of the photographs.
const SIZE: [u32; 2] = [384, 288];
/// The run whose model is exported.
const SHOWN: &str = "curve=auto";

/// Runs the demo.
pub fn run(args: &DemoArgs) -> Result<()> {
    claim(&args.out)?;
    let set = args.out.join("dataset");
    if !args.out.join("sweep.toml").exists() {
        let [width, height] = SIZE;
        let options = SyntheticOptions { width, height, ..SyntheticOptions::default() };
        nightsplat_synth::write(&set, &options)?;
    }
    let device = args.device.iter().flat_map(|it| ["--device".to_owned(), it.to_string()]);
    let device: Vec<OsString> = device.map(OsString::from).collect();
    let command = |name: &str, paths: &[&Path], options: &[&str]| {
        let paths = paths.iter().map(|path| path.as_os_str().to_owned());
        let options = options.iter().map(OsString::from).chain(device.clone());
        std::iter::once(OsString::from(name)).chain(paths).chain(options).collect::<Vec<_>>()
    };
    let paths = [set.as_path(), Path::new("--out"), &args.out];
    let steps = ["--steps", &args.steps.to_string()];
    let sweep: SweepArgs =
        parsed("demo", command("sweep", &paths, &[&SWEEP[..], &steps].concat()))?;
    let intro = format!(
        "Trained on photographs that are underexposed by a factor of {}, with shot and read noise, at 8 bits. Each \
         tone curve maps the photographs to the targets of training. The reference images in normal light are used for \
         the scores only.",
        nightsplat_synth::DARKENING
    );
    let window = [
        format!("{SHOWN}/model.html"),
        "The model of the curve auto, in a window of its own".to_owned(),
    ];
    let title = "3D Gaussian Splatting from dark photographs";
    sweep::run_titled(&sweep, title, &[intro], Some(window))?;
    let shown = args.out.join(SHOWN);
    let export = command("export", &[&shown], &["--format", "html", "--title", "A dark room"]);
    export::write(&parsed::<ExportArgs>("demo", export)?)?;
    Ok(())
}

/// Refuses a folder with anything but an earlier demo.
fn claim(folder: &Path) -> crate::Result<()> {
    let is_empty = std::fs::read_dir(folder).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !folder.join("dataset").exists() {
        let problem = "is not empty and contains no earlier demo; choose another folder with --out";
        return Err(Error::output(folder, problem));
    }
    Ok(())
}
