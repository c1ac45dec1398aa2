//! The whole renderer in f64 and without tiles: every splat on every pixel, front to back, and its gradients.

use glam::{DVec2, DVec3};
use nightsplat::kernels::splat::RECORD_HEAD;
use nightsplat::reference::blend_backward::blend_pixel_backward;
use nightsplat::reference::blend_forward::{blend_pixel, mean_depth};
use nightsplat::reference::camera::ReferenceCamera;
use nightsplat::reference::lamp::{self, ReferenceLamp};
use nightsplat::reference::project::{Projection, ProjectionSettings, project_gaussian};
use nightsplat::reference::project_backward::{
    DSplat, Lit, project_gaussian_backward, splat_gradient,
};
use nightsplat::reference::splat::Splat;
use nightsplat::splats::render::{GradientNorm, RenderSettings};

use super::setup::{Gradients, Rendered, Setup};
use super::{Random, assert_close};

/// A setup and the gradient of its render, (channels, H, W): the differentiated functional is their inner product.
pub(crate) struct Chain<'a> {
    setup: &'a Setup,
    pub(crate) d_render: Vec<f64>,
    /// The lamp of the settings.
    pub(crate) lamp: Option<ReferenceLamp>,
    /// (H, W) of the setup as it is: the gradient of the mean depth is given over alpha.
    alphas: Vec<f64>,
}

/// The splats of a render, front to back, with the indices of their Gaussians.
struct Projected {
    ids: Vec<usize>,
    splats: Vec<Splat>,
    colors: Vec<f64>,
    depths: Vec<f64>,
}

/// The results of the renderer.
pub(crate) struct Results {
    /// (channels, H, W)
    pub(crate) render: Vec<f64>,
    /// (H, W)
    pub(crate) transmittances: Vec<f64>,
    /// In the order of the parameters.
    pub(crate) gradient: Vec<f64>,
    /// By Gaussian: the increment of the statistics of density control, of all pixels together and of each.
    grad_norms: Vec<f64>,
    pixel_norms: Vec<f64>,
    /// By channel.
    pub(crate) d_background: Vec<f64>,
    /// With respect to the lamp's numbers.
    pub(crate) lamp: [f64; lamp::WIDTH],
}

impl<'a> Chain<'a> {
    /// With a random gradient of the render.
    pub(crate) fn new(setup: &'a Setup) -> Self {
        let mut random = Random::new(4);
        let channels = setup.channels() + usize::from(setup.settings.trains_depth);
        let count = channels * setup.pixels();
        // Values of f32, as on the device.
        let d_render = (0..count).map(|_| f64::from(random.between(-1.0, 1.0) as f32)).collect();
        let lamp = setup.settings.lamp.map(|lamp| ReferenceLamp::from_numbers(&lamp.numbers()));
        let mut chain = Self { setup, d_render, lamp, alphas: vec![] };
        let transmittances = chain.run(&chain.parameters()).transmittances;
        chain.alphas =
            transmittances.into_iter().map(|transmittance| 1.0 - transmittance).collect();
        chain
    }

    /// Values per pixel: those of the setup, and the mean depth if that is trained.
    fn channels(&self) -> usize {
        self.setup.channels() + usize::from(self.setup.settings.trains_depth)
    }

    /// The channels and the transmittance of a pixel.
    fn pixel(&self, projected: &Projected, background: &[f64], center: DVec2) -> (Vec<f64>, f64) {
        let Projected { splats, colors, .. } = projected;
        let (mut values, transmittance) =
            blend_pixel(splats, colors, background, center, self.alpha_max());
        if self.setup.settings.trains_depth {
            let last = values.len() - 1;
            values[last] = mean_depth(values[last], transmittance);
        }
        (values, transmittance)
    }

    pub(crate) fn parameters(&self) -> Vec<f64> {
        self.setup.parameters.iter().map(|&p| p.into()).collect()
    }

    pub(crate) fn background(&self) -> Vec<f64> {
        let mut background: Vec<f64> = self.setup.background().into_iter().map(f64::from).collect();
        background.resize(self.channels(), 0.0);
        background
    }

    fn project(&self, camera: &ReferenceCamera, parameters: &[f64]) -> Projected {
        let Setup { settings, options, .. } = self.setup;
        let one = |i| -> Option<(usize, Projection, Vec<f64>)> {
            let gaussian = self.setup.planes().load(parameters, i);
            let RenderSettings { near, raw_colors, antialiased, .. } = *settings;
            let (near, sh_degree) = (near.into(), options.sh_degree);
            let lamp = self.lamp;
            let projection_settings =
                ProjectionSettings { near, sh_degree, raw_colors, antialiased, lamp };
            let projection = project_gaussian(camera, projection_settings, &gaussian)?;
            Some((i, projection, gaussian.features))
        };
        let mut visible: Vec<_> = (0..self.setup.count).filter_map(one).collect();
        visible.sort_by(|(_, a, _), (_, b, _)| a.depth.total_cmp(&b.depth));
        Projected {
            ids: visible.iter().map(|(i, ..)| *i).collect(),
            splats: visible.iter().map(|(_, p, _)| p.splat).collect(),
            colors: visible
                .iter()
                .flat_map(|(_, p, features)| {
                    let depth = settings.trains_depth.then_some(p.depth);
                    [&p.color.to_array()[..], features, depth.as_slice()].concat()
                })
                .collect(),
            depths: visible.iter().map(|(_, p, _)| p.depth).collect(),
        }
    }

    /// Centre and gradient of each pixel.
    fn pixels(&self) -> impl Iterator<Item = (DVec2, Vec<f64>)> {
        let (width, count) = (self.setup.camera.width as usize, self.setup.pixels());
        (0..count).map(move |at| {
            let center = DVec2::new((at % width) as f64, (at / width) as f64) + 0.5;
            (center, self.d_render.iter().skip(at).step_by(count).copied().collect())
        })
    }

    fn alpha_max(&self) -> f64 {
        self.setup.settings.max_alpha.into()
    }

    /// The functional's value.
    pub(crate) fn loss(&self, parameters: &[f64], background: &[f64]) -> f64 {
        let projected = self.project(&self.setup.camera(), parameters);
        let pixel = |(at, (center, mut d)): (usize, (DVec2, Vec<f64>))| {
            let (render, _) = self.pixel(&projected, background, center);
            if self.setup.settings.trains_depth {
                let last = d.len() - 1;
                d[last] *= self.alphas[at];
            }
            render.iter().zip(d).map(|(value, d)| value * d).sum::<f64>()
        };
        self.pixels().enumerate().map(pixel).sum()
    }

    /// The render, and the gradients of the references' backward pass.
    pub(crate) fn run(&self, parameters: &[f64]) -> Results {
        let camera = self.setup.camera();
        let projected = self.project(&camera, parameters);
        let Projected { ids, splats, colors, depths } = &projected;
        let (channels, pixels, background) =
            (self.channels(), self.setup.pixels(), self.background());
        let record = RECORD_HEAD as usize + channels;
        let mut gradient_records = vec![0.0; record * ids.len()];
        let mut results = Results {
            render: vec![0.0; channels * pixels],
            transmittances: vec![],
            gradient: vec![0.0; parameters.len()],
            grad_norms: vec![0.0; self.setup.count],
            pixel_norms: vec![0.0; self.setup.count],
            d_background: vec![0.0; channels],
            lamp: [0.0; lamp::WIDTH],
        };
        let alpha_max = self.alpha_max();
        for (at, (center, d)) in self.pixels().enumerate() {
            let (values, transmittance) = self.pixel(&projected, &background, center);
            let list = &mut gradient_records;
            blend_pixel_backward(splats, colors, &values, &d, center, alpha_max, |_| true, list);
            for c in 0..channels {
                results.render[c * pixels + at] = values[c];
                let is_seen = c < self.setup.channels() || transmittance < 1.0;
                results.d_background[c] += if is_seen { transmittance * d[c] } else { 0.0 };
            }
            results.transmittances.push(transmittance);
        }
        let planes = self.setup.planes();
        let Setup { settings, options, .. } = self.setup;
        for (j, &i) in ids.iter().enumerate() {
            let (record_gradient, color) =
                (&gradient_records[record * j..][..record], &colors[channels * j..]);
            let d_splat = self.d_splat(&splats[j], record_gradient, color);
            let gaussian = planes.load(parameters, i);
            let (degree, antialiased) = (options.sh_degree, settings.antialiased);
            let splat = &splats[j];
            let lit = self.lamp.map(|lamp| Lit { lamp, color: DVec3::from_slice(color) });
            let splat_and_lit = (splat, lit);
            let d = project_gaussian_backward(
                &camera,
                degree,
                antialiased,
                &gaussian,
                splat_and_lit,
                &d_splat,
            );
            if let Some(Lit { lamp, color }) = lit {
                let point = camera.view(gaussian.mean);
                let (d_color, _) = lamp.lit_backward(color, d_splat.color, point);
                let gradient = lamp.gradient(color, d_color, point);
                results.lamp.iter_mut().zip(gradient).for_each(|(sum, d)| *sum += d);
            }
            planes.store(&d, i, |at, value| results.gradient[at] = value);
            let GradientNorm { damping_weight, damping_depth, .. } = Rendered::norm(false);
            let nearness = (depths[j] / f64::from(damping_depth)).min(1.0);
            let undamped = 1.0 - f64::from(damping_weight) * (1.0 - nearness * nearness);
            let half_view = 0.5 * camera.size;
            results.grad_norms[i] = undamped * d_splat.norm(splat, half_view, false);
            results.pixel_norms[i] = undamped * d_splat.norm(splat, half_view, true);
        }
        results
    }

    /// The gradients of a splat; clamped colours have none.
    fn d_splat(&self, splat: &Splat, record: &[f64], color: &[f64]) -> DSplat {
        let (mean2d, conic, opacity) = splat_gradient(splat, record);
        let is_free = |c: usize| self.setup.settings.raw_colors || color[c] > 0.0;
        let passes = |c: usize| if is_free(c) { record[RECORD_HEAD as usize + c] } else { 0.0 };
        DSplat {
            mean2d,
            conic,
            opacity,
            color: DVec3::from_array([0, 1, 2].map(passes)),
            features: record[RECORD_HEAD as usize + 3..][..self.setup.planes().feature_count]
                .to_vec(),
            depth: if self.setup.settings.trains_depth { record[record.len() - 1] } else { 0.0 },
            magnitudes: record[6],
        }
    }

    /// The parameters, perturbed by some roundings each.
    pub(crate) fn jitter(&self, seed: u64) -> Vec<f64> {
        let mut random = Random::new(100 + seed);
        let mut moved = |p: f64| p + JITTER * (p.abs() + 1.0) * random.between(-1.0, 1.0);
        self.parameters().into_iter().map(&mut moved).collect()
    }

    /// Renders the setup on the device, forward and backward, and panics if a result differs from the chain's.
    ///
    /// The rounding model: the device's result is that of the chain for parameters that are off by some roundings each.
    /// So the parameters are perturbed, and the change of a result, times a factor, is the allowed error of the device;
    /// this detects pixels in which a rounding decides whether a splat counts.
    pub(crate) fn assert_agrees_with_the_device(&self, name: &str) {
        let exact = self.run(&self.parameters());
        let jittered: Vec<Results> =
            (0..JITTERS).map(|seed| self.run(&self.jitter(seed))).collect();
        let check = |what: &str, actual: &[f32], values: fn(&Results) -> &[f64], size: f64| {
            let exact = values(&exact);
            let expected: Vec<f32> = exact.iter().map(|&e| e as f32).collect();
            let bound = |i: usize, _| {
                let moved = |results: &Results| (values(results)[i] - exact[i]).abs();
                let most = jittered.iter().map(moved).fold(0.0, f64::max);
                (TIMES * most + JITTER * (exact[i].abs() + size)) as f32
            };
            assert_close(&format!("{name}: {what}"), actual, &expected, bound);
        };
        let mut rendered = self.setup.render();
        // The mean depth is divided by alpha, which is 1/255 at least where there is a splat.
        let [of_render, of_gradient] =
            if self.setup.settings.trains_depth { [256.0, 16.0] } else { [1.0; 2] };
        check("render", &rendered.render, |results| &results.render, of_render);
        check("transmittance", &rendered.transmittances, |results| &results.transmittances, 1.0);
        let d_render: Vec<f32> = self.d_render.iter().map(|&d| d as f32).collect();
        let gradients = rendered.backward(&d_render);
        check("gradient", &gradients.parameters, |results| &results.gradient, of_gradient);
        let trained = Setup { is_trained: true, ..self.setup.clone() };
        let completed = trained.render().backward(&d_render);
        check("Adam's gradient", &completed.parameters, |results| &results.gradient, of_gradient);
        let norms = |gradients: &Gradients| -> Vec<f32> {
            gradients.grad_norm_sums.iter().map(|sum| sum - Rendered::NORM_BEFORE).collect()
        };
        check("gradient norm", &norms(&gradients), |results| &results.grad_norms, of_gradient);
        check("pixels' norms", &norms(&completed), |results| &results.pixel_norms, of_gradient);
        for (i, &visits) in gradients.visit_counts.iter().enumerate() {
            let visits = visits - Rendered::VISITS_BEFORE;
            let leaves_a_trace = exact.grad_norms[i] > 0.0;
            assert!(
                visits == 1 || visits == 0 && !leaves_a_trace,
                "{name}: {visits} visits of {i}"
            );
        }
    }
}

/// Half a unit in the last place of 1.0: the relative error of one rounding.
const ROUNDING: f64 = f32::EPSILON as f64 / 2.0;
/// The perturbation of parameters, relative to their magnitude and to one, which is that of the terms in sums and
/// exponentials: some dozens of roundings are between a parameter and a pixel.
const JITTER: f64 = 32.0 * ROUNDING;
const JITTERS: u64 = 6;
/// The allowed error, in units of the change caused by the perturbation.
const TIMES: f64 = 4.0;
