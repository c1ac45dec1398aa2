//! Edits of a model: what they keep, what they refuse, and that they repeat.

use nightsplat::splats::model::Model;

use crate::common::prelude::*;
use crate::common::{clouds, largest};

/// A cloud of degree 3, none of whose splats is at a bound below which it does not count.
fn cloud(count: usize, seed: u64) -> Model {
    clouds::drawn(count, 3, Stream::new(seed, 11)).into()
}

/// The camera at a distance of 4 from the origin of a world that was turned.
fn camera(turn: DQuat) -> Camera {
    let pose = DAffine3::from_mat3_translation(
        DMat3::from_quat(DQuat::from_rotation_y(0.4) * turn.inverse()),
        DVec3::new(0.1, -0.2, 4.0),
    );
    Camera::perspective(pose, 0.8, [96, 72])
}

fn render(model: &Model, camera: &Camera) -> Image {
    let gpu = gpu();
    let on_device = model.gaussians.upload(&gpu).unwrap();
    let mut renderer = Renderer::new(&gpu, model.render_settings()).unwrap();
    let options =
        RenderOptions { sh_degree: model.gaussians.shape.sh_degree, background: [0.0; 3] };
    renderer.reserve(model.gaussians.count, [camera]).unwrap();
    renderer.render_image(&on_device, camera, &options).unwrap()
}

fn difference(a: &Image, b: &Image) -> f32 {
    let differences: Vec<f32> = a.data.iter().zip(&b.data).map(|(a, b)| a - b).collect();
    largest(&differences)
}

#[test]
fn a_model_turned_there_and_back_renders_the_same_and_turned_it_does_from_a_turned_camera() {
    let workspace = Workspace::new();
    let model = cloud(400, 3);
    model.save(workspace.path("model.ply")).unwrap();
    let axis = DVec3::new(1.0, 2.0, -0.5);
    let edit = |options: &str, out: &str| {
        workspace.succeed(&format!("edit @model.ply {options} --out @{out}"));
        Model::load(workspace.path(out)).unwrap()
    };
    let before = render(&model, &camera(DQuat::IDENTITY));
    assert!(largest(&before.data) > 0.3, "nothing is seen");

    let back = edit("--rotate 1,2,-0.5:37 --rotate 1,2,-0.5:-37", "back.ply");
    let error = difference(&before, &render(&back, &camera(DQuat::IDENTITY)));
    assert!(error < 1e-5, "{error}");

    let turn = DQuat::from_axis_angle(axis.normalize(), 37_f64.to_radians());
    let turned = edit("--rotate 1,2,-0.5:37", "turned.ply");
    let error = difference(&before, &render(&turned, &camera(turn)));
    assert!(error < 1e-5, "{error}");
    assert!(difference(&before, &render(&turned, &camera(DQuat::IDENTITY))) > 0.1);

    let moved = edit("--scale 0.25 --move 3,-1,2 --move -3,1,-2 --scale 4", "moved.ply");
    assert_eq!(moved.near, model.near);
    let error = difference(&before, &render(&moved, &camera(DQuat::IDENTITY)));
    assert!(error < 1e-5, "{error}");
    let small = edit("--scale 0.25", "small.ply");
    assert_eq!(small.near, model.near / 4.0);
    // From a quarter of the distance, as an up direction of its own.
    let mut near = camera(DQuat::IDENTITY);
    near.view_from_world.translation *= 0.25;
    let error = difference(&before, &render(&small, &near));
    assert!(error < 1e-5, "{error}");
    let up = edit("--up 1,2,-0.5", "up.ply");
    let turn = DQuat::from_rotation_arc(axis.normalize(), DVec3::NEG_Y);
    assert!(difference(&before, &render(&up, &camera(turn))) < 1e-5);
}

#[test]
fn a_crop_keeps_what_is_inside_and_a_merge_puts_both_halves_together() {
    let workspace = Workspace::new();
    let model = cloud(300, 5);
    model.save(workspace.path("model.ply")).unwrap();
    let crop = |region: &str, out: &str| {
        workspace.succeed(&format!("edit @model.ply --crop {region} --out @{out}"));
        ply::load(workspace.path(out)).unwrap()
    };
    let left = crop("-2,-2,-2,0,2,2", "left.ply");
    let right = crop("0,-2,-2,2,2,2", "right.ply");
    assert!(left.count > 100 && right.count > 100);
    assert!(left.means().iter().all(|mean| mean.x <= 0.0));
    assert_eq!(left.count + right.count, model.gaussians.count);
    let ball = crop("0.1,0,0,0.7", "ball.ply");
    let inside = |mean: &&Vec3| mean.distance(Vec3::new(0.1, 0.0, 0.0)) <= 0.7;
    let expected: Vec<Vec3> = model.gaussians.means().iter().filter(inside).copied().collect();
    assert_eq!(ball.means(), expected);

    let merge = "edit @left.ply --merge @right.ply --out @both.ply";
    let stdout = workspace.succeed(merge);
    says(&stdout, &[&format!("{} Gaussians added to {}", right.count, left.count)]);
    let both = Model::load(workspace.path("both.ply")).unwrap();
    let [whole, joined] = [&model, &both].map(|model| render(model, &camera(DQuat::IDENTITY)));
    let error = difference(&whole, &joined);
    assert!(error < 1e-5, "{error}");

    let degree = "edit @model.ply --sh-degree 1 --opacity-min 0.5 --out @less.ply";
    workspace.succeed(degree);
    let less = ply::load(workspace.path("less.ply")).unwrap();
    assert_eq!(less.shape.sh_degree, 1);
    assert!(less.count < 200 && less.raw_opacities().iter().all(|raw| *raw >= 0.0));
}

#[test]
fn an_edit_list_repeats_an_edit_of_its_model_and_is_refused_for_another() {
    let workspace = Workspace::new();
    cloud(200, 7).save(workspace.path("a.ply")).unwrap();
    cloud(100, 8).save(workspace.path("b.ply")).unwrap();
    let options = "--crop 0,0,0,1.2 --rotate 1,1,0:37 --scale 0,0,0:0,2,0=3 --move 1,0,0 --merge";
    let edit =
        |options: &str, out: &str| workspace.succeed(&format!("edit {options} --out @{out}"));
    let first = format!("@a.ply {options} @b.ply --save-edits @edits.json");
    edit(&first, "first.ply");
    edit(&first, "again.ply");
    edit("@a.ply --edits @edits.json", "listed.ply");
    assert_eq!(workspace.read("first.ply"), workspace.read("again.ply"));
    assert_eq!(workspace.read("first.ply"), workspace.read("listed.ply"));
    let text = workspace.text("edits.json");
    assert!(text.contains(r#"{"scale":1.5}"#), "{text}");

    // The header has the list, and a later edit keeps it.
    edit("@first.ply --move 0,1,0", "later.ply");
    let later = workspace.read("later.ply");
    let header = String::from_utf8_lossy(&later[..2000]);
    let lists: Vec<&str> =
        header.lines().filter(|line| line.starts_with("comment edits: {")).collect();
    assert!(lists.len() == 2 && lists[0].contains("crop") && lists[1].contains("move"), "{header}");
    assert!(
        !header.contains(&workspace.named("@b.ply")) && lists[0].contains(r#""file":"b.ply""#),
        "{header}"
    );

    let other = "edit @b.ply --edits @edits.json --out @out.ply";
    workspace.refused(other, 3, &["edits.json", "another model", "b.ply is"]);
    // A merged model that changed since.
    cloud(100, 9).save(workspace.path("b.ply")).unwrap();
    let changed = "edit @a.ply --edits @edits.json --out @out.ply";
    workspace.refused(changed, 3, &["b.ply", "as the edit list says"]);
    workspace.write("edits.json", text.replace("edits\": 1", "edits\": 9"));
    workspace.refused(changed, 3, &["edits.json", "of version 9"]);
    assert!(!workspace.path("out.ply").exists());
}

#[test]
fn an_edit_that_leaves_nothing_or_cannot_be_written_says_so_and_writes_nothing() {
    let workspace = Workspace::new();
    cloud(20, 7).save(workspace.path("a.ply")).unwrap();
    for (options, code, part) in [
        ("--crop 50,0,0,1", 2, "leaves none of 20 Gaussians"),
        ("--opacity-min 0.99", 2, "opacity-min leaves none of 20"),
        ("--scale 0", 2, "a scale of 0 is none"),
        ("--scale nan", 2, "a scale of NaN is none"),
        ("--crop nan,0,0,1", 2, "is not a finite number"),
        ("--merge nowhere.ply", 3, "nowhere.ply"),
        ("--crop cameras", 3, "--dataset"),
        ("--floaters", 3, "--dataset"),
        ("--scale @set/transforms_train.json --dataset @set", 3, "line 2 is not a name"),
        ("", 2, "no operation is given"),
    ] {
        workspace.refused(&format!("edit @a.ply {options} --out @out.ply"), code, &[part]);
    }
    let moved = "edit @a.ply --move 1,0,0 --out";
    workspace.refused(&format!("{moved} @a.ply"), 1, &["is the model itself"]);
    workspace.refused(&format!("{moved} @out.ply.txt"), 2, &["name it .ply"]);
    let mut broken = workspace.read("a.ply");
    let length = broken.len();
    broken[length - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    workspace.write("nan.ply", broken);
    let left = fs::read_dir(workspace.path("")).unwrap().count();
    // The set and the two models.
    assert_eq!(left, 3);
    let out = workspace.path("new/folder/out.ply");
    let move_to = "edit @nan.ply --move 1,0,0 --out @new/folder/out.ply";
    says(&workspace.run(move_to, 0).1, &["1 of 20 Gaussians have an infinity or NaN"]);
    assert_eq!(Gaussians::open(out).unwrap().count, 19);
}

#[test]
fn a_table_of_cameras_in_metres_scales_a_model_and_cameras_crop_it_wherever_it_is() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 10");
    // 2.5 metres a unit, in a world of another origin.
    let listing = workspace.json("set/transforms_train.json");
    let row = |frame: &Value| {
        let at = |row: usize| 2.5 * frame["transform_matrix"][row][3].as_f64().unwrap() + 100.0;
        let name = frame["file_path"].as_str().unwrap().rsplit('/').next().unwrap();
        format!("{name},{},{},{}\n", at(0), at(1), at(2))
    };
    let table: String = listing["frames"].as_array().unwrap().iter().map(row).collect();
    workspace.write("metres.csv", format!("name,x,y,z\n{table}"));
    let edit =
        |options: &str, out: &str| workspace.run(&format!("edit @run {options} --out @{out}"), 0);
    let (stdout, _) = edit("--scale @metres.csv", "metres.ply");
    let trained = ply::load(workspace.path("run/model.ply")).unwrap();
    let metres = ply::load(workspace.path("metres.ply")).unwrap();
    for (mean, metres) in trained.means().iter().zip(metres.means()) {
        assert!((*mean * 2.5).distance(*metres) < 1e-4, "{stdout}: {mean} {metres}");
    }
    // Distances of the table are those of the dataset, whatever the model was scaled by before.
    edit("--scale 7 --scale @metres.csv", "again.ply");
    let again = ply::load(workspace.path("again.ply")).unwrap();
    for (again, metres) in again.means().iter().zip(metres.means()) {
        assert!(again.distance(*metres) < 1e-4, "{again} {metres}");
    }

    let transform = "--rotate 1,2,3:50 --scale 3 --move 1,2,3";
    edit("--crop cameras", "cropped.ply");
    edit(&format!("{transform} --crop cameras"), "moved.ply");
    let [cropped, moved] =
        ["cropped.ply", "moved.ply"].map(|name| ply::load(workspace.path(name)).unwrap());
    assert!(cropped.count > 0 && cropped.count <= trained.count);
    assert_eq!(cropped.count, moved.count);
}

#[test]
fn the_gaussians_that_contribute_most_to_the_photographs_are_kept() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 40");
    let trained = ply::load(workspace.path("run/model.ply")).unwrap();
    // As many again: half of them outside all views, half as transparent as 8 bits do not show.
    let mut unseen = trained.clone();
    unseen.means_mut().iter_mut().for_each(|mean| *mean += Vec3::new(0.0, 500.0, 0.0));
    let half = trained.count / 2;
    for index in 0..half {
        unseen.means_mut()[index] = trained.means()[index];
        unseen.raw_opacities_mut()[index] = -7.0;
    }
    ply::save(&unseen, workspace.path("unseen.ply")).unwrap();
    let merge = "edit @run --merge @unseen.ply";
    let stdout =
        workspace.succeed(&format!("{merge} --max-gaussians {} --out @kept.ply", trained.count));
    assert!(stdout.contains(&format!("max-gaussians {0}: {0} of", trained.count)), "{stdout}");
    let kept = ply::load(workspace.path("kept.ply")).unwrap();
    // Of the run's own, only those that no view sees may make room.
    let is_own = |mean: &&Vec3| trained.means().contains(mean) && mean.y < 250.0;
    let stayed = kept.means().iter().filter(is_own).count();
    assert!(
        kept.count == trained.count && stayed * 100 >= trained.count * 95,
        "{stayed} of {}",
        trained.count
    );

    let most = trained.count * 2 / 3;
    let edit = format!("edit @run --max-gaussians {most} --out @most.ply");
    workspace.succeed(&edit);
    let first = workspace.read("most.ply");
    workspace.succeed(&edit);
    assert!(first == workspace.read("most.ply"), "the same command gave other bytes");
    let all = workspace
        .succeed(&format!("edit @run --max-gaussians {} --out @all.ply", trained.count + 5));
    assert!(!all.contains("removed"), "{all}");
}
