/* The sensor's observer: it estimates x from measurements, under the inputs that the plant applied.

   Luenberger: x <- Ad x + Bd u at every step of the plant; at a measurement x <- x + L(y - C x).
   Kalman (1960): also P <- Ad P Ad' + Q; at a measurement S = C P C' + R, L = P C' S^-1, and, by
   Bucy and Joseph, P <- (I - L C) P (I - L C)' + L R L'. Thus P stays symmetric and positive
   semidefinite for any L: for its rounding error, and for a gain that the settings state. */
#include <math.h>
#include <stdlib.h>

#include "loop.h"

enum { MOST_GAINS = 1 << 16 };

static void swap_rows(int64_t columns, double *row, double *other) {
    for (int64_t k = 0; k < columns; k++) {
        double value = row[k];
        row[k] = other[k];
        other[k] = value;
    }
}

/* Solve S X = B by elimination with partial pivoting; S is (p, p), B is (p, n) and becomes X. */
static void solve(int64_t p, int64_t n, double *S, double *B) {
    for (int64_t k = 0; k < p; k++) {
        int64_t pivot = k;
        for (int64_t i = k + 1; i < p; i++)
            if (fabs(S[i * p + k]) > fabs(S[pivot * p + k]))
                pivot = i;
        if (pivot != k) {
            swap_rows(p, S + k * p, S + pivot * p);
            swap_rows(n, B + k * n, B + pivot * n);
        }
        for (int64_t i = k + 1; i < p; i++) {
            double factor = S[i * p + k] / S[k * p + k];
            for (int64_t j = k + 1; j < p; j++)
                S[i * p + j] -= factor * S[k * p + j];
            for (int64_t j = 0; j < n; j++)
                B[i * n + j] -= factor * B[k * n + j];
        }
    }
    for (int64_t i = p - 1; i >= 0; i--)
        for (int64_t j = 0; j < n; j++) {
            for (int64_t k = i + 1; k < p; k++)
                B[i * n + j] -= S[i * p + k] * B[k * n + j];
            B[i * n + j] /= S[i * p + i];
        }
}

void noack_observer_predict(noack_observer *observer, const double *u) {
    int64_t n = observer->n, m = observer->m;
    double *free_part = observer->scratch, *forced_part = free_part + n;
    noack_product(n, n, observer->Ad, observer->x, free_part);
    noack_product(n, m, observer->Bd, u, forced_part);
    for (int64_t k = 0; k < n; k++)
        observer->x[k] = free_part[k] + forced_part[k];
    if (observer->kind != NOACK_KALMAN)
        return;
    double *half = observer->scratch;
    noack_multiply(n, n, n, observer->Ad, observer->P, 0, half);
    noack_multiply(n, n, n, half, observer->Ad, 1, observer->P);
    for (int64_t k = 0; k < n * n; k++)
        observer->P[k] += observer->Q[k];
}

void noack_observer_gain(noack_observer *observer) {
    if (observer->kind != NOACK_KALMAN)
        return;
    int64_t n = observer->n, p = observer->p;
    if (observer->gain_count > 0 && !observer->has_gap) {
        int64_t number = min_of(observer->corrections, observer->gain_count - 1);
        copy(n * p, observer->gains + number * n * p, observer->gain);
        return;
    }
    double *CP = observer->scratch, *S = CP + n * p;
    noack_multiply(p, n, n, observer->C, observer->P, 0, CP);
    noack_multiply(p, n, p, CP, observer->C, 1, S);
    for (int64_t k = 0; k < p * p; k++)
        S[k] += observer->R[k];
    solve(p, n, S, CP);
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < p; j++)
            observer->gain[i * p + j] = CP[j * n + i];
}

/* P <- (I - L C) P (I - L C)' + L R L', made symmetric. */
static void correct_covariance(noack_observer *observer) {
    int64_t n = observer->n, p = observer->p, size = n * n;
    double *I_minus_LC = observer->scratch, *half = I_minus_LC + size, *next = half + size,
           *LR = next + size;
    noack_multiply(n, p, n, observer->gain, observer->C, 0, I_minus_LC);
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++)
            I_minus_LC[i * n + j] = (i == j ? 1.0 : 0.0) - I_minus_LC[i * n + j];
    noack_multiply(n, n, n, I_minus_LC, observer->P, 0, half);
    noack_multiply(n, n, n, half, I_minus_LC, 1, next);
    noack_multiply(n, p, p, observer->gain, observer->R, 0, LR);
    noack_multiply(n, p, n, LR, observer->gain, 1, half);
    for (int64_t k = 0; k < size; k++)
        next[k] += half[k];
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++)
            observer->P[i * n + j] = 0.5 * (next[i * n + j] + next[j * n + i]);
}

/* x <- x + gain (y - C x). */
static void correct_estimate(noack_observer *observer, const double *gain, const double *y) {
    int64_t n = observer->n, p = observer->p;
    double *innovation = observer->scratch, *change = innovation + p;
    noack_product(p, n, observer->C, observer->x, innovation);
    for (int64_t k = 0; k < p; k++)
        innovation[k] = y[k] - innovation[k];
    noack_product(n, p, gain, innovation, change);
    for (int64_t k = 0; k < n; k++)
        observer->x[k] += change[k];
}

void noack_observer_correct(noack_observer *observer, const double *y) {
    noack_observer_gain(observer);
    correct_estimate(observer, observer->gain, y);
    if (observer->kind == NOACK_KALMAN)
        correct_covariance(observer);
    observer->corrections++;
}

/* The inputs of steps that a missing measurement would have reported are unknown: the first known
   input is used. */
void noack_observe(
    noack_observer *observer, const noack_message *message, const noack_period *plant_period) {
    int64_t t_ns = message->t_ns, m = observer->m, known = (message->entries - observer->p) / m;
    /* Times are rounded to whole nanoseconds, so the difference may be 1 ns too short. */
    int64_t age_ns = t_ns - observer->t_ns + (plant_period->part > 0);
    int64_t steps = observer->t_ns < 0 || age_ns < 0 ? 0 : periods_within(plant_period, age_ns);
    const double *inputs = message->vector + observer->p;
    for (int64_t before = steps; before > 0; before--)
        noack_observer_predict(observer, inputs + m * max_of(known - before, 0));
    observer->has_gap |= steps > known;
    if (observer->corrections == 0 && observer->first_gain != NULL) {
        correct_estimate(observer, observer->first_gain, message->vector);
        observer->corrections = 1;
    } else
        noack_observer_correct(observer, message->vector);
    observer->t_ns = t_ns;
}

/* How it is made. ------------------------------------------------------------------------------ */

static const char *check(const noack_observer *observer) {
    if (!is_between(1, observer->n, NOACK_MAX_ENTRIES)
        || !is_between(1, observer->m, NOACK_MAX_ENTRIES)
        || !is_between(1, observer->p, NOACK_MAX_ENTRIES))
        return "an observer needs 1 to 64 states, inputs and outputs";
    if (!is_between(NOACK_LUENBERGER, observer->kind, NOACK_KALMAN)
        || !is_between(-1, observer->t_ns, MESSAGE_TIMES_NS))
        return "an observer is of an unknown kind, or has a time out of range";
    if (!is_between(0, observer->gain_count, MOST_GAINS))
        return "an observer has too many gains";
    return NULL;
}

noack_observer *noack_observer_new(const noack_observer *settings, const char **wrong) {
    noack_observer observer = *settings;
    if ((*wrong = check(&observer)) != NULL)
        return NULL;
    int64_t n = observer.n, m = observer.m, p = observer.p;
    int is_kalman = observer.kind == NOACK_KALMAN, of_kalman = is_kalman ? NEEDED : OPTIONAL;
    observer.scratch = NULL;
    owned_array arrays[] = {
        {&observer.Ad, n * n, NEEDED},
        {&observer.Bd, n * m, NEEDED},
        {&observer.C, p * n, NEEDED},
        {&observer.gain, n * p, is_kalman ? STATE : NEEDED},
        {&observer.first_gain, n * p, OPTIONAL},
        {&observer.gains, observer.gain_count * n * p, observer.gain_count > 0 ? NEEDED : OPTIONAL},
        {&observer.Q, n * n, of_kalman},
        {&observer.R, p * p, of_kalman},
        {&observer.P, n * n, of_kalman},
        {&observer.x, n, STATE},
        {&observer.scratch, 3 * n * n + n * p + p * p + 2 * n + p, STATE},
    };
    return with_arrays(&observer, sizeof observer, arrays, 11, "an observer lacks a matrix", wrong);
}

void noack_observer_free(noack_observer *observer) { free(observer); }
