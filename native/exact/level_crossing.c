/* Finds where a scalar polynomial first reaches a decaying level, by steps that skip no crossing.

   h(s) = g(s) - c e^(-rs) is followed from a point where it is negative. If |g''| <= b on [s, a]
   and c >= 0, then

       h(s + q) <= phi(q) = h(s) + h'(s) q + b q^2/2,    as h'' = g'' - r^2 c e^(-rs) <= b.

   phi is convex and negative between 0 and its positive root, so a step up to that root skips no
   crossing, however short. Since h'' >= -(b + r^2 c e^(-rs)) =: -L, h increases on all of [s, a] if
   h'(s) > L (a - s). Then it has at most one root there, and Halley's method may take any steps
   that stay within a bracket.

   b = sum of k(k-1) |g_k| a^(k-2) is valid on [0, a]. It is computed again if a smaller a makes it
   much smaller. Nothing is sampled. Only rounding remains: a tangency is found or missed if h
   differs from 0 by less than the rounding error. */
#include "ascent.h"

/* The bound on |g''| is taken again for the next AHEAD steps, if they end before NEARER times the
   end of the present one. */
static const double AHEAD = 3.0, NEARER = 0.6;

typedef struct {
    const double *g;
    int degree;
} scalar_curve;

double polynomial(const double *g, int degree, double s) {
    double total = g[degree];
    for (int k = degree - 1; k >= 0; k--)
        total = total * s + g[k];
    return total;
}

static inline search_point evaluate(const void *curve, const level_search *search, double s) {
    const double *g = ((const scalar_curve *)curve)->g;
    int degree = ((const scalar_curve *)curve)->degree;
    double level = level_at(search, s), rate = search->rate;
    double total = g[degree], slope = 0.0, half = 0.0;
    for (int k = degree - 1; k >= 0; k--) {
        half = half * s + slope;
        slope = slope * s + total;
        total = total * s + g[k];
    }
    return (search_point){s, total - level, slope + rate * level, 2.0 * half - rate * rate * level};
}

/* A bound on |g''| in [0, s]: the second derivative of the sum of |g_k| s^k. */
static double curvature_bound(const double *g, int degree, double s) {
    double total = 0.0;
    for (int k = degree; k > 1; k--)
        total = total * s + k * (k - 1.0) * fabs(g[k]);
    return total * (1.0 + 1e-9); /* more than its rounding */
}

/* The first s in [0, end_s] from which g(s) >= c e^(-rs), NONE or UNRESOLVED. If h starts above 0,
   or at 0 and increases, that is 0; grain is the rounding error of h(0). */
double first_root(const double *g, int degree, const level_search *search, double grain) {
    scalar_curve curve = {g, degree};
    double rate = search->rate, end_s = search->end_s, ahead_s = end_s;
    double bound = curvature_bound(g, degree, end_s);
    search_point at = evaluate(&curve, search, 0.0);
    if (at.excess > grain || (at.excess >= -grain && at.slope > 0.0))
        return 0.0;
    if (end_s <= 0.0)
        return NONE;
    at.excess = least(at.excess, 0.0);
    for (int steps = 0; steps < MOST_STEPS; steps++) {
        double s = at.s;
        if (at.slope > (bound + rate * rate * level_at(search, s)) * (ahead_s - s)) {
            s = ascend(evaluate, &curve, search, at, ahead_s);
            if (s != NONE || ahead_s == end_s)
                return s;
            s = ahead_s;
        } else {
            double step = safe_step(at.excess, at.slope, bound, ahead_s - s);
            if (s + step >= end_s)
                return NONE;
            if (!(s + step > s))
                return s;
            s = least(s + step, ahead_s);
            if (s + AHEAD * step < NEARER * ahead_s) {
                ahead_s = s + AHEAD * step;
                bound = curvature_bound(g, degree, ahead_s);
            }
        }
        if (s == ahead_s) {
            ahead_s = end_s;
            bound = curvature_bound(g, degree, ahead_s);
        }
        at = evaluate(&curve, search, s);
        if (at.excess >= 0.0)
            return s;
    }
    return UNRESOLVED;
}

/* The root of h's approximation by three coefficients; infinity if there is none. */
double estimate_root(const double *g, double level, double rate) {
    double value = least(g[0] - level, 0.0), slope = g[1] + rate * level;
    double half = g[2] - 0.5 * rate * rate * level, square = slope * slope - 4.0 * half * value;
    if (square < 0.0)
        return INFINITY;
    if (slope > 0.0)
        return -2.0 * value / (slope + sqrt(square));
    return half > 0.0 ? (sqrt(square) - slope) / (2.0 * half) : INFINITY;
}
