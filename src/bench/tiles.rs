//! Times the rasteriser with every tile size that the device supports.

use nightsplat_core::camera::Camera;
use nightsplat_core::table::aligned;
use nightsplat_models::gaussians::{Features, MAX_SH_DEGREE};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::scene::BenchScene;
use super::{Bench, fastest, median, stages, total};
use crate::Result;
use crate::gpu::{
    BackwardForm, Buffer, Properties, RecordSums, Resources, Sorting, Tile, TunedTile,
};
use crate::splats::batches::GradientKind;
use crate::splats::device::{DeviceGaussians, Layout, Upload};
use crate::splats::render::{
    GradientNorm, Gradients, RenderOptions, RenderSettings, Renderer, Status,
};

/// From a few pixels for narrow subgroups to 512 for wide ones.
const SIZES: [[u32; 2]; 7] = [[8, 4], [8, 8], [16, 4], [16, 8], [16, 16], [32, 8], [32, 16]];
/// Numbers of subgroups that share a tile, if it has `SHARED_PIXELS` or more. Processors use one: there, each barrier
/// ends one loop over all lanes and begins another.
const SUBGROUPS: [u32; 3] = [1, 2, 4];
const SHARED_PIXELS: u32 = 256;

/// Lengths of segments, tried with the fastest tile and both places of sums. A processor has one form.
const SEGMENTS: [u32; 5] = [0, 64, 128, 512, 1024];

/// Sorts; processors have the first.
const SORTS: [Sorting; 2] = [Sorting::Whole, Sorting::Tiles];

/// Colour only and all features: 3 and 11 channels.
const FEATURES: [Features; 2] = [Features::NONE, Features::ALL];

/// Allowed difference from the render with the first tile. Drivers may round each specialisation differently, which can
/// decide whether a splat of minimal alpha counts.
const LARGEST_DIFFERENCE: f32 = 0.01;
const MEAN_DIFFERENCE: f64 = 1e-5;

/// All tiles at one image size and number of channels.
pub(super) struct Case {
    channels: usize,
    size: [u32; 2],
    gaussians: usize,
    tiles: Vec<TileTiming>,
}

/// Measurements of one tile with one sort.
struct TileTiming {
    tile: Tile,
    sorting: Sorting,
    intersections: u32,
    /// Largest and mean difference from the render of the first tile.
    differences: (f32, f64),
    /// Milliseconds of forward and backward blending, and of the whole rasteriser.
    times: [f64; 3],
    /// Of the blend kernels, forward and backward, as far as the driver reports.
    resources: Option<[Resources; 2]>,
}

/// Measures every case, and finds the fastest tile for each number of channels.
pub(super) fn measure(bench: &Bench, sizes: &[[u32; 2]]) -> Result<(Vec<Case>, Vec<TunedTile>)> {
    let device = bench.gpu.properties();
    let (mut cases, mut tiles) = (vec![], vec![]);
    for features in FEATURES {
        let measured = |choices: &[(Tile, Sorting)]| {
            let sizes = sizes.iter().filter(|_| !choices.is_empty());
            let scenes = sizes.map(|&size| bench.source.scene(size, features));
            scenes.map(|scene| Case::measure(bench, &scene, choices)).collect::<Result<Vec<_>>>()
        };
        let of_tiles = measured(&choices(device))?;
        let Some(choice) = fastest_of(&of_tiles) else { continue };
        let of_forms = measured(&in_forms(device, choice))?;
        let (tile, sorting) = fastest_of(&of_forms).unwrap_or(choice);
        tiles.push(TunedTile { channels: features.channels(), tile, sorting });
        cases.extend(of_tiles.into_iter().chain(of_forms));
    }
    Ok((cases, tiles))
}

/// The tile and the sort that are good at every size. A tile whose kernels spill is taken only where all do: the timed
/// scene leaves caches to spills that a larger one does not.
fn fastest_of(cases: &[Case]) -> Option<(Tile, Sorting)> {
    let times: Vec<Vec<f64>> = cases.iter().map(Case::times).collect();
    fastest(&times).map(|at| cases[0].tiles[at].choice())
}

/// Every tile with every sort that a device tries.
fn choices(device: &Properties) -> Vec<(Tile, Sorting)> {
    let subgroups = if device.is_cpu { &SUBGROUPS[..1] } else { &SUBGROUPS };
    let sharing =
        |size: [u32; 2]| subgroups.iter().map(move |&subgroups| Tile { subgroups, ..size.into() });
    let is_tried = |tile: &Tile| {
        let is_large = tile.subgroups == 1 || tile.size[0] * tile.size[1] >= SHARED_PIXELS;
        is_large && device.suits_tile(*tile)
    };
    // A processor sorts tiles by themselves with one subgroup each, whose every step is a loop of its own.
    let sorts = if device.is_cpu { &SORTS[..1] } else { &SORTS };
    let tiles = SIZES.into_iter().flat_map(sharing).filter(is_tried);
    tiles.flat_map(|tile| sorts.iter().map(move |&sorting| (tile, sorting))).collect()
}

/// A choice with every form of the backward pass that a device tries.
fn in_forms(device: &Properties, (tile, sorting): (Tile, Sorting)) -> Vec<(Tile, Sorting)> {
    let lengths = if device.is_cpu { &[][..] } else { &SEGMENTS };
    let of_length = |&segment| RecordSums::ALL.map(|sums| BackwardForm { segment, sums });
    let forms = lengths.iter().flat_map(of_length);
    let tiles = forms.map(|form| Tile { backward: Some(form), ..tile });
    tiles.filter(|tile| device.suits_tile(*tile)).map(|tile| (tile, sorting)).collect()
}

impl Case {
    fn measure(bench: &Bench, scene: &BenchScene, choices: &[(Tile, Sorting)]) -> Result<Self> {
        let BenchScene { camera, gaussians, .. } = scene;
        let gpu = &bench.gpu;
        let on_device = gaussians.upload(gpu)?;
        // Compiling takes longer than everything else.
        let compiled = choices.par_iter().map(|&(tile, sorting)| {
            let defaults = scene.render_settings();
            let settings = RenderSettings { tile: Some(tile), sorting: Some(sorting), ..defaults };
            let renderer = Renderer::with_gradients(gpu, settings, GradientKind::All, 0)?;
            let resources = renderer.blend_statistics()?;
            let resources = resources
                .map(|all| all.each_ref().map(|kernel| Resources::from_statistics(kernel)));
            Ok(((tile, sorting), renderer, resources))
        });
        let compiled = compiled.collect::<Result<Vec<_>>>()?;
        let (mut candidates, mut first) = (vec![], None);
        for ((tile, sorting), mut renderer, resources) in compiled {
            renderer.reserve(gaussians.count, [camera])?;
            let render = renderer.render_channels(&on_device, camera, &OPTIONS)?;
            let first = first.get_or_insert_with(|| render.clone());
            let status = Status::from_words(&gpu.read(renderer.status())?);
            let measured = TileTiming {
                tile,
                sorting,
                intersections: status.intersections,
                differences: differences(&render, first),
                times: [0.0; 3],
                resources,
            };
            candidates.push((renderer, measured, vec![]));
        }
        let mut pass = Pass::new(bench, *camera, on_device)?;
        // Interleaved, so that other load affects all tiles alike; the first round is a warm-up.
        for round in 0..=bench.repeats {
            for (renderer, _, rounds) in &mut candidates {
                let times = pass.profile(bench, renderer)?;
                rounds.extend((round > 0).then_some(times));
            }
        }
        let tiles = candidates.into_iter().map(|(_, measured, rounds)| {
            let median = |part: usize| median(rounds.iter().map(|times| times[part]).collect());
            TileTiming { times: [0, 1, 2].map(median), ..measured }
        });
        let tiles = tiles.collect();
        let channels = gaussians.shape.features.channels();
        let (size, gaussians) = ([camera.width, camera.height], gaussians.count);
        Ok(Self { channels, size, gaussians, tiles })
    }

    /// The time of each tile, infinite for those that are not to be taken: those that do not render what the others do,
    /// and those that spill unless all do.
    fn times(&self) -> Vec<f64> {
        let mut agreeing = self.tiles.iter().filter(|measured| measured.agrees());
        let all_spill = agreeing.all(TileTiming::spills);
        let is_taken =
            |measured: &TileTiming| measured.agrees() && (all_spill || !measured.spills());
        let time = |tile| if is_taken(tile) { tile.rasteriser() } else { f64::INFINITY };
        self.tiles.iter().map(time).collect()
    }

    /// The time of the fastest tile.
    fn least(&self) -> f64 {
        self.times().into_iter().fold(f64::INFINITY, f64::min)
    }

    pub(super) fn as_json(&self) -> Value {
        json!({
            "channels": self.channels,
            "width": self.size[0],
            "height": self.size[1],
            "gaussians": self.gaussians,
            "tiles": self.tiles.iter().map(TileTiming::as_json).collect::<Vec<_>>(),
        })
    }

    pub(super) fn as_text(&self) -> String {
        let Self { channels, size: [width, height], gaussians, .. } = self;
        let head =
            ["tile", "sorted", "blend forward", "backward", "rasteriser, ms", "intersections", ""];
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        rows.extend(self.tiles.iter().map(|measured| {
            let TileTiming { tile, sorting, intersections, times, .. } = measured;
            let note = match measured.agrees() {
                false => "renders differently",
                true if measured.rasteriser() == self.least() => "fastest",
                true if measured.spills() => "spills registers",
                true => "",
            };
            let mut row = vec![tile.to_string(), sorting.to_string()];
            row.extend(times.map(|milliseconds| format!("{milliseconds:.3}")));
            row.extend([intersections.to_string(), note.to_owned()]);
            row
        }));
        let registers: String = self.tiles.iter().filter_map(TileTiming::registers).collect();
        format!(
            "{channels} channels, {width}x{height} pixels, {gaussians} Gaussians\n{}{registers}",
            aligned(&rows)
        )
    }
}

const OPTIONS: RenderOptions = RenderOptions { sh_degree: MAX_SH_DEGREE, background: [0.0; 3] };

/// The buffers of a pass of the rasteriser, apart from those of its renderer.
struct Pass {
    camera: Camera,
    gaussians: DeviceGaussians,
    d_render: Buffer<f32>,
    gradients: Buffer<f32>,
    grad_norm_sums: Buffer<f32>,
    visit_counts: Buffer<u32>,
}

impl Pass {
    fn new(Bench { gpu, .. }: &Bench, camera: Camera, gaussians: DeviceGaussians) -> Result<Self> {
        let Layout { count, shape, .. } = gaussians.layout;
        let values = shape.features.channels() * camera.width as usize * camera.height as usize;
        Ok(Self {
            camera,
            d_render: gpu.buffer("d_render", &vec![1e-3; values])?,
            gradients: gpu.zeros("gradients", gaussians.layout.floats().total())?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            gaussians,
        })
    }

    /// Milliseconds of forward and backward blending, and of all passes.
    fn profile(&mut self, bench: &Bench, renderer: &mut Renderer) -> Result<[f64; 3]> {
        let Self { camera, gaussians, d_render, .. } = self;
        let times = bench.gpu.profile("tune", |pass| {
            renderer.forward(pass, &*gaussians, &*camera, &OPTIONS)?;
            let gradients = Gradients {
                parameters: &mut self.gradients,
                grad_norm_sums: &mut self.grad_norm_sums,
                visit_counts: &mut self.visit_counts,
            };
            let norm = GradientNorm::default();
            let drawn = gaussians.slice();
            renderer.backward(pass, drawn, &*camera, &OPTIONS, norm, d_render, gradients)
        })?;
        let of = |name| stages::of_kernels(&times, &[name]);
        Ok([of("blend_forward"), of("blend_backward"), total(&times)])
    }
}

impl TileTiming {
    fn choice(&self) -> (Tile, Sorting) {
        (self.tile, self.sorting)
    }

    fn rasteriser(&self) -> f64 {
        self.times[2]
    }

    /// Whether the render matches that of the first tile; phrased so that NaN does not.
    fn agrees(&self) -> bool {
        self.differences.0 <= LARGEST_DIFFERENCE && self.differences.1 <= MEAN_DIFFERENCE
    }

    /// Whether registers do not suffice a blend kernel, as far as the driver reports.
    fn spills(&self) -> bool {
        self.resources.is_some_and(|kernels| kernels.into_iter().any(Resources::spill))
    }

    fn as_json(&self) -> Value {
        let [forward, backward, rasteriser] = self.times;
        let resources = self.resources.map(
            |[forward, backward]| json!({ "blend_forward": forward, "blend_backward": backward }),
        );
        json!({
            "tile": self.tile,
            "sorting": self.sorting,
            "intersections": self.intersections,
            "agrees": self.agrees(),
            "spills": self.spills(),
            "largest_difference": self.differences.0,
            "blend_forward_ms": forward,
            "blend_backward_ms": backward,
            "rasteriser_ms": rasteriser,
            "resources": resources,
        })
    }

    /// A line with the registers and spills that the driver reports.
    fn registers(&self) -> Option<String> {
        let counts = |Resources { registers, spills, scratch, .. }: Resources| {
            let of = |name, count: Option<f64>| count.map(|count| format!("{count} {name}"));
            let all =
                [of("registers", registers), of("spills", spills), of("bytes of scratch", scratch)];
            all.into_iter().flatten().collect::<Vec<_>>().join(", ")
        };
        let [forward, backward] = self.resources?.map(counts);
        Some(format!("{}: forward {forward}; backward {backward}\n", self.tile))
    }
}

/// The largest and the mean difference, relative to the largest value.
fn differences(render: &[f32], first: &[f32]) -> (f32, f64) {
    let scale = first.iter().fold(1.0f32, |scale, value| scale.max(value.abs()));
    let each = || render.iter().zip(first).map(|(a, b)| (a - b).abs() / scale);
    // A NaN shows in the sum.
    let sum: f64 = each().map(f64::from).sum();
    (each().fold(0.0, f32::max), sum / first.len().max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn case(channels: usize, times: &[([u32; 2], f64, f32)]) -> Case {
        let measured = |&(size, rasteriser, difference): &([u32; 2], _, _)| TileTiming {
            tile: size.into(),
            sorting: Sorting::Whole,
            intersections: 0,
            differences: (difference, 0.0),
            times: [0.0, 0.0, rasteriser],
            resources: None,
        };
        Case { channels, size: [4, 4], gaussians: 1, tiles: times.iter().map(measured).collect() }
    }

    #[test]
    fn the_fastest_tile_is_good_at_every_size_and_renders_what_the_others_do() {
        let (small, large, wrong) = ([8, 8], [16, 16], [32, 8]);
        let cases = [
            case(3, &[(small, 1.0, 0.0), (large, 1.1, 0.0), (wrong, 0.1, 1.0)]),
            case(3, &[(small, 30.0, 0.0), (large, 20.0, 0.0), (wrong, 10.0, f32::NAN)]),
            case(11, &[(small, 5.0, 0.0), (large, 6.0, 0.0)]),
        ];
        let chosen = |tile: [u32; 2]| Some((tile.into(), Sorting::Whole));
        assert_eq!(fastest_of(&cases[..2]), chosen(large));
        assert_eq!(fastest_of(&cases[2..]), chosen(small));
    }

    #[test]
    fn a_gpu_tries_every_form_of_the_backward_pass_that_suits_it() {
        let segments = |subgroup_size, is_cpu, tried| {
            let device = Properties { subgroup_size, is_cpu, ..Properties::of_a_test() };
            let choices = in_forms(&device, ([16, 16].into(), Sorting::Tiles));
            assert!(choices.iter().all(|&(_, sorting)| sorting == Sorting::Tiles));
            let forms = choices.iter().filter_map(|(tile, _)| tile.backward);
            let of_sums = forms.filter(|form| form.sums == tried);
            of_sums.map(|form| form.segment).collect::<Vec<_>>()
        };
        for sums in RecordSums::ALL {
            assert_eq!(segments(32, false, sums), SEGMENTS);
            assert!(segments(8, true, sums).is_empty());
        }
        assert_eq!(segments(128, false, RecordSums::Shuffles), [0, 128, 512, 1024]);
        assert!(segments(128, false, RecordSums::SharedMemory).is_empty());
    }

    #[test]
    fn a_tile_that_spills_is_taken_only_where_all_do() {
        let (small, large) = ([8, 8], [16, 16]);
        let chosen = |spills: [f64; 2]| {
            let mut tuned = case(3, &[(small, 2.0, 0.0), (large, 1.0, 0.0)]);
            for (measured, value) in tuned.tiles.iter_mut().zip(spills) {
                let spills = |count| Resources { spills: Some(count), ..Resources::default() };
                measured.resources = Some([spills(0.0), spills(value)]);
            }
            let text = tuned.as_text();
            (fastest_of(&[tuned]).unwrap().0, text)
        };
        assert_eq!(chosen([0.0, 0.0]).0, large.into());
        let (tile, text) = chosen([0.0, 4.0]);
        assert!(tile == small.into() && text.contains("spills registers"), "{text}");
        assert_eq!(chosen([8.0, 4.0]).0, large.into());
    }

    #[test]
    fn a_difference_is_relative_and_nan_is_one() {
        assert_eq!(differences(&[1.0, 4.0], &[1.0, 2.0]), (1.0, 0.5));
        assert!(differences(&[1.0, f32::NAN], &[1.0, 2.0]).1.is_nan());
        assert_eq!(differences(&[], &[]), (0.0, 0.0));
    }
}
