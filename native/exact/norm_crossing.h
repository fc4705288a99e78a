/* Finds where a polynomial curve first reaches a threshold, by steps that skip no crossing.

   h(s) = |y(s)| - c e^(-rs) is followed from a point where it is negative. If |y''| <= b on [s, a],

       h(s + q) <= phi(q) = |y(s) + y'(s) q| + b q^2/2 - c_s (1 - r q),    c_s = c e^(-rs).

   |y(s) + y'(s) q| is at most |y| + |y'| q. With the radial speed v = y.y'/|y| it is also at most
   |y| + v q + w q^2/(2 |y|), where w is |y'|^2 - v^2 if v > 0, and |y'|^2 otherwise: the first
   terms of a square root bound it from above. So phi has a quadratic bound, which is negative up to
   its positive root. A step of this length skips no crossing, however short.

   If y is not 0, h'' = (|y'|^2 - (y.y'/|y|)^2 + y.y'')/|y| - r^2 c_s >= -(b + r^2 c_s) =: -L. If
   y = 0, the kink of |y| only increases h'. So if h'(s) > L (a - s), h increases on all of [s, a].
   Then it has at most one root there, and Halley's method may take any steps within the interval.

   b is curvature_bound() and valid on [0, a]. It is computed again if a smaller a makes it much
   smaller. Nothing is sampled. Only rounding remains: if h is below 0 by less than the rounding
   error, steps have about 1e-8 of the curve's time scale, and a tangency in floating point is found
   or missed.

   A step either advances or is too short to change s in floating point, which ends the search. A
   curve that stays just below its threshold may need very many steps; then it is UNRESOLVED. */
#ifndef NOACK_EXACT_NORM_CROSSING_H
#define NOACK_EXACT_NORM_CROSSING_H

#include "ascent.h"
#include "taylor.h"

typedef struct {
    const double *c;
    int p;
} vector_curve;

/* A point of a search, forward or backward. */
static inline curve_point evaluate(
    const double *curve, int p, const level_search *search, double s) {
    if (s == 0.0 && !search->backward) {
        lanes half = load(curve + 2 * STRIDE);
        return (curve_point){load(curve), load(curve + STRIDE), add(half, half)};
    }
    curve_point at = point_at(curve, p, search->backward ? search->end_s - s : s);
    if (search->backward)
        at.dy = subtract(filled(0.0), at.dy);
    return at;
}

/* |y|^2 - (c e^(-rs))^2 and its derivatives: for Halley's method, in place of h, which has a square
   root and the same sign. */
static inline search_point look_at_square(const void *curve, const level_search *search, double s) {
    const vector_curve *vector = curve;
    curve_point at = evaluate(vector->c, vector->p, search, s);
    double level = level_at(search, s), square = level * level, rate = search->rate;
    return (search_point){
        s, dot(at.y, at.y) - square, 2.0 * (dot(at.y, at.dy) + rate * square),
        2.0 * (dot(at.dy, at.dy) + dot(at.y, at.ddy) - 2.0 * rate * rate * square)};
}

/* The length of a step that skips no crossing, at most span. speed: |y'|^2; curvature_bound: b. */
static inline double safe_length(
    double size, double radial, double speed, double level, double rate, double curvature_bound,
    double span) {
    /* The share of the level below which |y| + |y'| q is the better bound. */
    const double small = 0.125;
    if (size < small * level)
        return safe_step(size - level, rate * level + sqrt(speed), curvature_bound, span);
    double turned = radial > 0.0 ? speed - radial * radial : speed;
    return safe_step(
        size - level, rate * level + radial, curvature_bound + largest_of(turned, 0.0) / size,
        span);
}

/* What is known before a search. LIKELY: a bound on all of |y| is not worth its computation. */
typedef enum { UNKNOWN, LIKELY, ENDS_BELOW } forecast; /* of a crossing; or that h(end_s) < 0 */

/* The first s in [0, end_s) from which |y(s)| >= c e^(-rs), NONE or UNRESOLVED. */
static double first_exit(
    const double *curve, int p, const level_search *search, forecast crossing, int most_steps) {
    const double ahead = 3.0, nearer = 0.6;
    vector_curve vector = {curve, p};
    double rate = search->rate, end_s = search->end_s, s = 0.0, ahead_s = end_s;
    if (crossing != LIKELY) {
        double lowest = level_at(search, end_s);
        if (largest(curve, p, end_s) < lowest * lowest)
            return NONE;
    }
    double bound = curvature_bound(curve, p, end_s), level = search->level;
    curve_point at = evaluate(curve, p, search, 0.0);
    for (int steps = 0; steps < most_steps; steps++) {
        double square = dot(at.y, at.y), mixed = dot(at.y, at.dy), speed = dot(at.dy, at.dy);
        double size = sqrt(square);
        if (!(size < level))
            return s;
        if (s >= end_s)
            return NONE;
        double radial = size > 0.0 ? mixed / size : sqrt(speed), slope = rate * level + radial;
        if (slope > (bound + rate * rate * level) * (ahead_s - s)) {
            if (crossing == ENDS_BELOW && ahead_s == end_s)
                return NONE;
            double turned =
                size > 0.0 ? speed - radial * radial + dot(at.y, at.ddy) : dot(at.dy, at.ddy);
            double curvature = turned / (size > 0.0 ? size : radial) - rate * rate * level;
            search_point start = {s, size - level, slope, curvature};
            s = ascend(look_at_square, &vector, search, start, ahead_s);
            if (s != NONE || ahead_s == end_s)
                return s;
            s = ahead_s;
        } else {
            double step = safe_length(size, radial, speed, level, rate, bound, ahead_s - s);
            if (s + step >= end_s)
                return NONE;
            if (!(s + step > s))
                return s;
            s = least(s + step, ahead_s);
            if (s + ahead * step < nearer * ahead_s && !search->backward) {
                ahead_s = s + ahead * step;
                bound = curvature_bound(curve, p, ahead_s);
            }
        }
        if (s == ahead_s) {
            ahead_s = end_s;
            bound = curvature_bound(curve, p, ahead_s);
        }
        at = evaluate(curve, p, search, s);
        level = level_at(search, s);
    }
    return UNRESOLVED;
}

#endif
