use glam::Vec2;

/// Kahan's sum, as `include/compensated_sum.glsl` has it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CompensatedSum {
    pub(crate) sum: Vec2,
    carry: Vec2,
}

impl CompensatedSum {
    pub(crate) fn add(&mut self, x: Vec2) {
        let corrected = x - self.carry;
        let sum = self.sum + corrected;
        self.carry = (sum - self.sum) - corrected;
        self.sum = sum;
    }
}
