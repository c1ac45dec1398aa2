//! The page is self-contained, escapes all text and highlights the best values.

use crate::common::says;
use nightsplat_photographs::image::Image;
use nightsplat_report::{
    Best, Chart, Column, Comparison, Distribution, Mark, NumberTable, Picture, Report, Series,
    TextTable, distributions,
};

fn column(name: &str, digits: usize, best: Best) -> Column {
    Column { name: name.into(), digits, best }
}

fn table() -> NumberTable {
    NumberTable {
        title: "Scores <test>".into(),
        label: "curve".into(),
        columns: vec![
            column("PSNR", 2, Best::Greatest),
            column("seconds", 0, Best::Least),
            column("steps", 0, Best::Unmarked),
        ],
        rows: vec![
            ("linear".into(), vec![Some(20.111), Some(31.0), Some(100.0)]),
            ("a|b".into(), vec![Some(25.004), None, Some(200.0)]),
            ("ap3".into(), vec![Some(25.001), Some(29.6), Some(f64::NAN)]),
        ],
        ..NumberTable::default()
    }
}

#[test]
fn a_table_in_markdown_marks_the_best_of_each_column() {
    let expected = "\
| curve | PSNR | seconds | steps |
| --- | ---: | ---: | ---: |
| linear | 20.11 | 31 | 100 |
| a\\|b | **25.00** | – | 200 |
| ap3 | **25.00** | **30** | – |
";
    assert_eq!(table().markdown(), expected);
}

#[test]
fn a_table_in_html_marks_the_same_values() {
    let html = table().html();
    assert_eq!(html.matches("class=\"best\"").count(), 3);
    says(&html, &["<td>ap3</td><td class=\"best\">25.00</td><td class=\"best\">30</td><td>–</td>"]);
    assert!(html.contains("Scores &lt;test&gt;"));
}

#[test]
fn empty_columns_vanish_with_their_marks_and_bad_values_are_marked() {
    let mut table = table();
    table.rows.iter_mut().for_each(|(_, values)| values[1] = None);
    table.bad = vec![[0, 0], [1, 1], [1, 2]];
    let table = table.without_empty_columns();
    let names: Vec<&str> = table.columns.iter().map(|column| column.name.as_str()).collect();
    assert_eq!(names, ["PSNR", "steps"]);
    assert_eq!(table.bad, [[0, 0], [1, 1]]);
    let html = table.html();
    says(&html, &["<td class=\"bad\">20.11</td>", "<td class=\"bad\">200</td>"]);
}

#[test]
fn a_single_value_and_a_short_row_are_not_marked() {
    let mut table = table();
    table.rows.truncate(1);
    table.rows.push(("short".into(), vec![]));
    assert!(!table.markdown().contains("**"));
    assert!(table.markdown().contains("| short | – | – | – |"));
}

#[test]
fn infinity_is_a_value() {
    let mut table = table();
    table.rows[0].1[0] = Some(f64::INFINITY);
    assert!(table.markdown().contains("| linear | **∞** |"), "{}", table.markdown());
}

fn page(text: &str) -> String {
    let picture = |scores: &str| Picture {
        caption: text.into(),
        scores: scores.into(),
        image: Image::filled(4, 3, [0.5, 2.0, -1.0]),
    };
    let points = vec![(0.0, 1.0), (10.0, 0.2)];
    let series = Series { name: text.into(), points, ..Series::default() };
    Report {
        title: text.into(),
        intro: vec![text.into()],
        links: vec![[text.into(), text.into()]],
        window: Some([text.into(), text.into()]),
        facts: vec![TextTable { title: text.into(), rows: vec![[text.into(), text.into()]] }],
        tables: vec![table()],
        charts: vec![Chart::new(text, text, vec![series])],
        comparisons: vec![Comparison {
            title: text.into(),
            pictures: vec![picture("20 dB"), picture("")],
        }],
        ..Report::default()
    }
    .html()
}

#[test]
fn the_page_has_no_external_references() {
    let html = page("chair");
    for outside in ["http:", "https:", "<script", "<link", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    assert_eq!(html.matches("src=\"data:image/png;base64,iVBORw0KGgo").count(), 2);
    assert_eq!(html.matches("<figcaption>").count(), 2);
    assert!(html.contains("prefers-color-scheme: dark"));
}

#[test]
fn every_text_is_escaped() {
    let html = page("<b onload=\"x('&')\">");
    assert!(!html.contains("<b onload"));
    // Title, heading, the address and the title of a window and those of its link, paragraph, a link with its address,
    // a fact with its caption, two captions with alternative texts, row title, plot label, axes, legend and its title.
    assert_eq!(html.matches("&lt;b onload=&quot;x(&#39;&amp;&#39;)&quot;&gt;").count(), 23);
}

#[test]
fn a_plot_draws_each_series_within_its_frame() {
    let series = |name: &str, points: &[(f64, f64)]| Series {
        name: name.into(),
        points: points.to_vec(),
        ..Series::default()
    };
    let svg = Chart::new(
        "step",
        "loss",
        vec![
            series("linear", &[(0.0, 0.31), (50.0, f64::NAN), (100.0, 0.1)]),
            series("ap3", &[(0.0, 0.2), (100.0, 0.05)]),
        ],
    )
    .svg();
    assert_eq!(svg.matches("<polyline").count(), 2);
    let lines = svg.split(" points=\"").skip(1).map(|rest| rest.split('"').next().unwrap());
    let points: Vec<Vec<(f64, f64)>> = lines
        .map(|line| {
            let point = |pair: &str| {
                pair.split_once(',').map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap()))
            };
            line.split_whitespace().map(|pair| point(pair).unwrap()).collect()
        })
        .collect();
    assert_eq!(points.iter().map(Vec::len).collect::<Vec<_>>(), [2, 2], "a NaN is drawn");
    assert!(
        points
            .iter()
            .flatten()
            .all(|(x, y)| (56.0..=704.0).contains(x) && (34.0..=266.0).contains(y))
    );
    // A larger value is higher up.
    assert!(points[0][0].1 < points[0][1].1);
    says(&svg, &[">0.3<", ">100<", ">step<", ">loss<", ">linear<"]);
}

#[test]
fn empty_constant_and_extreme_plots_are_well_formed() {
    let extremes = [f64::MAX, f64::MIN, 1e30, -1e30, 0.0, 1e-300];
    let plots = [vec![], vec![(1.0, 2.0)], extremes.iter().map(|&value| (value, value)).collect()];
    for points in plots {
        let mark =
            |mark| Series { name: "a".into(), mark, points: points.clone(), ..Series::default() };
        for series in [vec![mark(Mark::Dots), mark(Mark::Star)], vec![mark(Mark::Bar)]] {
            let svg = Chart::new("step", "PSNR", series).svg();
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}

#[test]
fn a_distribution_has_the_skewness_of_its_luminance_and_draws_its_density() {
    let of = |values: &[f32]| {
        let mut distribution = Distribution::new("grey");
        distribution.add(&[values, values, values].concat());
        distribution
    };
    // Three at 0 and one at 1: mean 1/4, variance 3/16, third moment 3/32.
    let skewness = of(&[0.0, 0.0, 0.0, 1.0]).skewness();
    assert!((skewness - 3.0 / 32.0 / (3.0_f64 / 16.0).powf(1.5)).abs() < 1e-6, "{skewness}");
    assert!((of(&[0.2, 0.3, 0.7, 0.8]).skewness()).abs() < 1e-5);
    for constant in [&[][..], &[0.3], &[0.0; 9], &[1.0; 9]] {
        assert_eq!(of(constant).skewness(), 0.0, "{constant:?}");
    }
    let svg = distributions(&[of(&[0.0, 0.1, 0.1, 0.9]), Distribution::new("nothing")]).svg();
    assert!(svg.contains("grey (skewness") && svg.matches("<polyline").count() == 2, "{svg}");
    assert!(!svg.contains("NaN"));
}

#[test]
fn a_legend_of_many_names_has_rows_and_a_plot_can_be_a_file() {
    let series = |index: usize| Series {
        name: format!("a curve with number {index}"),
        points: vec![(0.0, 0.0), (1.0, 1.0)],
        ..Series::default()
    };
    let svg = Chart::new("t", "y", (0..12).map(series).collect()).svg_file();
    assert!(
        svg.starts_with("<svg xmlns=\"http://www.w3.org/2000/svg\"") && svg.contains("<style>")
    );
    let rows: std::collections::BTreeSet<&str> = svg
        .split("class=\"sample\"")
        .filter_map(|before| before.rsplit("y1=\"").next()?.split('"').next())
        .collect();
    assert!(svg.contains("--series-0") && rows.len() > 3, "{rows:?} {svg}");
    assert!(svg.contains("stroke-dasharray"));
}

#[test]
fn a_line_looks_the_same_in_every_plot_of_a_page_and_in_its_legend() {
    let series = |color: Option<usize>| Series {
        name: "ap3".into(),
        points: vec![(0.0, 0.0), (1.0, 1.0)],
        color,
        ..Series::default()
    };
    let look = |svg: &str, element: &str| {
        let rest = svg.split(element).nth(1).unwrap();
        let stroke = rest.split("stroke=\"").nth(1).unwrap().split('"').next().unwrap().to_owned();
        let dashes = rest.split("/>").next().unwrap().contains("stroke-dasharray=\"7 3\"");
        (stroke, dashes)
    };
    // The seventh line of the page, alone in one plot and after another in the next.
    for series in [vec![series(Some(6))], vec![series(Some(6)), series(None)]] {
        let svg = Chart::new("t", "y", series).svg();
        for element in ["<polyline", "class=\"sample\""] {
            assert_eq!(
                look(&svg, element),
                ("var(--series-1)".to_owned(), true),
                "{element}: {svg}"
            );
        }
        assert_eq!(svg.matches("class=\"sample\"").count(), svg.matches("<polyline").count());
        assert!(svg.contains("<title>ap3</title>"), "nothing is said where the pointer rests");
    }
}

#[test]
fn many_series_are_divided_into_plots_with_the_same_axes() {
    let series = |index: usize| Series {
        name: format!("curve {index}"),
        points: vec![(0.0, 0.0), (3.0, index as f64)],
        color: Some(index),
        ..Series::default()
    };
    let chart = Chart::new("t", "y", (0..37).map(series).collect());
    let svg = Chart { panel: Some(6), ..chart }.svg_file();
    let panels: Vec<&str> = svg.split("class=\"panel\"").skip(1).collect();
    assert_eq!((panels.len(), svg.matches("<polyline").count()), (7, 37));
    for panel in panels {
        assert!(panel.matches("<polyline").count() <= 6 && panel.contains(">30<"), "{panel}");
    }
    assert!(svg.contains(":hover"), "a line cannot be told from the others");
}

#[test]
fn the_range_of_a_mean_is_drawn_as_a_line() {
    let series = Series {
        name: "ap3".into(),
        mark: Mark::Dots,
        points: vec![(0.0, 20.0), (1.0, 21.0)],
        spreads: vec![(0.0, 18.0, 30.0)],
        ..Series::default()
    };
    let svg = Chart::new("gain", "PSNR", vec![series.clone()]).svg();
    assert_eq!(svg.matches("class=\"spread\"").count(), 1);
    assert!(svg.contains(">30<"), "the axis does not reach the greatest: {svg}");
    let bar = Series { mark: Mark::Bar, ..series };
    let svg = Chart::new("", "PSNR", vec![bar]).svg();
    assert_eq!(svg.matches("class=\"spread\"").count(), 1);
}

#[test]
fn text_comes_before_images_and_images_before_tables_and_plots() {
    let html = page("chair");
    let at = |part: &str| html.find(part).unwrap();
    assert!(at("<table class=\"facts\"") < at("<img") && at("<img") < at("<div class=\"table\""));
    assert!(at("<div class=\"table\"") < at("<polyline"));
}

#[test]
fn few_points_have_dots_and_a_special_one_a_star() {
    let series =
        |name: &str, mark, points| Series { name: name.into(), mark, points, ..Series::default() };
    let points = vec![(0.0, 20.0), (0.1, 24.0)];
    let svg = Chart::new(
        "delta0",
        "PSNR",
        vec![
            series("ap3", Mark::Dots, points.clone()),
            series("adaptive <0.2>", Mark::Star, vec![(0.2, 30.0)]),
            series("nowhere", Mark::Star, vec![(f64::NAN, 1.0)]),
        ],
    )
    .svg();
    assert_eq!((svg.matches("<circle").count(), svg.matches("<path").count()), (2, 1));
    assert!(svg.contains("adaptive &lt;0.2&gt;") && !svg.contains("NaN"), "{svg}");
    // The axes reach to the star.
    says(&svg, &[">0.20<", ">30<"]);
    let svg = Chart::new("delta0", "PSNR", vec![series("ap3", Mark::Line, points)]).svg();
    assert_eq!(svg.matches("<circle").count(), 0);
}

#[test]
fn bars_start_at_zero_and_are_proportional_to_their_values() {
    let bar = |(row, (name, value)): (usize, (&str, f64))| Series {
        name: name.into(),
        mark: Mark::Bar,
        points: vec![(row as f64, value)],
        ..Series::default()
    };
    let rows = [("a", 20.0), ("b & c", 5.0), ("d", -5.0), ("failed", f64::NAN)];
    let svg = Chart::new("", "PSNR, dB", rows.into_iter().enumerate().map(bar).collect()).svg();
    let widths = svg.split(" width=\"").skip(1).map(|rest| rest.split('"').next().unwrap());
    let widths: Vec<f64> = widths.map(|width| width.parse().unwrap()).collect();
    assert_eq!(widths.len(), 3);
    assert!((widths[0] - 4.0 * widths[1]).abs() < 0.3 && widths[1] == widths[2], "{widths:?}");
    says(&svg, &[">20.00<", ">b &amp; c<", ">failed<", ">-5.00<"]);
    assert!(!Chart::new("", "PSNR", vec![]).svg().contains("NaN"));
}

#[test]
fn a_run_has_one_colour_in_every_chart_and_its_name_next_to_its_last_point() {
    let series = |name: &str, color, points: &[(f64, f64)]| Series {
        name: name.into(),
        title: format!("the run <{name}>"),
        mark: if color > 0 { Mark::Ring } else { Mark::Disc },
        color: Some(color),
        points: points.to_vec(),
        ..Series::default()
    };
    let front = |points: &[(f64, f64)]| Series { mark: Mark::Steps, ..series("", 0, points) };
    let svg = |series: Vec<Series>| {
        Chart { is_logarithmic: true, ..Chart::new("time, s", "PSNR, dB", series) }.svg()
    };
    let drawn = svg(vec![
        series("fast", 0, &[(10.0, 24.0)]),
        series("2", 1, &[(10.0, 24.0)]),
        series("lost", 2, &[(f64::NAN, 1.0)]),
        front(&[(10.0, 24.0)]),
    ]);
    assert_eq!((drawn.matches("<circle").count(), drawn.matches("<path").count()), (2, 1));
    assert!(drawn.contains("--series-0") && drawn.contains("--series-1"));
    assert!(!drawn.contains("lost"), "{drawn}");
    assert!(drawn.contains("the run &lt;fast&gt;") && !drawn.contains("NaN"), "{drawn}");
    // Two names at one place do not overlap.
    let attributes = |name: &str| {
        let before = drawn.split(&format!(">{name}</text>")).next().unwrap();
        before.rsplit("<text ").next().unwrap().to_owned()
    };
    assert_ne!(attributes("fast").split(" class").next(), attributes("2").split(" class").next());
    let curve = svg(vec![series("a", 0, &[(1.0, 20.0), (9.0, 25.0)])]);
    assert_eq!((curve.matches("<polyline").count(), curve.matches("<path").count()), (1, 0));
    for points in [&[][..], &[(0.0, 1.0)], &[(-1.0, 2.0)], &[(1e-300, 1e300)]] {
        let svg = svg(vec![series("a", 0, points), front(points)]);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
