use glam::Vec3;

/// Kahan's sum, as `include/compensated_sum.glsl` has it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CompensatedSum {
    pub(crate) sum: Vec3,
    carry: Vec3,
}

impl CompensatedSum {
    pub(crate) fn add(&mut self, x: Vec3) {
        let corrected = x - self.carry;
        let sum = self.sum + corrected;
        self.carry = (sum - self.sum) - corrected;
        self.sum = sum;
    }
}
