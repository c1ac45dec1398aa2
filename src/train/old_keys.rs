//! Former names of settings, accepted in files and by `--set` for one more release.

/// Former key, key.
const RENAMED: [(&str, &str); 9] = [
    ("density.fill", "density.depth_seeding"),
    ("model.network.form", "model.network.variant"),
    ("schedule.boost", "schedule.initial_rate_factor"),
    ("schedule.boost_steps", "schedule.initial_rate_steps"),
    ("schedule.settle_rate", "schedule.cooldown_rate"),
    ("schedule.settle_steps", "schedule.cooldown_steps"),
    ("start.thinnest", "start.min_axis_ratio"),
    ("tone.family", "tone.curve"),
    ("tone.lift_first", "tone.full_resolution"),
];

/// The current key of a setting, which may be given by its former name.
pub(super) fn current(key: &str) -> &str {
    RENAMED.iter().find(|(former, _)| *former == key).map_or(key, |(_, key)| key)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::TrainConfig;
    use crate::train::settings::setting;

    #[test]
    fn a_configuration_with_former_names_is_read_as_one_with_current_names() {
        let former = "[schedule]\nboost = 2.0\nboost_steps = 7\nsettle_steps = 9\nsettle_rate = 0.5\n\
            [start]\nthinnest = 0.5\n[density]\nfill = 70\n[model.network]\nform = \"paper\"\n\
            [tone]\nfamily = \"ap3\"\nlift_first = true\n";
        let today = "[schedule]\ninitial_rate_factor = 2.0\ninitial_rate_steps = 7\n\
            cooldown_steps = 9\ncooldown_rate = 0.5\n[start]\nmin_axis_ratio = 0.5\n\
            [density]\ndepth_seeding = 70\n[model.network]\nvariant = \"paper\"\n\
            [tone]\ncurve = \"ap3\"\nfull_resolution = true\n";
        let [former, today] = [former, today].map(|text| TrainConfig::from_toml(text).unwrap());
        assert_eq!(former, today);
        assert_ne!(former, TrainConfig::default());
        let set = TrainConfig::default().with(&["density.fill=70".to_owned()]).unwrap();
        assert_eq!(set.density.depth_seeding, 70);
    }

    #[test]
    fn a_former_name_maps_to_a_setting_and_is_not_one_itself() {
        for (former, key) in RENAMED {
            assert!(setting(key).is_some() && setting(former).is_none(), "{former}: {key}");
        }
    }
}
