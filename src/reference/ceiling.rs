use crate::gpu::{Reference, Tolerance};
use crate::kernels::ceiling::{Constants, Kernel, Params, Slices, Tolerances};

const OPERATIONS_PER_TURN: u32 = 16;

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { source, target }: Slices<'_>) {
        let operations = params.turns * OPERATIONS_PER_TURN;
        let vectors = params.vector_count as usize;
        for i in 0..vectors {
            // All exchanges but the last cancel each other.
            let lane_bits = if constants.operation == 2 { params.lane_bits as usize } else { 0 };
            let from = i ^ lane_bits;
            for component in 0..4 {
                let mut value = if from < vectors { source[4 * from + component] } else { 0.0 };
                for _ in 0..if constants.operation == 1 { operations } else { 0 } {
                    value = value * params.factor + 1.0;
                }
                target[4 * i + component] = value;
            }
        }
    }

    /// An operation rounds twice or once and halves the errors of those before it: their sum is below that of four
    /// roundings on either side.
    fn tolerances(_: &Params, constants: &Constants, _: Slices<'_>) -> Tolerances {
        match constants.operation {
            1 => Tolerances { target: Tolerance::Roundings(8.0) },
            _ => Tolerances::default(),
        }
    }
}
