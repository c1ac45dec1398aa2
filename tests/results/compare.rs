//! Runs compared, photographs left out, and sweeps over several datasets.

use crate::common::command::{json, says};
use crate::common::workspace::Workspace;

#[test]
fn runs_of_one_dataset_are_compared_and_runs_of_two_are_refused() {
    let workspace = Workspace::new();
    workspace.trained("a", "--steps 10");
    workspace.trained("b", "--steps 40");
    let stdout = workspace.succeed("compare @a @b --report @page.html");
    says(&stdout, &["PSNR of a, dB", "b gains", "steps: 10 | 40"]);
    let html = workspace.text("page.html");
    assert!(html.contains("Comparison of a, b") && html.contains("data:image/png"));
    let compared = json(workspace.succeed("compare @a @b --json"));
    let psnr = |index: usize| compared["runs"][index]["mean"]["psnr"].as_f64().unwrap();
    for (index, name) in ["a", "b"].into_iter().enumerate() {
        let scores = json(workspace.succeed(&format!("eval @{name} --json")));
        assert!((psnr(index) - scores["mean"]["psnr"].as_f64().unwrap()).abs() < 1e-9, "{name}");
    }
    // Another size, and another dataset.
    workspace.trained("half", "--steps 2 --downscale 1.5");
    let other = "compare @a @half --report @no.html";
    workspace.refused(other, 2, &["half", "runs of different datasets", "40x30 and 27x20 pixels"]);
    assert!(!workspace.path("no.html").exists());
    workspace.refused("compare @a", 2, &["<RUNS>"]);
    workspace.refused("compare @a @nowhere", 3, &["nowhere"]);
}

#[test]
fn excluded_photographs_are_left_out_and_the_others_keep_their_split() {
    let workspace = Workspace::new();
    let set = workspace.path("set").display().to_string();
    let train = |name: &str, options: &str| workspace.train(name, &format!("--steps 1 {options}"));
    workspace.succeed(&train("all", ""));
    workspace.succeed(&train("less", "--exclude 00[12] --exclude low/003.*"));
    let names = |run: &str| workspace.text(&format!("{run}/views.csv"));
    let (all, less) = (names("all"), names("less"));
    assert_eq!(all.lines().filter(|line| !less.contains(line)).count(), 3, "{less}");
    workspace.write("names.txt", "# blurred\n001.png\n\n");
    workspace.succeed(&train("listed", "--exclude-file @names.txt"));
    says(&workspace.text("listed/config.toml"), &["exclude = [\"001.png\"]"]);
    workspace.refused(&train("no", "--exclude IMG_*"), 3, &[&set, "`IMG_*`"]);
    workspace.refused(&train("no", "--exclude [a"), 2, &["exclude"]);
    workspace.refused(&train("no", "--exclude *"), 3, &["no photograph is left"]);
}

#[test]
fn a_sweep_over_two_datasets_writes_the_table_that_papers_print() {
    let workspace = Workspace::new();
    workspace.succeed("synth @other --views 9 --width 32 --height 24");
    let sweep =
        "sweep @set @other --out @sweep --curves ap3,ase --seeds 1,2 --steps 2 --sh-degree 0";
    let stdout = workspace.succeed(sweep);
    let table = workspace.text("sweep/scenes.md");
    assert!(stdout.contains("| PSNR / SSIM | set | other | mean |"), "{stdout}");
    assert_eq!(table.lines().count(), 4, "{table}");
    // The best mean comes first, and is marked; seeds have a deviation.
    let last = |line: &str| line.rsplit(" | ").next().unwrap().to_owned();
    let means: Vec<String> = table.lines().skip(2).map(last).collect();
    let number =
        |mean: &str| mean.trim_matches(['*', ' ']).split([' ', '*']).next().unwrap().to_owned();
    let [first, second] = [0, 1].map(|row| number(&means[row]).parse::<f64>().unwrap());
    assert!(first >= second && means[0].starts_with("**"), "{table}");
    assert_eq!(table.matches(" ± ").count(), 8, "{table}");
    let page = workspace.text("sweep/index.html");
    says(&page, &["<h1>Sweep sweep</h1>", "class=\"best\""]);
    for scene in ["set", "other"] {
        assert!(page.contains(&format!("<a href=\"{scene}/index.html\">{scene}: ")), "{page}");
    }
    says(&workspace.text("sweep/set/index.html"), &["<h1>Sweep of set</h1>"]);
    let csv = workspace.text("sweep/scenes.csv");
    assert_eq!(csv.lines().count(), 7, "{csv}");
    assert!(workspace.path("sweep/scenes.tex").exists());
    // Repeated, it trains nothing again.
    let (_, message) = workspace.run(sweep, 0);
    assert!(!message.contains("finished"), "{message}");
    let twice = "sweep @set @set --out @twice --curves ap3";
    workspace.refused(twice, 2, &["two datasets are named set"]);
}
