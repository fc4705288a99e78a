/* Halley's method where h(s) = g(s) - c e^(-rs) increases (see exact.h), in a bracket that is
   bisected to the last bit if need be.

   With the Newton step n = -h/h' it steps by n/(1 + n h''/(2 h')), and converges cubically. */
#ifndef NOACK_EXACT_ASCENT_H
#define NOACK_EXACT_ASCENT_H

#include "exact.h"

enum { FAST_STEPS = 60, TURNS = FAST_STEPS + 1100 }; /* more than any two doubles need */
static const double CLOSE = 1e-5; /* relative size of the last step; its cube is rounding */

typedef search_point evaluate_function(const void *curve, const level_search *search, double s);

/* The next point, if it is in the bracket, else a safe one. low_s is below the root, if there is
   one; there is one below high_s if beyond. */
static inline double bracketed(
    double following, int turn, double low_s, double high_s, int beyond) {
    if (turn < FAST_STEPS && low_s < following && following < high_s)
        return following;
    if (!beyond && (turn >= FAST_STEPS || following >= high_s))
        return high_s;
    return 0.5 * (low_s + high_s);
}

/* The positive root of value + slope q + curvature_bound q^2/2, given value <= 0, or span if that
   is smaller. */
static inline double safe_step(double value, double slope, double curvature_bound, double span) {
    if (value + span * (slope + 0.5 * curvature_bound * span) <= 0.0)
        return span;
    double root = sqrt(slope * slope - 2.0 * curvature_bound * value);
    return least(
        slope > 0.0 ? -2.0 * value / (slope + root) : (root - slope) / curvature_bound, span);
}

/* The root of an increasing h in (at.s, ahead_s), or NONE. evaluate gives h and its derivatives. */
static inline __attribute__((always_inline)) double ascend(
    evaluate_function *evaluate, const void *curve, const level_search *search, search_point at,
    double ahead_s) {
    double low_s = at.s, high_s = ahead_s;
    int beyond = 0;
    for (int turn = 0; turn < TURNS; turn++) {
        double newton = -at.excess / at.slope, turned = 0.5 * newton * (at.curvature / at.slope);
        double step = turned > -0.5 ? newton / (1.0 + turned) : newton;
        double following = at.slope > 0.0 ? at.s + step : INFINITY;
        if (fabs(step) <= CLOSE * at.s && fabs(turned) <= CLOSE && turn < FAST_STEPS)
            return following < ahead_s || beyond ? following : NONE;
        following = bracketed(following, turn, low_s, high_s, beyond);
        if (following == at.s)
            return at.s;
        at = evaluate(curve, search, following);
        if (at.excess >= 0.0) {
            high_s = at.s;
            beyond = 1;
        } else if (at.s == ahead_s)
            return NONE;
        else
            low_s = at.s;
    }
    return at.s;
}

#endif
