// The bounds of log scales: with the largest scale, the determinant of a projected covariance is finite at the near
// plane: (f / 0.2)^2 times its square.
const float LOG_SCALE_MIN = -30.0;
const float LOG_SCALE_MAX = 13.0;
