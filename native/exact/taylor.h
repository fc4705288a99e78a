/* The loop between events as Taylor polynomials with a bound on the truncation error.

   In the coordinates (r, e, d, q), relative to a reference r that follows the models, the plant is
   x = r - e, the sensor's model x_s = r + d, the controller's x_c = r - q. With E = A + BK - H,

       r' = H r        d' = H d        q' = H q        e' = A e - E r + BK q,

   since x' = A x + BK x_c. The reference is x_c, and q is 0, unless x has become small beside it:
   then the reference is x itself from there on (renew_reference()). e_s = e + d and e_c = e - q.
   After an event e_s is exactly 0, since d = -e or both are 0. A small mismatch E and the errors
   that it drives keep their relative accuracy.

   The Taylor coefficients of degree k are H_k r, H_k d, H_k q and A_k e + X_k r + D_k q. Their
   tables are computed once per plant:

       H_k = H^k/k!    A_k = A^k/k!    X_(k+1) = (A X_k - E H_k)/(k + 1),  X_0 = 0,
       D_(k+1) = (A D_k + BK H_k)/(k + 1),  D_0 = 0.

   Truncation error. The powers of G = [[H, 0], [-E/s, A]] have the blocks k! H_k, k! A_k and
   k! X_k/s. After a time of at most w, the polynomial of degree p omits the sum over k > p of
   G^k w^k/k! applied to (s r, e), and |G^(p+1+j)| <= |G^(p+1)| q z^j with z = |G^4|^(1/4) and
   q = max over r < 4 of |G^r|/z^r. For z w <= (p + 2)/2 the sum is at most
   2 q |G^(p+1)| w^(p+1)/(p + 1)!. It is kept below 2^-53, the rounding error of the state itself.
   s = |E|/max(|A|, |H|) balances the blocks, so that the truncation error of the part that a small
   E drives is relative to E. D_k = H_k - A_k - X_k has no larger terms. All norms are Frobenius
   norms, which bound the 2-norms from above. */
#ifndef NOACK_EXACT_TAYLOR_H
#define NOACK_EXACT_TAYLOR_H

#include "lanes.h"

static const double NEGLIGIBLE = 0x1p-53, ROUNDED_UP = 1.0 + 1e-9;
static const double LESS_STRICT[DEGREES] = {/* (1e-12/2^-53)^(1/(p + 1)) */
                                            6.178996568622248,  2.750419024561364,
                                            2.0146481673225165, 1.708531253776262,
                                            1.5428148079652244, 1.4394069351299323};

typedef struct {
    lanes r, e, d, q;
} loop_state;

static inline lanes plant_of(loop_state state) { return subtract(state.r, state.e); }
static inline lanes sensor_error(loop_state state) { return add(state.e, state.d); }
static inline lanes controller_error(loop_state state) { return subtract(state.e, state.q); }

static inline int degree_of(int i) { return 4 + 4 * i; }

/* Fill a table with H^k/k!, k = 0 ... HIGHEST + 1. */
static void powers(const double *H, double *table) {
    memset(table, 0, N * STRIDE * sizeof *table);
    for (int j = 0; j < N; j++)
        table[j * STRIDE + j] = 1.0;
    for (int k = 0; k <= HIGHEST; k++)
        for (int j = 0; j < N; j++, table += STRIDE)
            store(table + N * STRIDE, scale(times(H, load(table)), 1.0 / (k + 1)));
}

/* Fill a table with X_k, k = 0 ... HIGHEST + 1; with -BK instead of E, with D_k. */
static void driven(const double *A, const double *E, const double *H_k, double *table) {
    memset(table, 0, N * STRIDE * sizeof *table);
    for (int k = 0; k <= HIGHEST; k++)
        for (int j = 0; j < N; j++, table += STRIDE, H_k += STRIDE) {
            lanes column = subtract(times(A, load(table)), times(E, load(H_k)));
            store(table + N * STRIDE, scale(column, 1.0 / (k + 1)));
        }
}

/* The squared Frobenius norm of a matrix. */
static inline double square_sum(const double *matrix) {
    lanes total = filled(0.0);
    for (int j = 0; j < N; j++) {
        lanes column = load(matrix + j * STRIDE);
        total = fma_lanes(column, column, total);
    }
    return sum(total);
}

/* Compute the time over which the polynomial of each degree is accurate. */
static void find_reaches(exact_memory *memory) {
    const double *H_k = memory->H_k, *A_k = memory->A_k, *X_k = memory->X_k;
    double widest = largest_of(square_sum(A_k + N * STRIDE), square_sum(H_k + N * STRIDE));
    double mismatch = square_sum(memory->E), sizes[TERMS + 1];
    /* s^-2; if E or both matrices are 0, any value is valid. */
    double balance = widest > 0.0 && mismatch > 0.0 ? widest / mismatch : 1.0;
    for (int k = 0; k <= TERMS; k++) {
        int at = k * N * STRIDE;
        double own = square_sum(H_k + at) + square_sum(A_k + at);
        sizes[k] = sqrt(own + square_sum(X_k + at) * balance);
    }
    double z = sqrt(sqrt(24.0 * sizes[4])), q = 1.0;
    if (z > 0.0) {
        q = largest_of(largest_of(q, sizes[1] / z), 2.0 * sizes[2] / (z * z));
        q = largest_of(q, 6.0 * sizes[3] / (z * z * z));
    }
    for (int i = 0; i < DEGREES; i++) {
        int p = degree_of(i);
        double left_out = 2.0 * q * sizes[p + 1];
        memory->reach_s[i] = memory->measured_s[i] = left_out == 0.0 ? INFINITY : 0.0;
        if (left_out != 0.0 && left_out < INFINITY) {
            double most_s = z > 0.0 ? (p + 2) / (2.0 * z) : INFINITY;
            double carried_s = fixed_exp(noack_log(NEGLIGIBLE / left_out) / (p + 1));
            memory->reach_s[i] = least(carried_s, most_s);
            memory->measured_s[i] = least(carried_s * LESS_STRICT[i], most_s);
        }
    }
}

/* The lowest degree that is accurate over a window. */
static inline int degree_for(const double *reach_s, double window_s) {
    int lowest = DEGREES - 1;
#pragma GCC unroll 8
    for (int i = DEGREES - 2; i >= 0; i--)
        lowest = window_s <= reach_s[i] ? i : lowest;
    return degree_of(lowest);
}

/* The sum over k <= p of c_k s^k; p is even. Even and odd powers are two sums, half as long. The
   loops over both are unrolled once: every degree is a multiple of 4. */
static inline lanes value(const double *curve, int p, double s) {
    lanes even = load(curve + p * STRIDE), odd = filled(0.0);
    double square = s * s;
#pragma GCC unroll 2
    for (int k = p - 2; k >= 0; k -= 2) {
        even = fma_scaled(even, square, load(curve + k * STRIDE));
        odd = fma_scaled(odd, square, load(curve + (k + 1) * STRIDE));
    }
    return fma_scaled(odd, s, even);
}

/* The state at a time on a piece. */
static inline loop_state state_at(const exact_memory *memory, int p, double s) {
    loop_state state = {load(memory->r), value(memory->e, p, s), load(memory->d), load(memory->q)};
    if (memory->is_static)
        return state;
    state.r = value(memory->r, p, s);
    if (memory->has_d)
        state.d = value(memory->d, p, s);
    if (memory->has_q)
        state.q = value(memory->q, p, s);
    return state;
}

typedef struct { /* of a curve at a time */
    lanes y, dy, ddy;
} curve_point;

/* The polynomial and its derivatives: y = E(s^2) + s O(s^2), y' = O + 2 s (E' + s O'),
   y'' = 2 (E' + 3 s O') + 4 s^2 (E'' + s O''). */
static inline curve_point point_at(const double *curve, int p, double s) {
    lanes even = load(curve + p * STRIDE), odd = filled(0.0), even_rise = odd, odd_rise = odd;
    lanes even_curvature = odd, odd_curvature = odd; /* halves of E'' and O'' */
    double square = s * s;
#pragma GCC unroll 2
    for (int k = p - 2; k >= 0; k -= 2) {
        even_curvature = fma_scaled(even_curvature, square, even_rise);
        odd_curvature = fma_scaled(odd_curvature, square, odd_rise);
        even_rise = fma_scaled(even_rise, square, even);
        odd_rise = fma_scaled(odd_rise, square, odd);
        even = fma_scaled(even, square, load(curve + k * STRIDE));
        odd = fma_scaled(odd, square, load(curve + (k + 1) * STRIDE));
    }
    lanes half = fma_scaled(odd_rise, 3.0 * s, even_rise);
    half = fma_scaled(fma_scaled(odd_curvature, s, even_curvature), 4.0 * square, half);
    return (curve_point){
        fma_scaled(odd, s, even),
        fma_scaled(fma_scaled(odd_rise, s, even_rise), 2.0 * s, odd),
        add(half, half),
    };
}

/* A bound on |y''| in [0, s]. Entry by entry, the sum of |c_k| s^k bounds |y|, and its derivatives
   bound those of y; they do not decrease. */
static inline double curvature_bound(const double *curve, int p, double s) {
    lanes total = magnitude(load(curve + p * STRIDE)), slope = filled(0.0), half = slope;
    for (int k = p - 1; k >= 0; k--) {
        half = fma_scaled(half, s, slope);
        slope = fma_scaled(slope, s, total);
        total = fma_scaled(total, s, magnitude(load(curve + k * STRIDE)));
    }
    return ROUNDED_UP * 2.0 * sqrt(dot(half, half));
}

/* A bound on |y|^2 in [0, s]; p is even. */
static inline double largest(const double *curve, int p, double s) {
    lanes even = magnitude(load(curve + p * STRIDE)), odd = filled(0.0);
    double square = s * s;
#pragma GCC unroll 2
    for (int k = p - 2; k >= 0; k -= 2) {
        even = fma_scaled(even, square, magnitude(load(curve + k * STRIDE)));
        odd = fma_scaled(odd, square, magnitude(load(curve + (k + 1) * STRIDE)));
    }
    lanes total = fma_scaled(odd, s, even);
    return ROUNDED_UP * dot(total, total);
}

/* Write the coefficients of y'Sy, of degree 2p: the sum over i + j = k of c_i S c_j. A coefficient
   of y is (blocks, N), and S is diagonal with as many signs. */
static inline void squared(
    const double *curve, int p, int64_t blocks, const double *signs, double *out) {
    int64_t size = blocks * STRIDE;
    for (int k = 0; k <= 2 * p; k++) {
        lanes over_blocks = filled(0.0);
        for (int64_t block = 0; block < blocks; block++) {
            const double *c = curve + block * STRIDE;
            lanes total = filled(0.0);
            for (int i = k > p ? k - p : 0; i < (k + 1) / 2; i++)
                total = fma_lanes(load(c + i * size), load(c + (k - i) * size), total);
            total = add(total, total);
            if (k % 2 == 0) {
                lanes middle = load(c + k / 2 * size);
                total = fma_lanes(middle, middle, total);
            }
            total = multiply(total, load(signs + block * STRIDE));
            over_blocks = block == 0 ? total : add(over_blocks, total);
        }
        out[k] = sum(over_blocks);
    }
}

#endif
