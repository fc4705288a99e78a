/* Finds the first time at which the integral of |y| exceeds a decaying threshold, on a piece.

   The integral never decreases and the threshold never increases, so they cross at most once and no
   crossing can be missed. The integral is computed by Gauss-Legendre quadrature with 8 nodes, on
   intervals that are halved until the halves agree with the whole to a share of 1e-13 of the
   integral so far. The crossing is found by bisection, to the last bits of the time. */
#ifndef NOACK_EXACT_INTEGRAL_CROSSING_H
#define NOACK_EXACT_INTEGRAL_CROSSING_H

#include "taylor.h"

/* The quadrature of |y| over [begin_s, end_s]. */
static double quadrature(const double *curve, int p, double begin_s, double end_s) {
    static const double nodes[] = {
        0.18343464249564978, 0.525532409916329, 0.7966664774136267, 0.9602898564975362};
    static const double weights[] = {
        0.36268378337836166, 0.3137066458778869, 0.22238103445337443, 0.10122853629037706};
    double middle = 0.5 * (begin_s + end_s), half = 0.5 * (end_s - begin_s), total = 0.0;
    for (int i = 0; i < 4; i++) {
        lanes y = value(curve, p, middle - half * nodes[i]);
        total += weights[i] * sqrt(dot(y, y));
        y = value(curve, p, middle + half * nodes[i]);
        total += weights[i] * sqrt(dot(y, y));
    }
    return half * total;
}

/* The first time at which the integral exceeds the level, NONE or UNRESOLVED; *integral is the
   integral at the start, then at that time or at the end. */
static double first_excess(
    const double *curve, int p, const level_search *search, double *integral) {
    const double tolerance = 1e-13, shortest = 1e-9; /* shortest interval: share of the piece */
    const int most_intervals = 100000, bisections = 60;
    double end_s = search->end_s, s = 0.0, step = end_s;
    if (*integral > search->level)
        return 0.0;
    for (int i = 0; i < most_intervals; i++) {
        if (!(s < end_s))
            return NONE;
        double next_s = least(s + step, end_s), middle = 0.5 * (s + next_s);
        double gained = quadrature(curve, p, s, middle) + quadrature(curve, p, middle, next_s);
        double error = fabs(gained - quadrature(curve, p, s, next_s));
        if (error > tolerance * (*integral + gained) && step > shortest * end_s) {
            step = 0.5 * (next_s - s);
        } else if (*integral + gained > search->level * fixed_exp(-search->rate * next_s)) {
            double low_s = s, high_s = next_s;
            for (int turn = 0; turn < bisections; turn++) {
                middle = 0.5 * (low_s + high_s);
                if (!(low_s < middle && middle < high_s))
                    break;
                if (*integral + quadrature(curve, p, s, middle)
                    > search->level * fixed_exp(-search->rate * middle))
                    high_s = middle;
                else
                    low_s = middle;
            }
            *integral += quadrature(curve, p, s, high_s);
            return high_s;
        } else {
            *integral += gained;
            s = next_s;
            step = 2.0 * step;
        }
    }
    return UNRESOLVED;
}

#endif
