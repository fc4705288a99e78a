/* Measures of a piece of a run (an interval without resets), from its Taylor polynomials.

   The cost integrates the polynomials' products exactly. The supremum and the settling time are
   found from crossings with a level, without sampling. */
#ifndef NOACK_EXACT_PIECE_MEASURES_H
#define NOACK_EXACT_PIECE_MEASURES_H

#include "norm_crossing.h"

static const double CERTAINTY = 1e-10; /* the supremum exceeds the returned one by at most this */

/* The sum over i <= p and j <= p of v_i W v_j/(2(i + j + 1)). */
static inline double double_sum(
    const double *vectors, int p, const double *weight, const double *inverse) {
    lanes total = filled(0.0);
    for (int i = 0; i <= p; i++) {
        /* Two independent sums: a single one would stall on the latency of each addition. */
        lanes v = load(vectors + i * STRIDE), more = filled(0.0);
        lanes own = scale(v, 0.5 * inverse[2 * i + 1]);
        int j = i + 1;
        for (; j < p; j += 2) {
            own = fma_scaled(load(vectors + j * STRIDE), inverse[i + j + 1], own);
            more = fma_scaled(load(vectors + (j + 1) * STRIDE), inverse[i + j + 2], more);
        }
        if (j == p)
            more = fma_scaled(load(vectors + p * STRIDE), inverse[i + p + 1], more);
        own = add(own, more);
        total = fma_lanes(weight == NULL ? own : times(weight, own), v, total);
    }
    return sum(total);
}

/* The same for numbers. */
static inline double double_sum_of_one(
    const double *numbers, int p, const double *weight, const double *inverse) {
    double total = 0.0;
    for (int i = 0; i <= p; i++) {
        double own = numbers[i] * (0.5 * inverse[2 * i + 1]), more = 0.0;
        int j = i + 1;
        for (; j < p; j += 2) {
            own = __builtin_fma(numbers[j], inverse[i + j + 1], own);
            more = __builtin_fma(numbers[j + 1], inverse[i + j + 2], more);
        }
        if (j == p)
            more = __builtin_fma(numbers[p], inverse[i + p + 1], more);
        own += more;
        total = __builtin_fma(weight == NULL ? own : weight[0] * own, numbers[i], total);
    }
    return total;
}

/* The integral of xQx + uRu over [0, s] of polynomials of degree p, exact up to rounding. With
   v_k = c_k s^k that of xQx is s times the sum of v_i Q v_j/(i + j + 1). */
static double square_integrals(exact_memory *memory, int p, double s) {
    const double *inverse = memory->inverse, *x = memory->x, *u = memory->u, small_share = 1e-27;
    double *xs = memory->x_scaled, *us = memory->u_scaled, power = 1.0, sizes[TERMS];
    int one_input = memory->one_input, u_terms = memory->is_static ? 0 : p; /* of a constant u */
    for (int k = 0; k <= p; k++, power *= s) {
        lanes v = scale(load(x + k * STRIDE), power);
        store(xs + k * STRIDE, v);
        sizes[k] = dot(v, v);
        if (k > u_terms)
            continue;
        if (one_input) {
            us[k] = u[k] * power;
            sizes[k] += us[k] * us[k];
        } else {
            lanes w = scale(load(u + k * STRIDE), power);
            store(us + k * STRIDE, w);
            sizes[k] += dot(w, w);
        }
    }
    /* The last coefficients often contribute nothing to the sum. */
    while (p > 1 && !(sizes[p] > small_share * sizes[0]))
        p--;
    u_terms = u_terms < p ? u_terms : p;
    double u_sum = one_input ? double_sum_of_one(us, u_terms, memory->R, inverse)
                             : double_sum(us, u_terms, memory->R, inverse);
    return 2.0 * s * (double_sum(xs, p, memory->Q, inverse) + u_sum);
}

/* |y(s)| e^(rate s) at or near a maximum to the right of low_s; *at_s is the time. */
static double climb(
    const double *curve, int p, double low_s, double high_s, double rate, double *at_s) {
    const int climbs = 12;
    lanes y, dy;
    value_and_slope(curve, p, low_s, &y, &dy);
    double low = dot(y, dy) + rate * dot(y, y);
    double best = sqrt(dot(y, y)) * fixed_exp(rate * low_s);
    *at_s = low_s;
    value_and_slope(curve, p, high_s, &y, &dy);
    double high = dot(y, dy) + rate * dot(y, y);
    for (int i = 0; i < climbs; i++) {
        /* Regula falsi if the slope decreases through 0, otherwise bisection. */
        double s = 0.5 * (low_s + high_s);
        if (low > 0.0 && 0.0 > high)
            s = low_s + (high_s - low_s) * (low / (low - high));
        value_and_slope(curve, p, s, &y, &dy);
        double slope = dot(y, dy) + rate * dot(y, y), size = sqrt(dot(y, y)) * fixed_exp(rate * s);
        int rises = slope > 0.0 && size >= best;
        *at_s = size > best ? s : *at_s;
        best = largest_of(best, size);
        if (rises) {
            low_s = s;
            low = slope;
            high = 0.5 * high;
        } else {
            high_s = s;
            high = slope;
            low = 0.5 * low;
        }
    }
    return best;
}

/* The larger of best, which is at least the value at end_s, and the supremum of |y(s)| e^(rate s)
   growth over [0, end_s], or UNRESOLVED. The value is attained, and the supremum exceeds it by at
   most the share CERTAINTY (values below 1e-150 are ignored; values above 1e150 are infinite). A
   curve that stays close to one level, such as an oscillation, is searched again as the scalar
   |y|^2, in which cancelling terms vanish. */
static double raise_supremum(
    exact_memory *memory, double best, const double *curve, int p, double end_s, double rate,
    double growth, double *at_s) {
    const double smallest = 1e-150, too_large = 1e150;
    const int few_steps = 50, most_rises = 10000; /* each passes a maximum or rises by CERTAINTY */
    for (int rise = 0; rise < most_rises; rise++) {
        if (best >= too_large)
            return best;
        double level = largest_of(best * (1.0 + CERTAINTY), smallest) / growth;
        level_search search = {level, rate, end_s, 0};
        double s = first_exit(curve, p, &search, 1, few_steps);
        if (s == UNRESOLVED) {
            lanes signs = filled(1.0);
            squared(curve, p, 1, (const double *)&signs, memory->squares);
            level_search again = {level * level, 2.0 * rate, end_s, 0};
            s = first_root(memory->squares, 2 * p, &again, 0.0);
        }
        if (s == NONE)
            return best;
        if (s == UNRESOLVED)
            return UNRESOLVED;
        double found = climb(curve, p, s, end_s, rate, at_s);
        best = largest_of(best * (1.0 + CERTAINTY), found * growth);
    }
    return UNRESOLVED;
}

/* The last s in [0, end_s] at which |y(s)| > level, NONE or UNRESOLVED. */
static double last_above(const double *curve, int p, double end_s, double level, lanes ended) {
    double square = level * level;
    if (dot(ended, ended) > square)
        return end_s;
    if (largest(curve, p, end_s) <= square)
        return NONE;
    level_search back = {level, 0.0, end_s, 1};
    double back_s = first_exit(curve, p, &back, 0, MOST_STEPS);
    return back_s < 0.0 ? back_s : end_s - back_s;
}

/* Whether |(x, e_s, e_c)| is below limit, and below limit times level if that is > 0. */
static inline int is_within(models state, double limit, double level) {
    lanes x = plant_of(state), e_s = sensor_error(state), e_c = controller_error(state);
    if (level > 0.0)
        limit *= least(level, 1.0);
    lanes squares = fma_lanes(x, x, fma_lanes(e_s, e_s, multiply(e_c, e_c)));
    return sum(squares) < limit * limit;
}

/* The time on a piece at which the loop's norm exceeds a limit, at most end_s. */
static double passed_at(
    const exact_memory *memory, double end_s, double limit, const rule_phase *phase) {
    const int halvings = 60;
    double low_s = 0.0, high_s = end_s;
    int p = degree_for(memory->reach_s, end_s);
    for (int i = 0; i < halvings; i++) {
        double s = 0.5 * (low_s + high_s);
        double level = phase->threshold * fixed_exp(-phase->rate_per_s * s);
        if (is_within(state_at(memory, p, s), limit, level))
            low_s = s;
        else
            high_s = s;
    }
    return high_s;
}

#endif
