/* What the files of the exact simulator share: numbers of a rule, searches, and its memory. */
#ifndef NOACK_EXACT_H
#define NOACK_EXACT_H

#include <math.h>
#include <string.h>

#include "../loop/loop.h"

#pragma GCC visibility push(default)
#include "public.h"
#pragma GCC visibility pop

enum {
    HIGHEST = 24,        /* largest degree of a state's Taylor polynomial */
    TERMS = HIGHEST + 1, /* coefficients of a curve */
    DEGREES = 6,         /* possible degrees: 4, 8, ..., 24 */
    MORE = 20,           /* coefficients of eta after those that its gain reaches */
    MOST_TERMS = 2 * HIGHEST + 2 + MORE,
    MOST_STEPS = 1000000 /* of a search */
};

#define NEVER_NS (INT64_C(1) << 62) /* longer times never end */
#define NONE (-1.0)                 /* results of searches, instead of a time */
#define UNRESOLVED (-2.0)

typedef struct {           /* a rule between two events; times in seconds since the run's start */
    double since_s, level; /* t_0 and c of the threshold */
    double floor_from_s;   /* from this time on the floor is the threshold */
    double begin_s;        /* the comparison counts from this time on */
    double due_s;          /* time of the next event that the rule forces */
    int64_t point;         /* number of the next grid point */
} rule_span;

typedef struct { /* an interval in which the forms of comparison and threshold do not change */
    double until_s;
    int compares;
    double threshold, rate_per_s; /* at its start; its decay */
} rule_phase;

typedef struct {               /* a search on [0, end_s] for the first crossing of c e^(-rs) */
    double level, rate, end_s; /* c > 0, r >= 0 */
    int backward;              /* search y(end_s - s) instead of y(s); then r = 0 */
} level_search;

typedef struct { /* a point of a search: h(s) = g(s) - c e^(-rs), and its derivatives */
    double s, excess, slope, curvature;
} search_point;

typedef struct {   /* a quadratic form |P z|^2 - |N z|^2 of z = (x, e_s), in blocks of N rows */
    double *rows;  /* (blocks, 2, N, N) of [P; N] */
    double *signs; /* (blocks, N) of each row */
} block_form;

typedef struct { /* memory of a simulation; arrays are in its scratch */
    const noack_exact_settings *exact;
    const noack_trigger_rule *rule;
    int64_t blocks;            /* of N rows each, of [P; N] and of [P_eta; N_eta] */
    int integrates, quadratic; /* what is compared; otherwise |W e_s| or nothing */
    int dynamic;
    int is_static; /* H = 0: r, d and q stay as they are between events */
    int has_d;     /* d is not 0: the models differ, or */
    int has_q;     /* q is not 0: the reference is not x_c */
    double grid_s;
    /* shared by all runs; matrices in column-major order, columns padded to a stride */
    double *H, *K, *H_k, *KH_k;
    double *weight, *forecast_weight, *Q, *R; /* NULL: the identity */
    block_form form, gain;                    /* of the comparison; of the rate of eta */
    /* of a plant */
    double *A, *B, *E, *A_k, *X_k;
    double *minus_BK, *D_k;
    int has_D_k;                /* computed when a reference is first renewed */
    double reach_s[DEGREES];    /* time over which a polynomial of each degree is accurate */
    double measured_s[DEGREES]; /* the same, at the accuracy of the measures */
    /* coefficients of curves */
    double *r, *e, *d, *q, *x, *u, *y, *w;
    double *error, *weighted; /* W e_s and W e_c; of equal curves one may be the other */
    double *own_error, *own_weighted;
    double squares[2 * TERMS], g[MOST_TERMS], eta[MOST_TERMS];
} exact_memory;

typedef struct { /* a run */
    noack_exact_row *row;
    int64_t number; /* of the run */
    const noack_exact_log *events;
    double *state;    /* (3, n) x, e_s, e_c at the start */
    double auxiliary; /* at the start */
    int64_t event;    /* 1: an event at the start */
    int64_t losses;   /* consecutive ones so far */
    double growth;    /* e^(rt) of the supremum, at the start of a piece */
} exact_run;

/* The code for a number of states; see states.c. */
typedef struct {
    int64_t n, stride; /* states; doubles of a vector */
    void (*prepare_shared)(exact_memory *memory);
    void (*prepare)(exact_memory *memory, const double *A, const double *B);
    void (*follow)(exact_memory *memory, exact_run *run);
    void (*sample)(
        exact_memory *memory, const double *state, double start_s, int64_t count, const double *t_s,
        double *states);
} exact_code;

#if defined(__x86_64__)
extern const exact_code exact_wide_4, exact_wide_8, exact_fused_3, exact_fused_4, exact_fused_8,
    exact_fused_16, exact_fused_64;
#endif
extern const exact_code exact_plain_3, exact_plain_4, exact_plain_8, exact_plain_16, exact_plain_64;

/* exact.c: whether the next update arrives; a column of
   STRIDE numbers for each of the matrix. */
int arrives(const noack_exact_settings *exact, exact_run *run);
void pad(int64_t rows, int64_t columns, const double *matrix, int64_t stride, double *result);

/* rule.c */
rule_span span_after(const exact_memory *memory, double t_s, double left, double size);
rule_phase phase_at(const exact_memory *memory, const rule_span *span, double t_s);
double threshold_after(const rule_phase *phase, double s);
int64_t last_point(double grid_s, double t_s);

/* level_crossing.c */
double first_root(const double *g, int degree, const level_search *search, double grain);
double estimate_root(const double *g, double level, double rate);
double polynomial(const double *g, int degree, double s);

/* Not fmin and fmax, which are calls of libm. */
static inline double least(double a, double b) { return b < a ? b : a; }
static inline double largest_of(double a, double b) { return b > a ? b : a; }

static inline double level_at(const level_search *search, double s) {
    return search->rate > 0.0 ? search->level * fixed_exp(-search->rate * s) : search->level;
}

#endif
