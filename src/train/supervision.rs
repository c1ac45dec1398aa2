//! Supervision: from the stored photograph to the gradient of the loss with respect to the render.
//!
//! ```text
//! stored photograph -> pseudo-GT pass -> target ┐
//! render -> exposure -> mask ------------------ ┴-> colour terms -> mask -> exposure, backward -> d_render
//! render and features -> networks -> their terms -------------------------------------------------^
//! ```

use nightsplat_models::gaussians::Features;

use super::gaussians::TrainedGaussians;
use super::masks::Masks;
use super::networks::Networks;
use super::target_views::TargetViews;
use super::terms::{NetworkTerms, Photographs};
use super::views::{TrainingView, Views};
use crate::Result;
use crate::gpu::{Buffer, Recorder};
use crate::loss::exposure::Exposures;
use crate::loss::{LogSlot, LossLog, Losses, ParameterTerms, TermInputs};
use crate::splats::optimizer::{Adam, Learnable};
use crate::splats::render::Renderer;
use crate::targets::Targets;
use nightsplat_photographs::exposures::Affine;

/// The training views with their targets, and the terms of the loss.
#[derive(Debug)]
pub(super) struct Supervision {
    pub(super) views: Views,
    pub(super) targets: Targets,
    /// The target of a step's view, (3, H, W).
    pub(super) target: Buffer<f32>,
    /// Its dark photograph, if a network uses it.
    pub(super) photograph: Buffer<f32>,
    pub(super) masks: Masks,
    pub(super) exposures: Option<Exposures>,
    pub(super) networks: Option<NetworkTerms>,
    pub(super) losses: Losses,
    pub(super) parameter_terms: Option<ParameterTerms>,
    /// The gradient with respect to the render, (channels, H, W).
    pub(super) d_render: Buffer<f32>,
    pub(super) log: LossLog,
    pub(super) held_out: TargetViews,
}

impl Supervision {
    /// The networks, if the model has any.
    pub(super) fn networks(&mut self) -> Option<&mut Networks> {
        self.networks.as_mut().map(|terms| &mut terms.networks)
    }

    /// The exposure of every training photograph; none if exposures are not learned.
    pub(super) fn affines(&self) -> Result<Vec<Affine>> {
        self.exposures.as_ref().map_or_else(|| Ok(vec![]), Exposures::affines)
    }

    /// Records the loss terms of a step, in a slot of the log, and their gradient with respect to the render.
    pub(super) fn compare(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        id: TrainingView,
        features: Features,
        renderer: &mut Renderer,
        slot: u32,
    ) -> Result<()> {
        let Self { views, targets, masks, d_render, losses, .. } = self;
        let view = views.get(id);
        let channels = renderer.settings().trained_channels();
        let (render, transmittances, status) = renderer.render_and_status();
        let (size, photograph) = (view.size(), view.photograph.0);
        let target = views.record_target(pass, &targets.pseudo_gt, view, &mut self.target)?;
        let log = &mut LogSlot { log: &mut self.log, slot, status };
        let inputs = &TermInputs {
            step,
            view: id.0,
            size,
            features,
            render,
            transmittances,
            colors: render,
            target,
        };
        let exposed = match &mut self.exposures {
            Some(exposures) => {
                exposures.expose(pass, photograph, size, [render, target])?;
                exposures.exposed()
            }
            None => render,
        };
        let colors = masks.shown(pass, id, size, exposed, target)?;
        losses.record(pass, &TermInputs { colors, ..*inputs }, d_render, log)?;
        masks.hide(pass, id, size, channels, d_render)?;
        if let Some(exposures) = &mut self.exposures {
            exposures.backward(pass, photograph, size, [render, target], d_render)?;
        }
        let Some(networks) = &mut self.networks else { return Ok(()) };
        let low = views.record_photograph(pass, &targets.pseudo_gt, view, &mut self.photograph)?;
        // Networks see the model at the neutral exposure.
        let target = match &mut self.exposures {
            Some(exposures) if networks.follow_target() => {
                exposures.neutralize(pass, photograph, size, target)?;
                exposures.exposed()
            }
            _ => target,
        };
        let photographs = Photographs { mask: masks.of_view(id), low, target };
        networks.record(pass, inputs, photographs, d_render, log)?;
        masks.hide(pass, id, size, channels, d_render)
    }

    /// Records the terms on parameters, which add to the gradients of the Gaussians.
    pub(super) fn regularise(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: &mut TrainedGaussians,
        renderer: &mut Renderer,
        slot: u32,
    ) -> Result<()> {
        let Some(terms) = &mut self.parameter_terms else { return Ok(()) };
        let (_, _, status) = renderer.render_and_status();
        gaussians.record_terms(pass, terms, &mut LogSlot { log: &mut self.log, slot, status })
    }

    /// Records Adam's step of the learned parameters other than the Gaussians.
    pub(super) fn update(
        &mut self,
        pass: &mut Recorder<'_>,
        adam: &Adam,
        step: u64,
        cooldown_factor: f64,
        status: &Buffer<u32>,
    ) -> Result<()> {
        self.learnables().try_for_each(|learnable| {
            adam.update(pass, step, cooldown_factor, learnable, status)
        })?;
        match &mut self.exposures {
            Some(exposures) => exposures.center(pass, status),
            None => Ok(()),
        }
    }

    /// The learned parameters other than the Gaussians, for Adam and checkpoints.
    pub(super) fn learnables(&mut self) -> impl Iterator<Item = &mut dyn Learnable> {
        let networks = self.networks.iter_mut().flat_map(|terms| terms.networks.parameters_mut());
        let networks = networks.map(|parameters| parameters as &mut dyn Learnable);
        let exposures = self.exposures.iter_mut();
        networks.chain(exposures.map(|exposures| exposures as &mut dyn Learnable))
    }
}
