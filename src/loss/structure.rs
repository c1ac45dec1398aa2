//! The structure term: the structure channel of the render against the structure of the target.

use glam::UVec2;

use super::log::{LogSlot, PartialSums};
use super::{
    LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, check_weight, holds, no_scratch,
    pixel_count,
};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::structure_l1;
use crate::photographs::structure::StructureTarget;
use crate::splats::scene::Feature;

pub(super) const SPEC: LossSpec = LossSpec {
    terms: &[Term::STRUCTURE],
    on: TermOn::Feature(Feature::Structure, |gpu, config| {
        let loss = StructureLoss::new(gpu, config.weights.structure)?;
        Ok(Box::new(StructureTerm { loss, structures: vec![] }))
    }),
};

impl Term {
    /// Mean |structure - structure of the target|.
    pub const STRUCTURE: Self = Self {
        column: "structure",
        name: "structure",
        is_likeness: false,
        weight: |config| config.weights.structure,
    };
}

/// Builds the term with the structure of every view's target, (H, W) each.
#[derive(Debug)]
struct StructureTerm {
    loss: StructureLoss,
    structures: Vec<Buffer<f32>>,
}

impl LossTerm for StructureTerm {
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        let gpu = self.loss.gpu.clone();
        let mut structures = StructureTarget::new(&gpu)?;
        for view in views {
            self.loss.reserve(view.size)?;
            let target = (view.target)()?;
            let mut structure = gpu.uninit("structure", pixel_count(view.size) as usize)?;
            gpu.run("structure", |pass| {
                structures.record(pass, &target, view.size, &mut structure)
            })?;
            self.structures.push(structure);
        }
        Ok(())
    }

    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let &TermInputs { size, render, view, .. } = inputs;
        let Some(structure) = self.structures.get(view) else { return Ok(()) };
        let plane = inputs.plane(Feature::Structure);
        let inputs = StructureInputs { size, render, plane, structure };
        self.loss.record(pass, inputs, d_render, log)
    }
}

/// The inputs of one step.
#[derive(Clone, Copy, Debug)]
pub struct StructureInputs<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// (channels, H, W), not clamped.
    pub render: &'a Buffer<f32>,
    /// The structure channel.
    pub plane: u32,
    /// (H, W), from [`crate::photographs::structure::StructureTarget`].
    pub structure: &'a Buffer<f32>,
}

/// weight * mean |clamp(p, 0, 1) - structure|.
#[derive(Debug)]
pub struct StructureLoss {
    gpu: Gpu,
    weight: f64,
    pipeline: Pipeline<structure_l1::Kernel>,
    values_per_workgroup: u32,
    partials: Buffer<f32>,
}

impl StructureLoss {
    /// Builds the kernel; [`StructureLoss::reserve`] allocates.
    pub fn new(gpu: &Gpu, weight: f64) -> Result<Self> {
        check_weight("the structure", weight)?;
        let constants = structure_l1::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            weight,
            pipeline: gpu.pipeline(&constants)?,
            values_per_workgroup: gpu.properties().subgroup_size * constants.values_per_thread,
            partials: gpu.uninit("structure_partials", 0)?,
        })
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let workgroups = pixel_count(size).div_ceil(self.values_per_workgroup) as usize;
        if workgroups > self.partials.len() {
            self.partials = self.gpu.uninit("structure_partials", workgroups)?;
        }
        Ok(())
    }

    /// Writes the plane of `d_render`, (channels, H, W), and the mean to the log.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        StructureInputs { size, render, plane, structure }: StructureInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let pixels = pixel_count(size);
        let workgroups = pixels.div_ceil(self.values_per_workgroup);
        if pixels == 0 || workgroups as usize > self.partials.len() {
            return Err(no_scratch("structure term", size));
        }
        holds(structure, pixels as usize)?;
        for buffer in [render, &*d_render] {
            holds(buffer, (plane as usize + 1) * pixels as usize)?;
        }
        log.check()?;
        pass.dispatch(
            &self.pipeline,
            &structure_l1::Params {
                pixel_count: pixels,
                first: plane * pixels,
                scale: (self.weight / f64::from(pixels)) as f32,
            },
            structure_l1::Buffers {
                render: render.slice(),
                structure: structure.slice(),
                d_render: d_render.slice_mut(),
                partials: self.partials.slice_mut(),
            },
            Threads::Workgroups([workgroups, 1, 1]),
        )?;
        let sums = |count| PartialSums {
            term: Term::STRUCTURE,
            partials: &self.partials,
            count,
            scale: 1.0 / pixels as f32,
        };
        log.record(pass, [sums(workgroups), sums(0)])
    }
}
