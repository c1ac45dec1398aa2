//! Network files: saved ones are read back, and unsuitable ones refused with a remedy.

use nightsplat::networks::{Denoiser, Precision, Tonemapper, load, save};
use safetensors::SafeTensors;

use crate::common::prelude::*;

const SMALL: DenoiserSettings = DenoiserSettings {
    stages: 2,
    repeats: 1,
    channels: 4,
    precision: Precision::Single,
    variant: NetworkVariant::Paper,
};

fn networks(settings: DenoiserSettings, seed: u64) -> (Denoiser, Tonemapper) {
    let gpu = gpu();
    (
        Denoiser::new(&gpu, settings, seed).unwrap(),
        Tonemapper::new(&gpu, NetworkVariant::Paper, seed).unwrap(),
    )
}

fn save_both(path: &Path, (denoiser, tonemapper): &(Denoiser, Tonemapper)) {
    let all = [denoiser.parameters(), tonemapper.parameters()];
    save(path, &all, &gpu()).unwrap();
}

fn load_both(
    path: &Path,
    (denoiser, tonemapper): &mut (Denoiser, Tonemapper),
) -> nightsplat::Result<()> {
    let mut all = [denoiser.parameters_mut(), tonemapper.parameters_mut()];
    load(path, &mut all, &gpu())
}

fn values((denoiser, tonemapper): &(Denoiser, Tonemapper)) -> [Vec<f32>; 2] {
    [denoiser.parameters(), tonemapper.parameters()].map(|p| gpu().read(&p.values).unwrap())
}

#[test]
fn saved_networks_are_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("networks.safetensors");
    let saved = networks(SMALL, 1);
    save_both(&path, &saved);
    let mut loaded = networks(SMALL, 2);
    assert_ne!(values(&saved), values(&loaded));
    load_both(&path, &mut loaded).unwrap();
    assert_eq!(values(&saved), values(&loaded));

    let bytes = fs::read(&path).unwrap();
    save_both(&path, &loaded);
    assert_eq!(bytes, fs::read(&path).unwrap(), "the same networks make the same file");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(file.tensor("denoiser.1.conv_out.weight").unwrap().shape(), [3, 4, 3, 3]);
    assert_eq!(file.tensor("tonemapper.conv1.bias").unwrap().shape(), [16]);
    assert_eq!(file.len(), 2 * 8 + 6);
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    let settings = &header.metadata().as_ref().unwrap()["networks"];
    assert!(settings.contains(r#""denoiser":{"stages":2,"repeats":1,"channels":4,"#), "{settings}");
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(left.len(), 1, "no partial file remains");
}

#[test]
fn networks_of_another_configuration_are_refused_and_nothing_changes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("networks.safetensors");
    save_both(&path, &networks(SMALL, 1));
    let cases: [(DenoiserSettings, &[&str]); 3] = [
        (DenoiserSettings { stages: 3, ..SMALL }, &["no tensor `denoiser.2.conv_in.weight`"]),
        (DenoiserSettings { stages: 1, ..SMALL }, &["`denoiser.1.conv.bias`", "lacks"]),
        (
            DenoiserSettings { channels: 5, ..SMALL },
            &["`denoiser.0.conv_in.weight` is [4, 3, 3, 3] F32, not [5, 3, 3, 3]"],
        ),
    ];
    for (settings, facts) in cases {
        let mut others = networks(settings, 2);
        let before = values(&others);
        let error = load_both(&path, &mut others).unwrap_err().to_string();
        let remedy = r#"use the settings it was made with: {"stages":2,"repeats":1,"channels":4,"#;
        let settings_of_run = serde_json::to_string(&settings).unwrap();
        for part in
            facts.iter().copied().chain(["networks.safetensors", remedy, settings_of_run.as_str()])
        {
            assert!(error.contains(part), "{part}: {error}");
        }
        assert_eq!(error.lines().count(), 1, "{error}");
        assert_eq!(values(&others), before);
    }
}

#[test]
fn damaged_files_are_detected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("networks.safetensors");
    let mut all = networks(SMALL, 1);
    let refused = |all: &mut _, part: &str| {
        let error = load_both(&path, all).unwrap_err().to_string();
        assert!(error.contains("networks.safetensors") && error.contains(part), "{error}");
    };
    refused(&mut all, "cannot be read");
    save_both(&path, &all);
    let whole = fs::read(&path).unwrap();
    for cut in [0, 7, 100, whole.len() - 4] {
        fs::write(&path, &whole[..cut]).unwrap();
        refused(&mut all, "not an intact safetensors file");
    }
    let mut poisoned = whole;
    let last = poisoned.len() - 4;
    poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    fs::write(&path, &poisoned).unwrap();
    refused(&mut all, "not finite");
    let nowhere = folder.path().join("missing/networks.safetensors");
    let error = save(&nowhere, &[all.0.parameters()], &gpu()).unwrap_err();
    assert!(error.to_string().contains("cannot be written"), "{error}");
}
