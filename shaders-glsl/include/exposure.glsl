// A view's exposure e = gain c + bias of each channel c, as it is learned: gain = 1 + p, bias = BIAS_SCALE q.
//
// A view has six numbers: p of red, green and blue, then q. All zero is the identity, and where their means over the
// views are zero, so is the mean of the exposures.

const uint EXPOSURE_WIDTH = 6;
// Gain and bias pull a render the same way: the bias, at a fraction of the gain's rate, takes what the gain leaves.
const float BIAS_SCALE = 0.25;
