// A lamp that moves with the camera, and what it does to the colour of a Gaussian.
//
// For a point in view space at r from the lamp, d = |r|, and u = 1 - cos(angle between r and the lamp's axis):
//
//   light = gain (ambient + (1 - ambient) (reference_distance / d)^exponent exp(-falloffs.x u - falloffs.y u^2))
//   lit colour = black + (colour - black) light^slope
//
// In training the gain is 1, and so is the light on the axis at the reference distance, whatever the learned numbers:
// brightness cannot move between the lamp and the colours, which are those at the reference light. Ambient light and
// that of the lamp add in linear light, so the sum is taken there; colours are encoded by the tone law, t = f(linear
// light), with black = f(0). A factor k of linear light multiplies t - black by k^slope to first order in ln k, with
// slope = d ln(f - black) / d ln light, and exactly where f - black is a power.
//
// Bounds: distances count from LAMP_NEAREST to LAMP_FARTHEST, u is at most 2, behind the lamp, and the ambient light is
// at least LAMP_LEAST_AMBIENT: all is finite, and the light is above 0.

// The learned numbers: position, tangents of the axis, ambient, exponent, and two falloffs, before their functions.
const uint LAMP_WIDTH = 9;
const uint LAMP_AMBIENT = 5;
const uint LAMP_EXPONENT = 6;
const uint LAMP_FALLOFFS = 7;
// Then those of the set: the reference distance in world units, and the slope of the tone law.
const uint LAMP_REFERENCE_DISTANCE = 9;
const uint LAMP_SLOPE = 10;
const uint LAMP_BLACK = 11;
const uint LAMP_GAIN = 12;
const uint LAMP_NUMBERS = 13;
// Position in reference distances, and tangents of the axis, per unit of their numbers: they learn more slowly.
const float LAMP_STEP = 0.25;
// The falloffs per unit of their functions, which learn faster: a spot has falloffs of ten.
const float LAMP_FALLOFF_STEP = 8.0;
// In reference distances.
const float LAMP_NEAREST = 0.0625;
const float LAMP_FARTHEST = 65536.0;
const float LAMP_LEAST_AMBIENT = 1e-4;
const float LAMP_LARGEST_EXPONENT = 4.0;
