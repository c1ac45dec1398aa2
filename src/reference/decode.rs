use crate::gpu::Reference;
use crate::kernels::decode::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let per_word = 32 / constants.code_bits as usize;
        for i in 0..params.value_count as usize {
            let shift = constants.code_bits as usize * (i % per_word);
            let code = slices.codes[i / per_word] >> shift & ((1 << constants.code_bits) - 1);
            slices.decoded[i] = slices.values[code as usize];
        }
    }
}
