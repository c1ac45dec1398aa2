//! Layers, sizes, backgrounds and camera paths of renders.

use crate::common::paths;
use crate::common::prelude::*;

fn image(path: &Path) -> Image {
    Image::load(path).unwrap()
}

#[test]
fn layers_of_any_model_are_rendered_in_colours_and_as_numbers() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 40");
    let render = |options: &str, out: &str| {
        workspace.succeed(&format!("render @run --split test {options} --out @{out}"));
        paths(&workspace.path(out)).remove(0)
    };
    let alpha = image(&render("--layer alpha --format exr", "alpha"));
    let light = image(&render("--layer transmittance --format exr", "light"));
    // Both are read as colours in linear light, which 0 and 1 are not changed by.
    assert_eq!(alpha.data.len(), light.data.len());
    let opaque =
        alpha.data.iter().zip(&light.data).filter(|(alpha, light)| **alpha > 0.99 && **light < 0.1);
    assert!(opaque.count() > 100);
    for layer in ["depth", "normal"] {
        let shown = image(&render(&format!("--layer {layer}"), layer));
        let distinct: BTreeSet<u32> = shown.data.iter().map(|value| value.to_bits()).collect();
        assert!(distinct.len() > 20, "{layer}");
    }
    let near = image(&render("--layer depth --depth-range 0,0.001", "near"));
    // All is farther than that: yellow, or black where nothing is seen.
    let pixels = near.pixel_count();
    let yellow = [253.0, 231.0, 37.0].map(|value: f32| value / 255.0);
    for pixel in 0..pixels {
        let color = [0, 1, 2].map(|plane| near.data[plane * pixels + pixel]);
        assert!(
            color == [0.0; 3] || color.iter().zip(yellow).all(|(a, b)| (a - b).abs() < 1e-3),
            "{color:?}"
        );
    }
    workspace.refused(
        "render @run --split test --layer noise --out @noise",
        2,
        &["has no noise; it has rgb, depth, normal"],
    );
}

#[test]
fn views_and_paths_are_rendered_at_a_size_with_a_field_of_view_over_a_background() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 10");
    let render = |options: &str, out: &str| format!("render @run {options} --out @{out}");
    workspace.succeed(&render("--split test --size 64x24 --fov 20", "wide"));
    let file = paths(&workspace.path("wide")).remove(0);
    assert_eq!([image(&file).width, image(&file).height], [64, 24]);

    let keyframes = r#"{"nightsplat_path": 1, "fps": 2, "fov": 40, "size": [32, 16], "keyframes": [
        {"time": 0, "position": [0, 0, 0], "target": [0, 0, 100]},
        {"time": 2, "position": [0, 0, 0], "target": [100, 0, 100]}]}"#;
    workspace.write("path.json", keyframes);
    workspace.succeed(&render("--path @path.json --background #ff0000", "film"));
    assert_eq!(fs::read_dir(workspace.path("film")).unwrap().count(), 5);
    assert_eq!([image(&workspace.path("film/00000.png")).width], [32]);
    // Far from everything, only the background is seen.
    workspace
        .write("far.json", keyframes.replace("[0, 0, 0]", "[0, 0, 1e5]").replace("100]", "1e7]"));
    workspace.succeed(&render("--path @far.json --frames 1 --background 1,0,0", "far"));
    let far = image(&workspace.path("far/00000.png"));
    assert!(far.data[..512].iter().all(|value| *value == 1.0), "no red");
    assert!(far.data[512..].iter().all(|value| *value == 0.0));

    workspace.write("path.json", keyframes.replace("path\": 1", "path\": 7"));
    workspace.refused(&render("--path @path.json", "no"), 3, &["path.json", "version 7"]);
    for (options, part) in [
        ("--path nowhere.json", "nor a file"),
        ("--split test --size 0x4", "is not WIDTHxHEIGHT"),
        ("--split test --fov 180", "--fov 180 is no field of view"),
        ("--split test --background blue", "is no colour"),
        ("--split test --depth-range 2,1", "the nearer first"),
        ("--path orbit --loop", "--easing and --loop are of keyframes"),
    ] {
        workspace.refused(&render(options, "no"), 2, &[part]);
    }
    assert!(!workspace.path("no").exists());
}
