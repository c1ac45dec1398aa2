// A view's learned exposure e = gain c + bias of each channel c: gain = exp(p), bias = BIAS_SCALE q.
//
// A view has six values: p of red, green and blue, then q. All zero is the identity, and if their means over the views
// are zero, so is the mean exposure in stops: with the arithmetic mean of gains, the model would be brighter than that
// the more exposures differ.

const uint EXPOSURE_WIDTH = 6;
// Gain and bias have similar effects on a render: the bias, at a fraction of the gain's rate, fits the remainder.
const float BIAS_SCALE = 0.25;
// Targets this close to that of white, half a code of 8 bits, are clipped.
const float CLIPPED_REACH = 0.5 / 255.0;

// Whether a target is clipped: a photograph bounds what is brighter than its white from below only.
bool is_clipped(float target, float white) { return abs(target - white) <= CLIPPED_REACH; }
