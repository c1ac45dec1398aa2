//! Devices without push descriptors bind sets, and nothing else is different.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::gpu::PUSH_VARIABLE;

mod common;
use common::command::{command, succeed};

/// Trains, every part switched on, and checks the passes of a step on the way; the model's bytes.
fn trained(scene: &str, out: &str, push: &str) -> Vec<u8> {
    let line =
        format!("train {scene} --out {out} --steps 12 --model lita --check-every 6 --seed 3");
    let output = command(&line).env(PUSH_VARIABLE, push).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    std::fs::read(format!("{out}/model.ply")).unwrap()
}

#[test]
fn descriptors_in_sets_train_to_the_bits_of_pushed_ones() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    succeed(&format!("synth {} --views 4 --width 32 --height 24", path("scene")));
    let [pushed, in_sets] = ["on", "off"].map(|push| trained(&path("scene"), &path(push), push));
    assert!(pushed == in_sets, "the models differ");
}
