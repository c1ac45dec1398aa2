// The taps of CIConv (Lengyel et al. 2021) at scale 0.8: sigma = 2^0.8 = 1.741, 13 x 13, separable.

const int RADIUS = 6;  // ceil(3 sigma + 0.5)

// exp(-u^2 / (2 sigma^2)) for u = 0..RADIUS, normalised: the sum over -RADIUS..RADIUS is 1.
const float SMOOTH[RADIUS + 1] =
    float[](0.22916753478066026, 0.19432166250384691, 0.11847469264771192, 0.05193572671595631, 0.01636978909143111,
        0.003709848750889283, 0.0006045128998342537);
// u exp(-u^2 / (2 sigma^2)), normalised: the sum of magnitudes is 1. This is the derivative up to its sign, which
// squaring removes.
const float SLOPE[RADIUS + 1] =
    float[](0.0, 0.1439987812447794, 0.17558733421481107, 0.11545827552826106, 0.048522221311347605,
        0.013745603342600787, 0.0026877843582001058);
