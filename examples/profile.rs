use nightsplat::{dataset::*, gpu::*, train::*};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let steps: u64 = a[3].parse().unwrap();
    let config =
        TrainConfig { downscale: a[2].parse().unwrap(), steps: steps + 100, ..Default::default() };
    let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
    let d = Dataset::load(&a[1], &config.load_options()).unwrap();
    let mut t = Trainer::new(&gpu, config, &d).unwrap();
    while t.steps_done() < steps {
        t.advance(steps).unwrap();
    }
    let mut all: Vec<Vec<PassTime>> = (0..9).map(|_| t.profile_step().unwrap()).collect();
    let n = all[0].len();
    let mut total = 0.0;
    let mut agg: Vec<(&str, f64)> = vec![];
    for i in 0..n {
        let mut v: Vec<f64> = all.iter().map(|x| x[i].milliseconds).collect();
        v.sort_by(f64::total_cmp);
        total += v[4];
        match agg.iter_mut().find(|x| x.0 == all[0][i].name) {
            Some(x) => x.1 += v[4],
            None => agg.push((all[0][i].name, v[4])),
        }
    }
    for (n, m) in agg {
        println!("{n:24} {m:8.3}");
    }
    println!("{} gaussians, total {total:.2}", t.gaussian_count());
    all.clear();
}
