// A view's learned exposure e = gain c + bias of each channel c: gain = 1 + p, bias = BIAS_SCALE q.
//
// A view has six values: p of red, green and blue, then q. All zero is the identity, and if their means over the views
// are zero, the mean exposure is the identity, too.

const uint EXPOSURE_WIDTH = 6;
// Gain and bias have similar effects on a render: the bias, at a fraction of the gain's rate, fits the remainder.
const float BIAS_SCALE = 0.25;
