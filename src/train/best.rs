//! The best model of a run so far, kept on the host and restored if the run ends worse.

use super::Trainer;
use super::model::TrainedModel;
use crate::Result;

/// A tensor of a checkpoint: name, shape and values.
pub(super) type Tensor = (String, Vec<usize>, Vec<f32>);

/// The learned parameters, without optimizer state, as tensors of a checkpoint.
pub(super) type Snapshot = Vec<Tensor>;

/// Whether a tensor of a checkpoint contains parameters.
fn is_parameters(name: &str) -> bool {
    name.ends_with(".parameters")
}

impl Trainer {
    /// Reads back the current parameters.
    pub(super) fn snapshot(&mut self) -> Result<Snapshot> {
        self.tensors(is_parameters)
    }

    /// Restores the parameters; moments and statistics are reset.
    pub(super) fn restore_snapshot(&mut self, snapshot: &Snapshot) -> Result<()> {
        let gpu = self.gpu.clone();
        let shape =
            |(name, shape, _): &Tensor| (name == TrainedModel::PARAMETERS).then(|| shape.clone());
        if let Some([words, count]) = snapshot.iter().find_map(shape).as_deref() {
            let sh_degree = self.model.sh_degree_of_words(*words);
            self.model = self.model.zeros_like(&gpu, *count, sh_degree)?;
            self.renderer.set_sh_degree(self.model.shape().sh_degree)?;
        }
        for state in self.state() {
            let kept = snapshot.iter().find(|(name, _, _)| *name == state.name);
            kept.map_or(Ok(()), |(_, _, values)| state.write(&gpu, values))?;
        }
        self.reserve()
    }
}
