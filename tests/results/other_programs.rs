//! Pictures of other programs: renders that are scored like our own, targets that are trained on, formulas in sweeps.

use nightsplat_photographs::image::ImageFile as _;

use crate::common::command::json;
use crate::common::prelude::*;

#[test]
fn renders_of_another_program_are_scored_like_our_own() {
    let workspace = Workspace::new();
    let path = |name: &str| workspace.path(name).display().to_string();
    workspace.trained("a", "--steps 20");
    let ours = json(workspace.succeed("eval @a --save-images --json"));
    // Our renders in another folder are those of another program.
    fs::rename(workspace.path("a/eval/renders"), workspace.path("theirs")).unwrap();
    let eval = "eval @a --renders @theirs";
    let theirs = json(workspace.succeed(&format!("{eval} --report @page.html --json")));
    assert_eq!((&theirs["mean"], &theirs["views"]), (&ours["mean"], &ours["views"]));
    assert!(theirs["gaussians"].is_null() && theirs["renders"] == path("theirs"), "{theirs}");
    says(&workspace.text("page.html"), &["theirs"]);

    let compare = "compare @a --renders gsplat=@theirs";
    says(&workspace.succeed(&format!("{compare} --report @page.html")), &["gsplat gains"]);
    says(&workspace.text("page.html"), &["Comparison of a, gsplat", ">gsplat<"]);
    let runs = json(workspace.succeed(&format!("{compare} --json")))["runs"].clone();
    assert_eq!(runs[0]["mean"]["psnr"], runs[1]["mean"]["psnr"]);
    assert!(runs[1]["run"] == "gsplat" && runs[1]["gaussians"].is_null(), "{runs}");

    // Beside a formula of one's own, both by their names.
    let sweep = "sweep @set --out @sweep --curves ap3,min(t*a,1)^0.5;a=0.7 --steps 2 --sh-degree 0 \
                 --renders gsplat=@theirs";
    let stdout = workspace.succeed(sweep);
    says(&stdout, &["min(t*a,1)^0.5;a=0.7", "gsplat"]);
    let csv = workspace.text("sweep/leaderboard.csv");
    assert_eq!(csv.lines().count(), 4, "{csv}");
    let row = csv.lines().find(|line| line.contains("gsplat")).unwrap();
    assert!(row.contains(&ours["mean"]["psnr"].to_string()), "{row}");
    let html = workspace.text("sweep/index.html");
    assert!(html.contains("min(t*a,1)^0.5;a=0.7") && html.contains(">gsplat<"));

    // What is superfluous, of another size or missing is named.
    let stray = workspace.path("theirs/stray.png");
    Image::filled(5, 5, [0.5; 3]).save_png8(&stray).unwrap();
    says(&workspace.run(eval, 0).1, &["no view is named like stray.png"]);
    fs::remove_file(&stray).unwrap();
    let files = fs::read_dir(workspace.path("theirs")).unwrap().flatten().map(|file| file.path());
    let name = files.min().unwrap();
    Image::filled(5, 5, [0.5; 3]).save_png8(&name).unwrap();
    workspace.refused(eval, 3, &[name.to_str().unwrap(), "is 5x5, its view 40x30", "--downscale"]);
    fs::rename(&name, &stray).unwrap();
    let view = name.file_stem().unwrap().to_str().unwrap();
    workspace.refused(compare, 3, &["theirs", "no picture of the test views", view, "stray.png"]);
    workspace.refused(sweep, 3, &["no picture of the test views", view]);
    workspace.refused("compare @a --renders theirs", 2, &["NAME=DIR"]);
    fs::remove_dir_all(workspace.path("set/high")).unwrap();
    workspace.refused(sweep, 3, &["no reference images", "nightsplat compare"]);
}

#[test]
fn targets_of_another_program_are_trained_on_and_labelled_everywhere() {
    let workspace = Workspace::new();
    workspace.succeed("tone apply @set --curve ap3 --out @toned");
    let train = |out: &str, options: &str| {
        format!("train @set --out @{out} --model plain --sh-degree 1 --steps 30 {options}")
    };
    let (stdout, message) = workspace.run(&train("theirs", "--targets @toned"), 0);
    let printed = (stdout + &message).split_whitespace().collect::<Vec<_>>().join(" ");
    says(
        &printed,
        &["targets of another program, toned", "% of their pixels are clipped at white"],
    );

    // Only the rounding to 8 bits differs from the curve that made them.
    workspace.succeed(&train("ours", "--curve ap3"));
    let psnr = |run: &str| {
        json(workspace.succeed(&format!("eval @{run} --json")))["mean"]["psnr"].as_f64().unwrap()
    };
    let [theirs, ours] = ["theirs", "ours"].map(psnr);
    assert!((theirs - ours).abs() < 0.3, "{theirs} and {ours} dB");

    let config = workspace.text("theirs/config.toml");
    says(&config, &["curve = \"targets\""]);
    let config: TrainConfig = toml::from_str(&config).unwrap();
    assert_eq!(config.tone.targets(), Some(workspace.path("toned").as_path()));
    let metrics = json(workspace.text("theirs/metrics.json"));
    assert_eq!(metrics["targets"], "targets of another program, toned");
    let plan = workspace.text("theirs/plan.toml");
    assert!(plan.contains("targets of another program, toned"), "{plan}");
    let header = |run: &str| String::from_utf8_lossy(&workspace.model(run)[..3000]).into_owned();
    let law = "comment nightsplat law";
    assert!(header("ours").contains(law) && !header("theirs").contains(law));
    workspace.refused(
        "render @theirs --split all --as linear --format exr --out @linear",
        2,
        &["targets of another program have no curve"],
    );

    // Resumed runs keep them, and what scores compare with is printed.
    fs::remove_dir_all(workspace.path("set/high")).unwrap();
    let label = json(workspace.succeed("eval @theirs --json"))["against"].clone();
    assert!(label.as_str().unwrap().contains("targets of another program"), "{label}");

    let targets = |options: &str| train("no", &format!("--targets @toned --plan none {options}"));
    workspace.refused(&targets("--curve ap3"), 2, &["--targets", "--curve"]);
    workspace.refused(
        &train("no", "--plan none --targets @nowhere"),
        3,
        &["nowhere", "folder of targets"],
    );
    let first = workspace.path("toned/001.png");
    fs::rename(&first, workspace.path("toned/stray.png")).unwrap();
    workspace.refused(&targets(""), 3, &["toned", "no target for 1 of", "001"]);
    Image::filled(20, 16, [1.0; 3]).save_png8(&first).unwrap();
    workspace.refused(&targets(""), 3, &["001.png", "is 20x16, its photograph 40x30"]);
    // As PNG of 16 bits, white: more than a hundredth of all pixels.
    Image::filled(40, 30, [1.0; 3]).save_png16(&first).unwrap();
    let (_, message) = workspace.run(&targets(""), 0);
    says(
        &message,
        &["detail is lost", "most in 001", "1 more pictures are of no photograph, stray the first"],
    );
}
