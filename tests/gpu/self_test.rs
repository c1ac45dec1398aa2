//! The self-test of a device: a sound one passes, and each kind of defect is named.

use nightsplat::Error;
use nightsplat::gpu::testing::faults;
use nightsplat::kernels::self_test::{
    CHECK_BALLOT, CHECK_EXP, CHECK_HALF, CHECK_LANE, CHECK_LAST, CHECK_LOG, CHECK_SHUFFLE,
    CHECK_SIZE, CHECK_SQRT, CHECK_SUBGROUP, CHECK_SUM, CHECK_WORD, CHECKS,
};

use crate::common::prelude::*;

fn refusal(gpu: &Gpu) -> String {
    let refused = gpu.self_test().unwrap_err();
    assert!(matches!(refused, Error::SelfTest { .. }) && refused.exit_code() == 4, "{refused}");
    let message = refused.to_string();
    assert!(message.contains(&gpu.properties().name) && !message.contains('\n'), "{message}");
    message
}

#[test]
fn a_sound_device_passes_and_agrees_with_the_reference() {
    let gpu = gpu();
    let (done, report) = gpu.checked(|| gpu.self_test());
    done.unwrap();
    report.agree().unwrap();
    assert_eq!(
        report.kernels().first().map(|(name, passes, _)| (*name, *passes)),
        Some(("self_test", 2))
    );
}

#[test]
fn each_defect_is_found_and_named() {
    let gpu = Gpu::with_validation(&"".parse().unwrap()).unwrap();
    for (check, name) in [
        (CHECK_SIZE, "lanes where"),
        (CHECK_LANE, "order of its threads"),
        (CHECK_SUBGROUP, "subgroups of a workgroup"),
        (CHECK_BALLOT, "subgroupBallot"),
        (CHECK_SHUFFLE, "subgroupShuffle"),
        (CHECK_SUM, "subgroupInclusiveAdd"),
        (CHECK_LAST, "the last workgroup"),
        (CHECK_HALF, "packHalf2x16"),
        (CHECK_WORD, "a word"),
        (CHECK_EXP, "exp is"),
        (CHECK_LOG, "log is"),
        (CHECK_SQRT, "sqrt is"),
    ] {
        faults(&gpu).plant_check(Some(check));
        let message = refusal(&gpu);
        assert!(message.contains(name), "{check}: {message}");
    }
    faults(&gpu).plant_check(Some(CHECKS));
    gpu.self_test().unwrap();
}

/// As layers over another API do: they name one size, and the GPU runs another.
#[test]
fn a_device_whose_subgroups_are_smaller_than_it_reports_is_refused_with_the_size_to_set() {
    let gpu = gpu_with(|properties| {
        properties.subgroup_size *= 2;
        properties.subgroup_size_is_selectable = false;
    });
    let lanes = gpu.properties().subgroup_size;
    let message = refusal(&gpu);
    let [what, remedy] = [
        format!("subgroups have {} lanes where {lanes} were asked for", lanes / 2),
        format!("set NIGHTSPLAT_SUBGROUP={}", lanes / 2),
    ];
    assert!(message.contains(&what) && message.contains(&remedy), "{message}");
}
