use crate::gpu::Reference;
use crate::kernels::self_test::{
    Constants, FUNCTION_VALUES, Kernel, Params, SUBGROUPS, Slices, Tolerances,
};
use crate::self_test::functions;

fn number_of(i: u32) -> u32 {
    (i + 1).wrapping_mul(2_654_435_761) >> 9
}

/// A sound device counts no difference, except for the check that is planted, of which only tests know how many lanes
/// there are.
impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { numbers, sums, arrivals, values, words, .. } = slices;
        for (value, (expected, _)) in values.iter_mut().zip(functions(numbers)) {
            *value = expected as f32;
        }
        let rest = &numbers[FUNCTION_VALUES as usize + 1..];
        words[..2].copy_from_slice(&[rest[1], rest[0]]);
        for i in 0..SUBGROUPS {
            sums[i as usize] = number_of(i + params.turn);
        }
        arrivals[1 + params.turn as usize] += 1;
    }

    fn tolerances(_: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let bounds = functions(slices.numbers).into_iter().map(|(_, bound)| bound);
        Tolerances { values: bounds.collect(), ..Tolerances::default() }
    }
}
