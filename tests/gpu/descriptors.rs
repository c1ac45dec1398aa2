//! Devices without push descriptors bind sets, with the same results.

use std::thread;

use nightsplat::gpu::testing::{compiled, gpu_that_binds_sets};
use nightsplat::gpu::{PUSH_VARIABLE, Threads};
use nightsplat::kernels::{blend_forward, relu_backward};

use crate::common::command::{command, succeed};

/// Trains with every part enabled, and checks the passes of a step; returns the model's bytes.
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

#[test]
fn a_device_compiles_a_kernel_once_for_each_choice_of_constants_and_keeps_it() {
    let gpu = gpu_that_binds_sets();
    let before = compiled(&gpu);
    let compile = |channels| {
        let constants = blend_forward::Constants { channels, ..Default::default() };
        gpu.pipeline::<blend_forward::Kernel>(&constants).unwrap();
    };
    compile(3);
    compile(4);
    assert_eq!(compiled(&gpu), before + 2);
    thread::scope(|scope| {
        (0..4).for_each(|_| drop(scope.spawn(|| [3, 4, 5].map(compile))));
    });
    assert_eq!(compiled(&gpu), before + 3);
}

#[test]
fn a_recording_of_many_passes_binds_each_its_own_buffers_in_sets() {
    let gpu = gpu_that_binds_sets();
    let pipeline =
        gpu.pipeline::<relu_backward::Kernel>(&relu_backward::Constants::default()).unwrap();
    let activations = gpu.buffer("activations", &[0.0f32, 1.0]).unwrap();
    // More than the sets of two pools.
    let mut gradients: Vec<_> =
        (0..131u8).map(|i| gpu.buffer("gradient", &[f32::from(i) + 1.0; 2]).unwrap()).collect();
    for _ in 0..2 {
        gpu.run("many passes", |pass| {
            for gradient in &mut gradients {
                let params = relu_backward::Params { value_count: 2 };
                let buffers = relu_backward::Buffers {
                    activations: activations.slice(),
                    gradient: gradient.slice_mut(),
                };
                pass.dispatch(&pipeline, &params, buffers, Threads::Exactly([2, 1, 1]))?;
            }
            Ok(())
        })
        .unwrap();
    }
    for (i, gradient) in (0..131u8).zip(&gradients) {
        assert_eq!(gpu.read(gradient).unwrap(), [0.0, f32::from(i) + 1.0]);
    }
}
