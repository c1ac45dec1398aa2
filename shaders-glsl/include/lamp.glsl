// A lamp that moves with the camera, and what it does to the colour of a Gaussian.
//
// For a point in view space at r from the lamp, d = |r|, and u = 1 - cos(angle between r and the lamp's axis):
//
//   light = ambient + (1 - ambient) (reference_distance / d)^exponent exp(-falloffs.x u - falloffs.y u^2)
//   lit colour = black + tone(light^slope tone^-1(colour - black))
//
// The light on the axis at the reference distance is 1, whatever the learned numbers: brightness cannot move between
// the lamp and the colours, which are those in a light of 1. Ambient light and that of the lamp add in linear light, so
// the sum is taken there. Colours are encoded by the tone curve, which saturates: black + tone(x), with x in proportion
// to linear light to the power of slope, and
//
//   tone(x) = reach (1 - exp(-x / reach)), a line below 0 and beyond LAMP_KNEE reach; x for a reach of 0.
//
// Bounds: distances count from LAMP_NEAREST to LAMP_FARTHEST, u is at most 2, opposite to the axis, and the ambient
// light is at least LAMP_LEAST_AMBIENT: all is finite, and the light is above 0.

// The learned numbers: position, tangents of the axis, ambient, exponent, and two falloffs, before their functions.
const uint LAMP_WIDTH = 9;
const uint LAMP_AMBIENT = 5;
const uint LAMP_EXPONENT = 6;
const uint LAMP_FALLOFFS = 7;
// Then those of the set: the reference distance in world units, and the tone curve.
const uint LAMP_REFERENCE_DISTANCE = 9;
const uint LAMP_SLOPE = 10;
const uint LAMP_BLACK = 11;
const uint LAMP_REACH = 12;
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
// Where the tone curve becomes a line, and the share of its reach that is left there: exp(-LAMP_KNEE).
const float LAMP_KNEE = 2.7725887;
const float LAMP_LEFT = 0.0625;
