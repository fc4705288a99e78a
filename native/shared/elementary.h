/* The exponential function, its inverse and their relatives in a fixed order of arithmetic: the
   same bits with every compiler, C library and processor, as long as no product and sum are
   contracted.

   Of libm the core uses only what is exact or correctly rounded: sqrt, fma, floor, ceil, fabs,
   fmin, fmax, frexp, ldexp. The others differ in last bits; shared.h forbids their names.

   e^x = 2^(k/32) e^r with the integer k nearest to 32 x/ln 2, so |r| <= ln 2/64. The powers
   2^(i/32) are sums of two numbers, the first of 26 bits; r is the sum of a multiple of 2^-32 and a
   rest. Their product's main part is then exact, and what is added to it is small. The error is
   below 0.501 units in the last place (tests/native/test_elementary.py). */
#ifndef NOACK_ELEMENTARY_H
#define NOACK_ELEMENTARY_H

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef struct {
    double high, low; /* the first has 26 bits */
} two_part;

extern const two_part NOACK_POWERS_OF_2[32]; /* 2^(i/32) */

/* ln 2/32; the first part has 36 bits, so that its product with a k is exact. */
static const two_part LN2_STEP = {0x1.62e42fefap-6, 0x1.cf79abc9e3b3ap-45};

/* e^x = (high + low) 2^exponent; the sum's relative error is below 2^-65. */
typedef struct {
    double high, low;
    int64_t exponent;
} power_parts;

/* (e^r - 1 - r)/r^2 for |r| <= ln 2/64, by Taylor's polynomial. */
static inline double exp_series(double r, double square) {
    double first = 0.5 + r * (1.0 / 6), second = 1.0 / 24 + r * (1.0 / 120);
    return (first + square * second) + square * square * (1.0 / 720 + r * (1.0 / 5040));
}

/* For |x| < 2^10. */
static inline power_parts exp_parts(double x) {
    const double steps_per_unit = 0x1.71547652b82fep+5; /* 32/ln 2 */
    const double to_integer = 0x1.8p52, to_multiple = 0x1.8p20;
    double shifted = x * steps_per_unit + to_integer, steps = shifted - to_integer;
    int64_t bits;
    memcpy(&bits, &shifted, sizeof bits);
    int64_t k = (int64_t)((uint64_t)bits << 16) >> 16;
    double reduced = x - steps * LN2_STEP.high, correction = steps * LN2_STEP.low;
    double major = (reduced + to_multiple) - to_multiple, minor = (reduced - major) - correction;
    double r = reduced - correction, square = r * r;
    two_part power = NOACK_POWERS_OF_2[k & 31];
    double whole = power.high + power.low, product = power.high * major;
    double high = power.high + product, lost = product - (high - power.high);
    double low = (lost + (power.low + power.low * major)) + whole * minor;
    low += whole * square * exp_series(r, square);
    return (power_parts){high, low, k >> 5};
}

/* 2^exponent for exponents from -1022 to 1023. */
static inline double power_of_2(int64_t exponent) {
    double power;
    uint64_t bits = (uint64_t)(exponent + 1023) << 52;
    memcpy(&power, &bits, sizeof power);
    return power;
}

/* e^x where it is close to the limits of doubles, or x is no number. */
double noack_exp_at_limits(double x);

static inline double fixed_exp(double x) {
    if (!(fabs(x) < 708.0))
        return noack_exp_at_limits(x);
    power_parts parts = exp_parts(x);
    return (parts.high + parts.low) * power_of_2(parts.exponent);
}

typedef struct {
    double sine, cosine;
} wave_parts;

/* sin and cos of 2 pi times a number of turns below 2^50. What is left of the turns after the
   nearest quarter is exact; the polynomials are those of fdlibm (Sun, 1993) on |angle| <= pi/4. */
static inline wave_parts sine_and_cosine(double turns) {
    double quarters = floor(4.0 * turns + 0.5),
           angle = (turns - 0.25 * quarters) * 0x1.921fb54442d18p+2;
    double z = angle * angle;
    double s5 = 2.75573137070700676789e-06
                + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10);
    double s2 = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s5);
    double sine = angle + angle * z * (-1.66666666666666324348e-01 + z * s2);
    double c4 = -2.75573143513906633035e-07
                + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11);
    double c2 = -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c4);
    double cosine = 1.0 - (0.5 * z - z * z * (4.16666666666666019037e-02 + z * c2));
    switch ((int64_t)(quarters - 4.0 * floor(0.25 * quarters))) {
    case 0:
        return (wave_parts){sine, cosine};
    case 1:
        return (wave_parts){cosine, -sine};
    case 2:
        return (wave_parts){-sine, -cosine};
    default:
        return (wave_parts){-cosine, sine};
    }
}

#endif
