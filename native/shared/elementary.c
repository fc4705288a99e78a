/* Elementary functions with the same bits everywhere; elementary.h says how. */
#include "shared.h"

const two_part NOACK_POWERS_OF_2[32] = {
    {0x1p+0, 0.0},
    {0x1.059b0dp+0, 0x1.8ac2ba1d73e2ap-27},
    {0x1.0b5587p+0, -0x1.833b784eb3a37p-27},
    {0x1.11301dp+0, 0x1.25b50a4ebbf1bp-32},
    {0x1.172b84p+0, -0x1.c15742919041cp-27},
    {0x1.1d4873p+0, 0x1.68b9aa7805b8p-28},
    {0x1.2387a7p+0, -0x1.8a9dc7993e052p-28},
    {0x1.29e9df8p+0, -0x1.70108f69ed175p-27},
    {0x1.306fe08p+0, 0x1.18db8a96f46adp-27},
    {0x1.371a738p+0, -0x1.8aac6ab1d756p-29},
    {0x1.3dea65p+0, -0x1.f6e5eee525f6fp-27},
    {0x1.44e086p+0, 0x1.8624b40c4dbdp-30},
    {0x1.4bfdad8p+0, -0x1.64eaec715e343p-27},
    {0x1.5342b58p+0, -0x1.62b07e20f57c4p-28},
    {0x1.5ab07ep+0, -0x1.5bd5eb539b67fp-27},
    {0x1.6247ebp+0, 0x1.d2ac258f87d03p-31},
    {0x1.6a09e68p+0, -0x1.80c4336f74d05p-28},
    {0x1.71f75e8p+0, 0x1.d8bee7ba46e1ep-29},
    {0x1.7a1147p+0, 0x1.f580c36bea881p-27},
    {0x1.8258998p+0, 0x1.4cce128acf88bp-28},
    {0x1.8ace54p+0, 0x1.15506dadd3e2bp-27},
    {0x1.93737bp+0, 0x1.9b8bc9e8a0388p-29},
    {0x1.9c4918p+0, 0x1.51f8480e3e236p-27},
    {0x1.a5503bp+0, 0x1.1f12ae45a1225p-27},
    {0x1.ae89f98p+0, 0x1.5ad3ad5e8734dp-28},
    {0x1.b7f76fp+0, 0x1.7daf237553d84p-27},
    {0x1.c199bep+0, -0x1.3d56b1eeef9a7p-27},
    {0x1.cb720ep+0, -0x1.8837cb757e1a1p-27},
    {0x1.d5818ep+0, -0x1.822dbc6d12fd3p-27},
    {0x1.dfc973p+0, 0x1.bdcdaf5cb4656p-27},
    {0x1.ea4afap+0, 0x1.52486cc2c7b9dp-27},
    {0x1.f507658p+0, 0x1.b722a033a7c26p-27},
};

double noack_exp_at_limits(double x) {
    if (!(x < 709.8))
        return isnan(x) ? x : INFINITY;
    if (x < -745.2)
        return 0.0;
    power_parts parts = exp_parts(x);
    int exponent = (int)parts.exponent;
    double rounded = ldexp(parts.high + parts.low, exponent);
    if (rounded >= 0x1p-1022)
        return rounded;
    /* Round once, to a multiple of the smallest double. */
    double to_multiple = ldexp(1.0, 52 - 1074 - exponent), shifted = to_multiple + parts.high;
    double rounding = parts.high - (shifted - to_multiple);
    return ldexp((shifted + (rounding + parts.low)) - to_multiple, exponent);
}

double noack_exp(double x) { return fixed_exp(x); }

void noack_sine_and_cosine(double turns, double parts[2]) {
    wave_parts both = sine_and_cosine(turns);
    parts[0] = both.sine;
    parts[1] = both.cosine;
}

double noack_expm1(double x) {
    double square = x * x;
    if (fabs(x) < 0x1p-9)
        return x == 0.0 ? x : x + square * exp_series(x, square);
    if (!(x < 60.0)) /* 1 is far below the last place */
        return fixed_exp(x);
    if (x < -60.0)
        return -1.0;
    power_parts parts = exp_parts(x);
    double power = power_of_2(parts.exponent);
    double high = parts.high * power, low = parts.low * power, less = high - 1.0;
    double rounding = high > 1.0 ? (high - less) - 1.0 : high - (less + 1.0);
    return less + (rounding + low);
}

/* With x = 2^(k/32) (1 + r): ln x = k ln 2/32 + r - r^2/2 + r^3/3 - ..., where |r| < 0.012. The
   first three terms are computed as sums of two numbers. */
double noack_log(double x) {
    if (!(0.0 < x && x < INFINITY))
        return x == 0.0 ? -INFINITY : x > 0.0 ? x : NAN;
    int exponent;
    double m = 2.0 * frexp(x, &exponent), f = m - 1.0;          /* 1 <= m < 2 */
    double log_2 = f + f * (1.0 - f) * (0.42086 - 0.15639 * f); /* with an error of 0.001 */
    int part = (int)(32.0 * log_2 + 0.5);                       /* from 0 to 32 */
    two_part inverse = NOACK_POWERS_OF_2[-part & 31];
    double half = part > 0 ? 0.5 : 1.0;
    inverse.high *= half;
    inverse.low *= half;
    /* r = m inverse - 1, in two numbers; the products with inverse.high are exact */
    double m_major = (m + 0x1.8p26) - 0x1.8p26, m_minor = m - m_major;
    double main = m_major * inverse.high - 1.0, more = m_minor * inverse.high + m * inverse.low;
    double r = main + more, r_low = (main - r) + more;
    double steps = 32.0 * (exponent - 1) + part, linear = steps * LN2_STEP.high + r;
    double linear_low = (steps * LN2_STEP.high - linear) + r;
    double r_major = (r + 0x1.8p20) - 0x1.8p20, half_square = 0.5 * r_major * r_major;
    double high = linear - half_square, high_low = (linear - high) - half_square;
    double rest = 0.5 * (r - r_major) * (r + r_major) + r * r_low, square = r * r;
    double upper = 1.0 / 7 - r * (1.0 / 8) + square * (1.0 / 9 - r * (1.0 / 10));
    double cubic = 1.0 / 3 - r * (1.0 / 4) + square * (1.0 / 5 - r * (1.0 / 6) + square * upper);
    double low = r * square * cubic + (steps * LN2_STEP.low + (r_low - rest));
    return high + (high_low + (linear_low + low));
}

/* Newton's method until the root y of m has 17 bits, of which the cube is exact; then three terms
   of the solution of (y + d)^3 = m. */
double noack_cube_root(double x) {
    if (!(0.0 < x && x < INFINITY))
        return x >= 0.0 ? x : NAN;
    int exponent;
    double m = frexp(x, &exponent);
    int third = (int)floor_div(exponent, 3);
    m = ldexp(m, exponent - 3 * third); /* 1/2 <= m < 4 */
    double y = 0.56278 + m * (0.53984 + m * (0.012175 * m - 0.11908));
    for (int step = 0; step < 2; step++)
        y -= (y * y * y - m) / (3.0 * y * y);
    y = (y + 0x1.8p36) - 0x1.8p36;
    double d = (m - y * y * y) / (3.0 * y * y), relative = d / y;
    return ldexp(y + (d - d * relative * (1.0 - relative * (5.0 / 3.0))), third);
}
