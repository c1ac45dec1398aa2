//! Properties for arbitrary input: models that are written and read back.

use nightsplat_models::gaussians::{Gaussians, ply};
use proptest::prelude::*;

use crate::arbitrary::cases;
use crate::common::Folder;

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn gaussians_survive_their_ply(
        sh_degree in 0..4_u32, numbers in prop::collection::vec(prop::num::f32::NORMAL | prop::num::f32::ZERO, 59 * 5),
        count in 0..6_usize,
    ) {
        let mut gaussians = Gaussians::zeros(count, sh_degree);
        gaussians.parameters.iter_mut().zip(numbers).for_each(|(parameter, number)| *parameter = number);
        let folder = Folder::empty();
        ply::save(&gaussians, folder.join("a.ply")).unwrap();
        prop_assert_eq!(ply::load(folder.join("a.ply")).unwrap(), gaussians);
    }
}
