/* Finds where a polynomial curve first reaches a threshold, by steps that skip no crossing.

   h(s) = |y(s)| - c e^(-rs) is followed from a point where it is negative. If |y''| <= b on [s, a],

       h(s + q) <= phi(q) = |y(s) + y'(s) q| + b q^2/2 - c_s (1 - r q),    c_s = c e^(-rs).

   phi is convex. If phi(0) < 0 and phi(q) <= 0, then phi and h are negative in between, so a step
   of length q skips no crossing, however short. Newton's method from the right stays right of phi's
   root. It begins at the root that |y(s)| + (y.y'/|y|) q in place of |y(s) + y'(s) q| gives. The
   chord from its last point to (0, phi(0)) is zero at a point left of the root: this point is the
   step. A chord of phi lies above phi, so Newton's method may stop at any iteration: the step is
   then shorter and equally safe.

   If y is not 0, h'' = (|y'|^2 - (y.y'/|y|)^2 + y.y'')/|y| - r^2 c_s >= -(b + r^2 c_s) =: -L. If
   y = 0, the kink of |y| only increases h'. So if h'(s) > L (a - s), h increases on all of [s, a].
   Then it has at most one root there, and Newton's method may take any steps within the interval.

   b is bend() and valid on [0, a]. It is computed again if a smaller a makes it much smaller.
   Nothing is sampled. Only rounding remains: if h is below 0 by less than the rounding error, steps
   have about 1e-8 of the curve's time scale, and a tangency in floating point is found or missed.

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

/* y and y', forward or backward. */
static inline void look(
    const double *curve, int p, const level_search *search, double s, lanes *y, lanes *dy) {
    value_and_slope(curve, p, search->backward ? search->end_s - s : s, y, dy);
    if (search->backward)
        *dy = subtract(filled(0.0), *dy);
}

static inline search_point look_at_norm(const void *curve, const level_search *search, double s) {
    const vector_curve *own = curve;
    lanes y, dy;
    look(own->c, own->p, search, s, &y, &dy);
    double level = level_at(search, s), size = sqrt(dot(y, y));
    double slope = search->rate * level + (size > 0.0 ? dot(y, dy) / size : 0.0);
    return (search_point){s, size - level, slope};
}

/* The length of a step that skips no crossing, at most length; length if there is none within it.
   square, mixed and speed are |y|^2, y.y' and |y'|^2; most is b. */
static double safe_length(
    double square, double mixed, double speed, double level, double rate, double most,
    double length) {
    double below = level - sqrt(square), above = 0.0;
    for (int step = 0; step < NEWTON_STEPS; step++) {
        double straight = sqrt(largest_of(square + length * (2.0 * mixed + length * speed), 0.0));
        above = straight + level * (rate * length - 1.0) + 0.5 * most * length * length;
        if (above <= 0.0)
            return length;
        if (above <= below)
            break;
        double slope = level * rate + most * length;
        if (straight > 0.0)
            slope += (mixed + length * speed) / straight;
        double following = length - above / slope;
        if (!(0.0 < following && following < length))
            return 0.0;
        length = following;
    }
    return length * (below / (below + above));
}

/* The first s in [0, end_s) from which |y(s)| >= c e^(-rs), NONE or UNRESOLVED. ends_below: it is
   known that h(end_s) < 0. */
static double first_exit(
    const double *curve, int p, const level_search *search, int ends_below, int most_steps) {
    const double ahead = 3.0, nearer = 0.6;
    vector_curve own = {curve, p};
    double rate = search->rate, end_s = search->end_s, s = 0.0, ahead_s = end_s;
    double highest, most = bend(curve, p, end_s, &highest), lowest = level_at(search, end_s);
    if (highest < lowest * lowest)
        return NONE;
    lanes y = load(curve), dy = load(curve + STRIDE);
    if (search->backward)
        look(curve, p, search, s, &y, &dy);
    for (int steps = 0; steps < most_steps; steps++) {
        double square = dot(y, y), mixed = dot(y, dy), speed = dot(dy, dy);
        double level = level_at(search, s), size = sqrt(square);
        if (!(size < level))
            return s;
        if (s >= end_s)
            return NONE;
        double slope = rate * level + (size > 0.0 ? mixed / size : sqrt(speed));
        if (slope > (most + rate * rate * level) * (ahead_s - s)) {
            if (ends_below && ahead_s == end_s)
                return NONE;
            search_point at = {s, size - level, slope};
            s = ascend(look_at_norm, &own, search, at, ahead_s);
            if (s != NONE || ahead_s == end_s)
                return s;
            s = ahead_s;
        } else {
            double most_s = safe_step(size - level, slope, most, ahead_s - s);
            double step = safe_length(square, mixed, speed, level, rate, most, most_s);
            if (s + step >= end_s)
                return NONE;
            if (!(s + step > s))
                return s;
            s = least(s + step, ahead_s);
            if (s + ahead * step < nearer * ahead_s && !search->backward) {
                ahead_s = s + ahead * step;
                most = bend(curve, p, ahead_s, &highest);
            }
        }
        if (s == ahead_s) {
            ahead_s = end_s;
            most = bend(curve, p, ahead_s, &highest);
        }
        look(curve, p, search, s, &y, &dy);
    }
    return UNRESOLVED;
}

#endif
