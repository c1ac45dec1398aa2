//! The structure term: the structure channel of the render against the structure of the target.

use glam::UVec2;
use nightsplat_models::gaussians::Feature;

use super::log::{LogSlot, PartialSums};
use super::{
    LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, check_weight, no_scratch, pixel_count,
};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::structure_l1;
use crate::targets::structure::StructureTarget;

pub(super) const SPEC: LossSpec = LossSpec {
    terms: &[Term::STRUCTURE],
    on: TermOn::Feature(Feature::Structure, |gpu, config| {
        Ok(Box::new(StructureLoss::new(gpu, config.weights.structure)?))
    }),
};

impl Term {
    /// Mean |structure - structure of the target|.
    pub const STRUCTURE: Self =
        Self::distance("structure", "structure", |config| config.weights.structure);
}

/// weight * mean |clamp(p, 0, 1) - structure|, p the structure channel of the render.
#[derive(Debug)]
pub struct StructureLoss {
    gpu: Gpu,
    weight: f64,
    pipeline: Pipeline<structure_l1::Kernel>,
    values_per_workgroup: u32,
    partials: Buffer<f32>,
    /// The structure of every view's target, (H, W) each.
    structures: Vec<Buffer<f32>>,
}

impl StructureLoss {
    /// Builds the kernel; [`StructureLoss::add`] and [`LossTerm::prepare`] add views.
    pub fn new(gpu: &Gpu, weight: f64) -> Result<Self> {
        check_weight("the structure", weight)?;
        let constants = structure_l1::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            weight,
            pipeline: gpu.pipeline(&constants)?,
            values_per_workgroup: gpu.properties().subgroup_size * constants.values_per_thread,
            partials: gpu.uninit("structure_partials", 0)?,
            structures: vec![],
        })
    }

    /// Adds a view of this size by the structure of its target, (H, W), and allocates scratch memory for it.
    pub fn add(&mut self, size: UVec2, structure: Buffer<f32>) -> Result<()> {
        let workgroups = pixel_count(size).div_ceil(self.values_per_workgroup) as usize;
        self.partials.grow(&self.gpu, workgroups)?;
        self.structures.push(structure);
        Ok(())
    }
}

impl LossTerm for StructureLoss {
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        let mut structures = StructureTarget::new(&self.gpu)?;
        for view in views {
            let target = (view.target)()?;
            let pixels = pixel_count(view.size) as usize;
            let mut structure = self.gpu.uninit("structure", pixels)?;
            self.gpu.run("structure", |pass| {
                structures.record(pass, &target, view.size, &mut structure)
            })?;
            self.add(view.size, structure)?;
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
        let (plane, pixels) = (inputs.plane(Feature::Structure), pixel_count(size));
        let workgroups = pixels.div_ceil(self.values_per_workgroup);
        if pixels == 0 || workgroups as usize > self.partials.len() {
            return Err(no_scratch("structure term", size));
        }
        structure.check_len(pixels as usize)?;
        for buffer in [render, &*d_render] {
            buffer.check_len((plane as usize + 1) * pixels as usize)?;
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
