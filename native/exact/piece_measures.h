/* Measures of a piece of a run (an interval without resets), from its Taylor polynomials.

   The cost is computed by a quadrature whose error is below rounding. The supremum and the settling
   time are found from crossings with a level, without sampling. */
#ifndef NOACK_EXACT_PIECE_MEASURES_H
#define NOACK_EXACT_PIECE_MEASURES_H

#include "norm_crossing.h"

static const double CERTAINTY = 1e-10; /* the supremum exceeds the returned one by at most this */

/* Gauss-Legendre quadrature on [0, 1]. It is exact up to degree 23. Of a higher power t^k its error
   is at most twice the distance to the polynomials of degree 23, which is 2^-47 for k = 24 and
   1e-10 for k = 30. The terms of a piece's squares decrease like (2 z s)^k/k! with z s < 3.5
   (taylor.h), so that the error is below 1e-16 of |(x, u)|^2 s at the start. */
enum { NODES = 12 };
static const double AT[NODES] = {
    0.009219682876640375, 0.04794137181476257, 0.11504866290284765, 0.2063410228566913,
    0.3160842505009099,   0.43738329574426554, 0.5626167042557345,  0.6839157494990901,
    0.7936589771433087,   0.8849513370971523,  0.9520586281852375,  0.9907803171233597,
};
static const double SHARE[NODES] = {
    0.023587668193255914, 0.05346966299765921, 0.08003916427167311, 0.10158371336153296,
    0.1167462682691774,   0.12457352290670139, 0.12457352290670139, 0.1167462682691774,
    0.10158371336153296,  0.08003916427167311, 0.05346966299765921, 0.023587668193255914,
};

/* The sum of SHARE v'Wv over the nodes. v is a curve of degree p. */
static inline lanes weighted_squares(const double *curve, int p, const double *weight, double s) {
    lanes v[NODES], total[2] = {filled(0.0), filled(0.0)};
    double at[NODES];
#pragma GCC unroll 12
    for (int i = 0; i < NODES; i++) {
        at[i] = AT[i] * s;
        v[i] = load(curve + p * STRIDE);
    }
    for (int k = p - 1; k >= 0; k--) {
        lanes coefficient = load(curve + k * STRIDE);
#pragma GCC unroll 12
        for (int i = 0; i < NODES; i++)
            v[i] = fma_scaled(v[i], at[i], coefficient);
    }
#pragma GCC unroll 12
    for (int i = 0; i < NODES; i++) {
        lanes *half = &total[i / (NODES / 2)];
        *half = fma_lanes(scale(v[i], SHARE[i]), weigh(weight, v[i]), *half);
    }
    return add(total[0], total[1]);
}

/* The sum of SHARE u'Ru over the nodes; u is a curve of degree p with m entries. */
static double weighted_input_squares(const exact_memory *memory, int p, double s) {
    enum { GROUPS = NODES / WIDTH };
    const double *us = memory->u, *R = memory->R;
    int64_t m = memory->exact->m;
    part u[STRIDE][GROUPS], at[GROUPS], share[GROUPS], total[4 / WIDTH] = {{0.0}};
    memcpy(at, AT, sizeof at);
    memcpy(share, SHARE, sizeof share);
    for (int i = 0; i < GROUPS; i++)
        at[i] = at[i] * spread(s);
    for (int64_t j = 0; j < m; j += 2) { /* two at once, since each waits for its last product */
        part even[GROUPS], odd[GROUPS];
#pragma GCC unroll 6
        for (int i = 0; i < GROUPS; i++) {
            even[i] = spread(us[p * STRIDE + j]);
            odd[i] = spread(us[p * STRIDE + j + 1]);
        }
        for (int k = p - 1; k >= 0; k--)
#pragma GCC unroll 6
            for (int i = 0; i < GROUPS; i++) {
                even[i] = fused(even[i], at[i], spread(us[k * STRIDE + j]));
                odd[i] = fused(odd[i], at[i], spread(us[k * STRIDE + j + 1]));
            }
        memcpy(u[j], even, sizeof even);
        memcpy(u[j + 1], odd, sizeof odd);
    }
    for (int64_t j = 0; j < m; j++)
        for (int i = 0; i < GROUPS; i++) {
            part weighted = u[j][i];
            if (R != NULL) {
                weighted = spread(0.0);
                for (int64_t l = 0; l < m; l++)
                    weighted = fused(spread(R[l * STRIDE + j]), u[l][i], weighted);
            }
            total[i % (4 / WIDTH)] = fused(u[j][i] * share[i], weighted, total[i % (4 / WIDTH)]);
        }
    double four[4];
    memcpy(four, total, sizeof four);
    return (four[0] + four[2]) + (four[1] + four[3]);
}

/* The integral of xQx + uRu over [0, s] of polynomials of degree p. */
static double square_integrals(const exact_memory *memory, int p, double s) {
    lanes squares = weighted_squares(memory->x, p, memory->Q, s);
    int u_degree = memory->is_static ? 0 : p; /* of a constant u */
    return s * (sum(squares) + weighted_input_squares(memory, u_degree, s));
}

typedef struct { /* |y(s)| e^(rate s) growth on [0, end_s]; y is a curve of degree p */
    const double *curve;
    int p;
    double end_s, rate, growth;
} growing_norm;

/* The norm, without growth, at or near a maximum to the right of low_s. */
static double climb(const growing_norm *norm, double low_s) {
    const int climbs = 12;
    const double *curve = norm->curve;
    int p = norm->p;
    double rate = norm->rate, high_s = norm->end_s;
    curve_point at = point_at(curve, p, low_s);
    double low = dot(at.y, at.dy) + rate * dot(at.y, at.y);
    double best = sqrt(dot(at.y, at.y)) * fixed_exp(rate * low_s);
    at = point_at(curve, p, high_s);
    double high = dot(at.y, at.dy) + rate * dot(at.y, at.y);
    for (int i = 0; i < climbs; i++) {
        /* Regula falsi if the slope decreases through 0, otherwise bisection. */
        double s = 0.5 * (low_s + high_s);
        if (low > 0.0 && 0.0 > high)
            s = low_s + (high_s - low_s) * (low / (low - high));
        at = point_at(curve, p, s);
        double square = dot(at.y, at.y), slope = dot(at.y, at.dy) + rate * square;
        double size = sqrt(square) * fixed_exp(rate * s);
        int rises = slope > 0.0 && size >= best;
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

/* The larger of best, which is at least the norm at end_s, and the supremum of the norm, or
   UNRESOLVED. The value is attained, and the supremum exceeds it by at most the share CERTAINTY
   (values below 1e-150 are ignored; values above 1e150 are infinite). A curve that stays close to
   one level, such as an oscillation, is searched again as the scalar |y|^2, in which cancelling
   terms vanish. */
static double raise_supremum(exact_memory *memory, const growing_norm *norm, double best) {
    const double smallest = 1e-150, too_large = 1e150;
    const double *curve = norm->curve;
    int p = norm->p;
    const int few_steps = 50, most_rises = 10000; /* each passes a maximum or rises by CERTAINTY */
    for (int rise = 0; rise < most_rises; rise++) {
        if (best >= too_large)
            return best;
        double level = largest_of(best * (1.0 + CERTAINTY), smallest) / norm->growth;
        level_search search = {level, norm->rate, norm->end_s, 0};
        double s = first_exit(curve, p, &search, ENDS_BELOW, few_steps);
        if (s == UNRESOLVED) {
            lanes signs = filled(1.0);
            squared(curve, p, 1, (const double *)&signs, memory->squares);
            level_search again = {level * level, 2.0 * norm->rate, norm->end_s, 0};
            s = first_root(memory->squares, 2 * p, &again, 0.0);
        }
        if (s == NONE)
            return best;
        if (s == UNRESOLVED)
            return UNRESOLVED;
        double peak = climb(norm, s);
        best = largest_of(best * (1.0 + CERTAINTY), peak * norm->growth);
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
    double back_s = first_exit(curve, p, &back, LIKELY, MOST_STEPS);
    return back_s < 0.0 ? back_s : end_s - back_s;
}

/* Whether |(x, e_s, e_c)| is below limit, and below limit times level if that is > 0. */
static inline int is_within(loop_state state, double limit, double level) {
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
