//! `hashes.csv`: checksums of every parameter plane, to compare two machines line by line.
//!
//! ```text
//! step,gaussians,means,quats,log_scales,raw_opacities,dc,features,rest
//! 100,1482,3c0a...,...
//! ```

use nightsplat_core::hash;
use nightsplat_models::gaussians::{ATTRIBUTES, Gaussians};

/// The table with a line for `step`. Lines of this and later steps are removed: a resumed run repeats them.
pub(super) fn extended(recorded: &str, step: u64, gaussians: &Gaussians) -> String {
    let names = ATTRIBUTES.each_ref().map(|spec| spec.name).join(",");
    let is_before = |line: &&str| {
        let row_step = line.split(',').next().and_then(|row_step| row_step.parse::<u64>().ok());
        row_step.is_some_and(|row_step| row_step < step)
    };
    let plane = |attribute| {
        let plane = &gaussians.parameters[gaussians.plane(attribute)];
        hash::text(hash::checksum(bytemuck::cast_slice(plane)))
    };
    let planes = ATTRIBUTES.each_ref().map(|spec| plane(spec.attribute)).join(",");
    let lines = recorded.lines().filter(is_before).map(|line| format!("{line}\n"));
    format!(
        "step,gaussians,{names}\n{}{step},{},{planes}\n",
        lines.collect::<String>(),
        gaussians.count
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ledger_names_the_plane_that_differs_and_drops_repeated_steps() {
        let gaussians = Gaussians::zeros(3, 1);
        let mut other = gaussians.clone();
        other.dc_mut()[1].y = 1e-6;
        let [one, two] = [&gaussians, &other].map(|gaussians| extended("", 10, gaussians));
        let cells = |text: &str| -> Vec<String> {
            text.lines().last().unwrap().split(',').map(str::to_owned).collect()
        };
        let header: Vec<&str> = one.lines().next().unwrap().split(',').collect();
        let (ones, twos) = (cells(&one), cells(&two));
        let differ: Vec<&str> =
            (0..header.len()).filter(|&i| ones[i] != twos[i]).map(|i| header[i]).collect();
        assert_eq!(differ, ["dc"]);
        let longer = extended(&extended(&one, 20, &other), 30, &other);
        assert_eq!(longer.lines().count(), 4);
        assert_eq!(extended(&longer, 20, &other), extended(&one, 20, &other));
    }
}
