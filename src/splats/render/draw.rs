//! Drawing into the images of a host: nothing is submitted, read back or waited for.
//!
//! Where a view has more intersections than memory, the nearest are drawn and the memory grows before a later draw, as
//! soon as the frame that overflowed is done.

use std::slice;

use nightsplat_core::camera::{Camera, Patch};

use super::eyes::DepthOrder;
use super::instances::{FirstSplat, Instance, VisibleInstances, layout_of, stored};
use super::target::Target;
use super::{DepthChannel, ProjectionKind, RenderOptions, Renderer};
use crate::Result;
use crate::gpu::{Buffer, Gpu, HostImage, ImageState, Pipeline, Recorder, Ring, Threads};
use crate::kernels::blend_forward::{DEPTH_MEDIAN, DEPTH_SUM};
use crate::kernels::status::STATUS_WORDS;
use crate::kernels::{depth_limits, pack_pixels, photograph_light};
use crate::splats::camera::model_number;
use crate::splats::device::{GaussianSlice, Layout};

/// The outcome of the newest draw that is done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// The number of its frame; 0 for a submission of our own.
    pub frame: u64,
    /// Intersections of splats and tiles, in the view that has the most.
    pub intersections: u32,
    /// The intersections that memory and budget allowed.
    pub capacity: u32,
    /// The splats of the fullest tile if the device cannot process that many, and the tile is not drawn; else 0.
    pub splats_per_tile: u32,
}

impl Drawn {
    /// The intersections that were left out, the farthest.
    pub fn left_out(&self) -> u32 {
        self.intersections.saturating_sub(self.capacity)
    }
}

/// Kernels and memory between a render and the images of a host.
#[derive(Debug)]
pub(super) struct HostTargets {
    pack: Pipeline<pack_pixels::Kernel>,
    limits: Pipeline<depth_limits::Kernel>,
    /// Built by the first draw of photographs.
    photograph: Option<Pipeline<photograph_light::Kernel>>,
    pixels: Buffer<u32>,
    under: Buffer<u32>,
    depths: Buffer<f32>,
    scene_words: Buffer<u32>,
    ring: Ring,
    /// The draw whose intersections the memory was last grown for.
    grown_for: Option<u64>,
}

impl HostTargets {
    fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            pack: gpu.pipeline(&pack_pixels::Constants {})?,
            limits: gpu.pipeline(&depth_limits::Constants {})?,
            photograph: None,
            pixels: gpu.uninit("pixels", 0)?,
            under: gpu.uninit("pixels under", 0)?,
            depths: gpu.uninit("depths", 0)?,
            scene_words: gpu.uninit("scene depth", 0)?,
            ring: gpu.ring("drawn", STATUS_WORDS as usize)?,
            grown_for: None,
        })
    }

    /// Memory for images of `pixels` pixels; it only grows.
    fn reserve(&mut self, gpu: &Gpu, pixels: usize, target: &Target<'_>) -> Result<()> {
        let words = |image: &HostImage| (pixels * image.format.bytes()).div_ceil(4);
        let color = target.color.map_or(0, words);
        self.pixels.grow(gpu, color)?;
        self.under.grow(gpu, if target.is_over { color } else { 0 })?;
        self.depths.grow(gpu, target.depth.map_or(0, |_| pixels))?;
        self.scene_words.grow(gpu, target.scene.map_or(0, |scene| words(scene.image)))
    }
}

/// What a draw shows.
#[derive(Clone, Copy)]
pub(super) enum Drawing<'a> {
    Model(GaussianSlice<'a>),
    Instances(&'a [Instance<'a>]),
}

/// A view of a draw.
struct DrawnView<'a> {
    camera: &'a Camera,
    /// Among the cameras.
    index: u32,
    order: DepthOrder,
    /// Those that have this order, itself among them.
    sharing: &'a [Camera],
}

impl Renderer {
    /// Records the render of `gaussians` from each camera into the layers of the target's images. Takes each image
    /// from its state `before` and leaves it in its state `after`. Binds compute pipelines, descriptor set 0 and push
    /// constants, and restores none of them.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] where target, cameras or Gaussians do not fit; the device is out of memory. Nothing is
    /// recorded then.
    pub fn draw<'a>(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: impl Into<GaussianSlice<'a>>,
        cameras: &[Camera],
        options: &RenderOptions,
        target: &Target<'_>,
    ) -> Result<()> {
        let gaussians = gaussians.into();
        self.prepare_draw(&gaussians.layout, cameras, target)?;
        self.draw_layers(pass, Drawing::Model(gaussians), cameras, options, target)
    }

    /// Records the render of several models, sorted together, as [`Renderer::draw`] does that of one.
    ///
    /// # Errors
    /// As [`Renderer::draw`]; an instance does not fit the renderer's settings.
    pub fn draw_instances(
        &mut self,
        pass: &mut Recorder<'_>,
        instances: &[Instance<'_>],
        cameras: &[Camera],
        options: &RenderOptions,
        target: &Target<'_>,
    ) -> Result<()> {
        self.prepare_instances(instances, cameras, target)?;
        self.draw_layers(pass, Drawing::Instances(instances), cameras, options, target)
    }

    fn draw_layers(
        &mut self,
        pass: &mut Recorder<'_>,
        drawing: Drawing<'_>,
        cameras: &[Camera],
        options: &RenderOptions,
        target: &Target<'_>,
    ) -> Result<()> {
        Target::check_background(options.background)?;
        self.clear_status(pass);
        let orders: Vec<_> = match target.has_one_sort(cameras) {
            true => DepthOrder::shared(cameras).collect(),
            false => vec![DepthOrder::Own; cameras.len()],
        };
        for (index, (camera, order)) in cameras.iter().zip(orders).enumerate() {
            let sharing = if order.is_shared() { cameras } else { slice::from_ref(camera) };
            let view = DrawnView { camera, index: index as u32, order, sharing };
            self.draw_layer(pass, drawing, view, options, target)?;
        }
        let capacity = self.drawn_capacity(target);
        let Self { frame, host_targets, .. } = self;
        if let Some(targets) = host_targets {
            pass.copy_to_ring(&frame.status, &mut targets.ring, capacity);
        }
        Ok(())
    }

    /// The outcome of the newest draw that is done; `None` before there is one. Waits for nothing.
    pub fn drawn(&self) -> Option<Drawn> {
        let newest = self.host_targets.as_ref()?.ring.newest()?;
        let status = super::Status::from_words(&newest.words);
        Some(Drawn {
            frame: newest.frame,
            intersections: status.intersections,
            capacity: newest.tag,
            splats_per_tile: status.splats_per_tile,
        })
    }

    /// Does everything about a draw that can fail: checks, kernels, memory. A draw does it itself; done ahead of time,
    /// its first recording takes no longer than the others.
    ///
    /// # Errors
    /// As [`Renderer::draw`].
    pub fn prepare_draw(
        &mut self,
        layout: &Layout,
        cameras: &[Camera],
        target: &Target<'_>,
    ) -> Result<()> {
        let law = self.settings.law.filter(|_| target.is_photograph);
        target.check(cameras, law.as_ref())?;
        self.check_layout(layout)?;
        let pixels = |camera: &Camera| Patch::from(camera).pixel_count();
        let pixels = cameras.iter().map(pixels).max().unwrap_or_default();
        if target.needs_depths() {
            self.frame.set_channels(&self.gpu, self.settings.channels() + 1)?;
        }
        let size = |camera: &Camera| Patch::from(camera).size;
        self.reserve_sizes(layout.count, layout.capacity, cameras.iter().map(size))?;
        for camera in cameras {
            let camera_model = model_number(&camera.model);
            let view_depths = target.needs_depths();
            let shares_sort = target.has_one_sort(cameras);
            let kind = ProjectionKind { camera_model, view_depths, instances: None, shares_sort };
            self.build_projections(kind)?;
        }
        self.build_blending(target.needs_depths())?;
        if target.scene.is_some() {
            self.limits.grow(&self.gpu, pixels)?;
        }
        if let Some(motion) = &target.motion {
            self.prepare_motion(motion.image, pixels, 0)?;
        }
        if target.pick.is_some() {
            self.prepare_picks(0)?;
        }
        if self.host_targets.is_none() {
            self.host_targets = Some(HostTargets::new(&self.gpu)?);
        }
        if let Some(targets) = &mut self.host_targets {
            targets.reserve(&self.gpu, pixels, target)?;
            if let (Some(law), None) = (law, &targets.photograph) {
                let tone_curve = law.curve;
                targets.photograph =
                    Some(self.gpu.pipeline(&photograph_light::Constants { tone_curve })?);
            }
        }
        self.grow_as_drawn();
        self.reserve_sorts()
    }

    /// [`Renderer::prepare_draw`] of [`Renderer::draw_instances`].
    ///
    /// # Errors
    /// As [`Renderer::draw_instances`].
    pub fn prepare_instances(
        &mut self,
        instances: &[Instance<'_>],
        cameras: &[Camera],
        target: &Target<'_>,
    ) -> Result<()> {
        let layout = layout_of(instances, &self.settings)?;
        self.prepare_draw(&layout, cameras, target)?;
        self.frame.instances.grow(&self.gpu, instances.len())?;
        if let Some(motion) = &target.motion {
            let pixels = cameras.iter().map(|camera| Patch::from(camera).pixel_count()).max();
            self.prepare_picks(pixels.unwrap_or_default())?;
            self.prepare_motion(motion.image, pixels.unwrap_or_default(), instances.len())?;
        }
        let view_depths = target.needs_depths();
        for camera in cameras {
            let camera_model = model_number(&camera.model);
            for instance in instances {
                let instances = Some(stored(&instance.gaussians.layout));
                let shares_sort = target.has_one_sort(cameras);
                let kind = ProjectionKind { camera_model, view_depths, instances, shares_sort };
                self.build_projections(kind)?;
            }
        }
        Ok(())
    }

    /// Takes memory for this many Gaussians, views of this size and this many intersections ahead of the first draw.
    #[doc(hidden)]
    pub fn reserve_draw(
        &mut self,
        gaussian_count: usize,
        size: [u32; 2],
        intersections: u32,
    ) -> Result<()> {
        self.reserve_sizes(gaussian_count, gaussian_count, [size.into()])?;
        let wanted = intersections.min(self.max_intersections());
        if wanted > self.frame.intersection_capacity() {
            self.frame.grow_intersections(&self.gpu, wanted)?;
        }
        self.reserve_sorts()
    }

    /// Grows the memory where the newest draw that is done had more intersections. Where memory is out, draws go on
    /// with what there is.
    fn grow_as_drawn(&mut self) {
        let Some(targets) = &mut self.host_targets else { return };
        let Some(newest) = targets.ring.newest() else { return };
        if targets.grown_for.replace(newest.number) == Some(newest.number) {
            return;
        }
        let wanted = super::Status::from_words(&newest.words).intersections;
        if wanted <= self.frame.intersection_capacity() {
            return;
        }
        let most = self.max_intersections();
        let grown = wanted.saturating_add(wanted / 2).min(most);
        if let Err(error) = self.frame.grow_intersections(&self.gpu, grown) {
            tracing::warn!("{wanted} intersections do not fit, the farthest are left out: {error}");
        }
    }

    fn drawn_capacity(&self, target: &Target<'_>) -> u32 {
        let capacity = self.frame.intersection_capacity();
        if target.budget == 0 { capacity } else { capacity.min(target.budget) }
    }

    fn draw_layer(
        &mut self,
        pass: &mut Recorder<'_>,
        drawing: Drawing<'_>,
        DrawnView { camera, index: layer, order, sharing }: DrawnView<'_>,
        options: &RenderOptions,
        target: &Target<'_>,
    ) -> Result<()> {
        let size = [camera.width, camera.height];
        let pixel_count = Patch::from(camera).pixel_count() as u32;
        let [color, depth] = [target.color, target.depth]
            .map(|image| image.map(|image| HostImage { layer: image.layer + layer, ..*image }));
        if let Some(scene) = target.scene {
            let mut image = HostImage { layer: scene.image.layer + layer, ..*scene.image };
            if target.merges_depth() {
                image.after = ImageState::TRANSFER_TARGET;
            }
            self.record_limits(pass, &image, scene.limits(camera), size)?;
        }
        let depths = target.needs_depths().then_some(DepthChannel {
            kind: match target.depth_kind {
                super::DepthKind::Median => DEPTH_MEDIAN,
                super::DepthKind::Expected => DEPTH_SUM,
            },
            has_limits: target.scene.is_some(),
        });
        let capacity = self.drawn_capacity(target);
        // The background is mixed in as the image counts colours.
        let before_black = RenderOptions { background: [0.0; 3], ..*options };
        let view = self.view(&camera.into(), depths.is_some(), order)?;
        pass.update(&mut self.frame.camera, &[(&Patch::from(camera)).into()])?;
        let (count, firsts) = match drawing {
            Drawing::Model(gaussians) => {
                self.check(&gaussians.layout)?;
                self.record_project(pass, gaussians, &view, options.sh_degree)?;
                let first = self.context_count();
                let firsts = vec![FirstSplat { splat: first as u32, instance: 0 }];
                (first + gaussians.layout.count, firsts)
            }
            Drawing::Instances(instances) => {
                let visible = VisibleInstances::new(instances, camera, sharing, &self.settings);
                self.record_instances(pass, &visible, &view, options.sh_degree)?;
                (visible.count, visible.firsts)
            }
        };
        self.record_splats(pass, count as u32, &view, &before_black, depths, Some(capacity))?;
        if let Some(motion) = &target.motion {
            let image = HostImage { layer: motion.image.layer + layer, ..*motion.image };
            let cameras = [camera, &motion.before[layer as usize]];
            self.record_motion(pass, drawing, cameras, target, &image, &firsts)?;
        }
        if let Some(pixel) = target.pick.filter(|_| layer == 0) {
            self.record_pick(pass, camera, pixel, target.scene.is_some(), firsts)?;
        }
        if target.is_photograph && color.is_some() {
            self.record_photograph(pass, pixel_count)?;
        }
        let plane = if target.depth.is_some() { self.settings.channels() as u32 } else { 0 };
        let Self { frame, host_targets, .. } = self;
        let Some(targets) = host_targets else { return Ok(()) };
        if let Some(image) = color.as_ref().filter(|_| target.is_over) {
            let taken = HostImage { after: ImageState::TRANSFER_TARGET, ..*image };
            pass.take_image(&taken, size, &mut targets.under);
        }
        let params = target.packing(camera, options.background, plane);
        pass.dispatch(
            &targets.pack,
            &params,
            pack_pixels::Buffers {
                render: frame.render.slice(),
                transmittances: frame.transmittances.slice(),
                under: targets.under.slice(),
                scene: targets.scene_words.slice(),
                pixels: targets.pixels.slice_mut(),
                depths: targets.depths.slice_mut(),
            },
            Threads::Exactly([pixel_count, 1, 1]),
        )?;
        if let Some(mut image) = color {
            if target.is_over {
                image.before = ImageState::TRANSFER_TARGET;
            }
            pass.give_image(&targets.pixels, &image, size);
        }
        if let Some(mut image) = depth {
            if target.merges_depth() {
                image.before = ImageState::TRANSFER_TARGET;
            }
            pass.give_image(&targets.depths, &image, size);
        }
        Ok(())
    }

    /// Records the inversion of the tone law in the render.
    fn record_photograph(&mut self, pass: &mut Recorder<'_>, pixel_count: u32) -> Result<()> {
        let Self { settings, frame, host_targets, .. } = self;
        let kernel = host_targets.as_ref().and_then(|targets| targets.photograph.as_ref());
        let (Some(law), Some(kernel)) = (&settings.law, kernel) else { return Ok(()) };
        pass.dispatch(
            kernel,
            &photograph_light::Params { pixel_count, tone: law.parameters },
            photograph_light::Buffers {
                transmittances: frame.transmittances.slice(),
                render: frame.render.slice_mut(),
            },
            Threads::Exactly([pixel_count, 1, 1]),
        )
    }

    /// Records the depths beyond which nothing is seen.
    fn record_limits(
        &mut self,
        pass: &mut Recorder<'_>,
        image: &HostImage,
        params: depth_limits::Params,
        size: [u32; 2],
    ) -> Result<()> {
        let Self { limits, host_targets, .. } = self;
        let Some(targets) = host_targets else { return Ok(()) };
        pass.take_image(image, size, &mut targets.scene_words);
        pass.dispatch(
            &targets.limits,
            &params,
            depth_limits::Buffers {
                words: targets.scene_words.slice(),
                limits: limits.slice_mut(),
            },
            Threads::Exactly([params.pixel_count, 1, 1]),
        )
    }
}
