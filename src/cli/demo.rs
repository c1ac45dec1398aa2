//! `nightsplat demo`: make a dark multi-view set, and sweep three curves over it.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::sweep::{self, SweepArgs, parsed};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::photographs::dataset::synthetic::{self, SyntheticOptions};

/// Make a small dark multi-view set, train on it with three tone curves, and show the results side by side.
///
/// Takes less than three minutes on two processor cores. Leaves DIR/index.html, a page that needs no other file, and
/// beside it the set (DIR/dataset) and what `nightsplat sweep` leaves. An interrupted demo goes on.
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {
    /// The folder to write to, empty or with an earlier demo
    #[arg(long, value_name = "DIR", default_value = "demo")]
    pub out: PathBuf,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// The baseline first; enough steps for a clear picture, few enough for two processor cores.
const SWEEP: [&str; 6] = ["--curves", "linear,ase,ap3", "--steps", "400", "--sh-degree", "1"];

/// Runs the demo.
///
/// # Errors
/// The folder holds something else, a file cannot be written, or there is no device.
pub fn run(args: &DemoArgs) -> Result<()> {
    claim(&args.out)?;
    let set = args.out.join("dataset");
    if !args.out.join("sweep.toml").exists() {
        synthetic::write(&set, &SyntheticOptions::default())?;
    }
    let paths = [&set, Path::new("--out"), &args.out].map(Path::as_os_str);
    let device = args.device.iter().flat_map(|it| ["--device".to_owned(), it.to_string()]);
    let words = ["sweep"].map(OsString::from).into_iter();
    let words = words.chain(paths.map(OsString::from)).chain(SWEEP.map(OsString::from));
    let sweep: SweepArgs = parsed("demo", words.chain(device.map(OsString::from)))?;
    let intro = format!(
        "Trained on photographs that were exposed {} times too short: shot and read noise, 8 bits. Each curve lifts every \
         photograph into the target that supervises training. The normal-light reference images are used for nothing but \
         the scores below.",
        synthetic::DARKENING
    );
    sweep::run_titled(&sweep, "3D Gaussian Splatting from dark photographs", &[intro])
}

/// Takes a folder that is empty, or holds an earlier demo.
fn claim(folder: &Path) -> crate::Result<()> {
    let is_empty = std::fs::read_dir(folder).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !folder.join("dataset").exists() {
        let problem = "is not empty and holds no earlier demo; choose another folder with --out";
        return Err(Error::output(folder, problem));
    }
    Ok(())
}
