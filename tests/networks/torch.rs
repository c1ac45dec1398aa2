//! The networks against `PyTorch`: `tests/fixtures/torch/README.md` describes each tensor and its origin.

use nightsplat::networks::{Denoiser, Parameters, Tonemapper};
use safetensors::SafeTensors;

use super::largest;
use super::networks::{Outcome, assert_gradients, run_denoiser, run_tonemapper};
use crate::common::prelude::*;

const SIZE: UVec2 = UVec2::new(9, 7);

/// `PyTorch`'s inputs, outputs and gradients of one network.
struct Fixture {
    bytes: Vec<u8>,
    network: &'static str,
}

impl Fixture {
    fn new(network: &'static str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"));
        let path = path.join("tests/fixtures/torch/networks.safetensors");
        Self { bytes: fs::read(path).unwrap(), network }
    }

    fn get(&self, name: &str) -> Vec<f32> {
        let file = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = file.tensor(&format!("{}.{name}", self.network)).unwrap();
        bytemuck::pod_collect_to_vec(tensor.data())
    }

    /// The tensors, or their gradients, in the order of the network's.
    fn layers(&self, parameters: &Parameters, gradient: &str) -> Vec<f32> {
        let name = |name: &str| format!("{gradient}{}", name.trim_start_matches("0."));
        parameters.tensors().iter().flat_map(|tensor| self.get(&name(&tensor.name))).collect()
    }

    fn images<const N: usize>(&self, names: [&str; N]) -> [Vec<f32>; N] {
        names.map(|name| self.get(name))
    }

    fn check(
        &self,
        parameters: &Parameters,
        outcome: &Outcome,
        [output, first, second]: [&str; 3],
    ) {
        let relative = |name: &str, actual: &[f32]| {
            let expected = self.get(name);
            let bound = 1e-4 * largest(&expected);
            assert_close(name, actual, &expected, |_, _| bound);
        };
        relative(output, &outcome.output);
        relative(first, &outcome.inputs[0]);
        relative(second, &outcome.inputs[1]);
        let expected = self.layers(parameters, "d_");
        assert_gradients(self.network, parameters, &outcome.parameters, &expected);
    }
}

#[test]
fn a_denoiser_stage_agrees_with_pytorch() {
    let fixture = Fixture::new("stage");
    let variant = NetworkVariant::Paper;
    let settings =
        DenoiserSettings { stages: 1, repeats: 3, channels: 8, variant, ..Default::default() };
    let mut denoiser = Denoiser::new(&gpu(), settings, 0).unwrap();
    let values = fixture.layers(denoiser.parameters(), "");
    gpu().write(&mut denoiser.parameters_mut().values, &values).unwrap();
    let [noise, render, d] = fixture.images(["noise", "r0", "d_r1"]);
    let outcome = run_denoiser(&mut denoiser, SIZE, [&noise, &render, &d]);
    fixture.check(denoiser.parameters(), &outcome, ["r1", "d_noise", "d_r0"]);
}

#[test]
fn the_tonemapper_agrees_with_pytorch() {
    let fixture = Fixture::new("tonemapper");
    let mut tonemapper = Tonemapper::new(&gpu(), NetworkVariant::Paper, 0).unwrap();
    let values = fixture.layers(tonemapper.parameters(), "");
    gpu().write(&mut tonemapper.parameters_mut().values, &values).unwrap();
    let [illumination, denoised, d] = fixture.images(["illumination", "denoised", "d_low"]);
    let outcome = run_tonemapper(&mut tonemapper, SIZE, [&illumination, &denoised, &d]);
    fixture.check(tonemapper.parameters(), &outcome, ["low", "d_illumination", "d_denoised"]);
}
