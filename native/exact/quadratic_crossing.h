/* A rule's quadratic comparison between two events, as a polynomial in time.

   With z = (x, e_s), the rule compares |P z|^2 - |N z|^2 - eta with a squared threshold. On a piece
   of a run z is a Taylor polynomial of degree p, so the squares are a polynomial of degree 2p. Its
   coefficients are the sums over i + j = k of y_i S y_j with y = [P; N] z and the signs S.
   eta' = -l eta + psi has the Taylor coefficients

       eta_(k+1) = (psi_k - l eta_k)/(k + 1).

   From degree D = 2p + 1 on, eta_(k+1) = -l eta_k/(k + 1), as psi is a polynomial of degree 2p. The
   truncation error after degree q >= D is at most |eta_q| s^q (l s/(q+1))/(1 - l s/(q+2)). Pieces
   are so short that l s <= 2. Then each further term is at most 2/(q + 1) times the one before, and
   for D >= 9 MORE terms reduce the error below 2^-53 |eta_D| s^D: 2^20 9!/29! < 1e-19.

   All terms are divided by the square of a number of the state's magnitude, so that values that
   have decayed to 1e-150 keep their relative accuracy. */
#ifndef NOACK_EXACT_QUADRATIC_CROSSING_H
#define NOACK_EXACT_QUADRATIC_CROSSING_H

#include "taylor.h"

/* Write a coefficient of [P; N] z, times a factor; the matrix is (blocks, 2, N, N). */
static inline void put_rows(
    const double *matrix, int64_t blocks, lanes x, lanes e_s, double factor, double *out) {
    for (int64_t block = 0; block < blocks; block++, matrix += 2 * N * STRIDE, out += STRIDE)
        store(out, scale(add(times(matrix, x), times(matrix + N * STRIDE, e_s)), factor));
}

/* Compute the comparison's coefficients from those of the state; return its degree. */
static int compare(exact_memory *memory, int p, double dynamic_variable) {
    double *g = memory->g, *eta = memory->eta, last = dynamic_variable;
    double decay_per_s = memory->rule->decay_per_s;
    int degree = 2 * p;
    squared(memory->y, p, memory->blocks, memory->form.signs, g);
    if (!memory->dynamic)
        return degree;
    squared(memory->w, p, memory->blocks, memory->gain.signs, eta);
    /* Compute the coefficients of eta from those of its gain, in place. */
    for (int k = 0; k <= degree + MORE; k++) {
        double gain = k <= degree ? eta[k] : 0.0;
        eta[k] = last;
        last = (gain - decay_per_s * last) / (k + 1);
    }
    eta[degree + 1 + MORE] = last;
    for (int k = 0; k <= degree; k++)
        g[k] -= eta[k];
    for (int k = degree + 1; k <= degree + 1 + MORE; k++)
        g[k] = -eta[k];
    return degree + 1 + MORE;
}

/* |P z| for e_s = 0. */
static double left_side(const exact_memory *memory, lanes x) {
    lanes total = filled(0.0);
    for (int64_t block = 0; block < memory->blocks; block++) {
        lanes y = times(memory->form.rows + block * 2 * N * STRIDE, x);
        y = multiply(multiply(y, load(memory->form.signs + block * STRIDE)), y);
        total = block == 0 ? y : add(total, y);
    }
    return sqrt(largest_of(sum(total), 0.0));
}

/* The first time at which the comparison holds on a piece, NONE or UNRESOLVED; *point is the next
   point of the grid. */
static double first_event(
    exact_memory *memory, int degree, const level_search *search, int64_t *point, double t_s) {
    if (memory->grid_s == 0.0) {
        double grain = search->level;
        lanes total = filled(0.0);
        for (int64_t block = 0; block < memory->blocks; block++) {
            lanes y = load(memory->y + block * STRIDE);
            total = block == 0 ? multiply(y, y) : add(total, multiply(y, y));
        }
        grain = sum(total) + grain;
        if (memory->dynamic)
            grain += fabs(memory->eta[0]);
        return first_root(memory->g, degree, search, 16 * 0x1p-52 * grain);
    }
    int64_t last = last_point(memory->grid_s, t_s + search->end_s);
    for (; *point <= last; ++*point) {
        double s = (double)*point * memory->grid_s - t_s;
        s = least(largest_of(s, 0.0), search->end_s);
        if (polynomial(memory->g, degree, s) > level_at(search, s))
            return s;
    }
    return NONE;
}

#endif
