//! Floaters that were planted before the cameras are found, and a clean model keeps its Gaussians.

use glam::DMat4;

use crate::common::prelude::*;

/// Gaussians at random places of random views of a listing, before what they show.
fn floaters(listing: &str, count: usize) -> Gaussians {
    let listing: Value = serde_json::from_str(listing).unwrap();
    let frames = listing["frames"].as_array().unwrap();
    let poses: Vec<DMat4> = frames
        .iter()
        .map(|frame| {
            let row = |row: usize, column: usize| {
                frame["transform_matrix"][row][column].as_f64().unwrap()
            };
            DMat4::from_cols_array_2d(&std::array::from_fn(|c| std::array::from_fn(|r| row(r, c))))
        })
        .collect();
    let center =
        poses.iter().map(|pose| pose.w_axis.truncate()).sum::<DVec3>() / poses.len() as f64;
    let size = poses.iter().map(|pose| pose.w_axis.truncate().distance(center)).sum::<f64>()
        / poses.len() as f64;
    let mut all = Gaussians::zeros(count, 0);
    let stream = Stream::new(17, 0);
    for index in 0..count {
        let draw = |k: usize| stream.uniform((16 * index + k) as u64);
        let pose = poses[(draw(0) * poses.len() as f64) as usize];
        // OpenGL's axes: the camera looks along -z.
        let depth = size * (0.3 + 0.4 * draw(1));
        let offset = DVec3::new((draw(2) - 0.5) * 0.7, (draw(3) - 0.5) * 0.5, -1.0) * depth;
        all.means_mut()[index] = pose.transform_point3(offset).as_vec3();
        all.quats_mut()[index] = [draw(4), draw(5), draw(6), draw(7)].map(|part| part as f32);
        let width = depth * 0.015 * (4.0 * draw(8)).exp2().min(4.0);
        all.log_scales_mut()[index] = Vec3::splat(width.ln() as f32);
        all.raw_opacities_mut()[index] = (3.0 * draw(9)) as f32;
        all.dc_mut()[index] = Vec3::from([10, 11, 12].map(|k| (3.4 * draw(k) - 1.7) as f32));
    }
    all
}

#[test]
fn planted_floaters_are_removed_and_a_clean_model_keeps_its_gaussians() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 400");
    let clean = ply::load(workspace.path("run/model.ply")).unwrap();

    let stdout = workspace.succeed("edit @run --floaters --out @clean.ply");
    let kept = ply::load(workspace.path("clean.ply")).unwrap();
    assert!(kept.count * 100 >= clean.count * 99, "{stdout}");
    let psnr = |stdout: &str, after: &str| -> f64 {
        let (before, _) = stdout.split_once(after).unwrap();
        before.split([' ', '(']).rfind(|word| word.parse::<f64>().is_ok()).unwrap().parse().unwrap()
    };
    let psnr_before = psnr(&stdout, " dB before");

    // The same run with floaters in its model.
    let listing = workspace.text("set/transforms_train.json");
    let planted = floaters(&listing, 100);
    ply::save(&planted, workspace.path("planted.ply")).unwrap();
    workspace.succeed("edit @run --merge @planted.ply --out @both.ply");
    fs::copy(workspace.path("both.ply"), workspace.path("run/model.ply")).unwrap();
    let stdout = workspace.succeed("edit @run --floaters --out @found.ply");
    let found = ply::load(workspace.path("found.ply")).unwrap();
    let place_of = |mean: &Vec3| mean.to_array().map(f32::to_bits);
    let left: BTreeSet<[u32; 3]> = found.means().iter().map(place_of).collect();
    let missed = planted.means().iter().filter(|mean| left.contains(&place_of(mean))).count();
    assert!(missed <= 5, "{missed} of 100: {stdout}");
    assert!(found.count * 100 >= clean.count * 99, "{stdout}");
    let (with, without) = (psnr(&stdout, " dB before"), psnr(&stdout, " dB after"));
    assert!(with < psnr_before - 1.0 && without >= psnr_before - 0.02, "{psnr_before}: {stdout}");

    // Wherever the model is.
    let moved = "--rotate 1,2,3:40 --scale 3 --move 5,0,0 --floaters";
    let stdout = workspace.succeed(&format!("edit @run {moved} --out @moved.ply"));
    let moved = ply::load(workspace.path("moved.ply")).unwrap();
    assert!(moved.count.abs_diff(found.count) <= 2, "{stdout}");
}
