/* Follows a run from event to event: the code for N states. native/build.py compiles it for each N;
   with FUSED for processors of the kind x86-64 that have AVX2 and FMA; with WIDE for those that
   have AVX-512's 32 registers, too. */
#if defined(__SANITIZE_ADDRESS__) && !defined(__clang__)
#pragma GCC optimize("O0") /* vectors with checks take minutes to optimise */
#endif

#include "integral_crossing.h"
#include "piece_measures.h"
#include "quadratic_crossing.h"

enum { MOST_PIECES = 1000000 };            /* of a run */
static const double DIVERGED_NORM = 1e100; /* a state above this norm counts as diverged */
static const double SLOWEST = 2.0;         /* largest l s on a piece, l the decay rate of eta */
/* Length of the first search after an event, in units of the time that the error would need by its
   first coefficients. */
static const double LOOK_AHEAD = 1.05;

typedef struct { /* the comparison from the start of a piece on */
    rule_phase phase;
    double scale; /* the values of a quadratic comparison are divided by its square; otherwise 1 */
    double level; /* squared threshold, divided by the square of the scale */
    double auxiliary; /* eta or the integral, at the start */
} comparison;

static inline double size_of(lanes v) { return sqrt(dot(v, v)); }

typedef struct { /* what curves are written: the coefficients of degree begin to end */
    int begin, end;
    double factor; /* of those of quadratic forms */
} expansion;

typedef struct { /* whether r, d and q move; whether d and q differ from 0 */
    int moves, has_d, has_q;
} curve_kinds;

/* Write the coefficients. kinds is a constant, and each has code of its own. */
static inline __attribute__((always_inline)) void expand_kinds(
    exact_memory *memory, loop_state state, expansion range, curve_kinds kinds) {
    const int moves = kinds.moves, has_d = kinds.has_d, has_q = kinds.has_q;
    const double *H_k = memory->H_k, *A_k = memory->A_k, *X_k = memory->X_k, *D_k = memory->D_k;
    const double *KH_k = memory->KH_k, *weight = memory->weight;
    double *rs = memory->r, *es = memory->e, *ds = memory->d, *qs = memory->q, *xs = memory->x;
    double *us = memory->u, *errors = memory->own_error, *weighted = memory->own_weighted;
    lanes x_c = has_q ? subtract(state.r, state.q) : state.r;
    int quadratic = memory->quadratic;
    for (int k = range.begin; k <= range.end; k++) {
        int table = k * N * STRIDE, at = k * STRIDE;
        lanes r = filled(0.0), d = r, q = r, e = times(X_k + table, state.r);
        e = add(times(A_k + table, state.e), e);
        if (has_q)
            e = add(e, times(D_k + table, state.q));
        if (moves || k == 0) {
            r = times(H_k + table, state.r);
            d = has_d ? times(H_k + table, state.d) : d;
            q = has_q ? times(H_k + table, state.q) : q;
            store(rs + at, r);
            if (has_d || k == 0)
                store(ds + at, d);
            if (has_q || k == 0)
                store(qs + at, q);
            store(us + at, times(KH_k + table, x_c));
        }
        lanes x = subtract(r, e), e_s = add(e, d);
        store(es + at, e);
        store(xs + at, x);
        if (weight != NULL || has_q)
            store(weighted + at, weigh(weight, has_q ? subtract(e, q) : e));
        if (!quadratic && has_d)
            store(errors + at, weigh(weight, e_s));
        if (quadratic) {
            int64_t place = at * memory->blocks;
            put_rows(memory->form.rows, memory->blocks, x, e_s, range.factor, memory->y + place);
            if (memory->dynamic)
                put_rows(
                    memory->gain.rows, memory->blocks, x, e_s, range.factor, memory->w + place);
        }
    }
}

static void expand(exact_memory *memory, const loop_state *state, expansion range) {
    int is_weighted = memory->weight != NULL || memory->has_q;
    memory->weighted = is_weighted ? memory->own_weighted : memory->e;
    memory->error = memory->has_d ? memory->own_error : memory->weighted;
    if (memory->has_q && !memory->has_D_k) {
        driven(memory->A, memory->minus_BK, memory->H_k, memory->D_k);
        memory->has_D_k = 1;
    }
    if (memory->has_q)
        expand_kinds(memory, *state, range, (curve_kinds){1, 1, 1});
    else if (memory->is_static)
        expand_kinds(memory, *state, range, (curve_kinds){0, 1, 0});
    else if (memory->has_d)
        expand_kinds(memory, *state, range, (curve_kinds){1, 1, 0});
    else
        expand_kinds(memory, *state, range, (curve_kinds){1, 0, 0});
}

/* The same state with the plant's own as the reference, if that is small beside the present one:
   their difference would lose its digits. */
static loop_state renew_reference(exact_memory *memory, loop_state state) {
    const double small = 1e-8; /* of a square */
    lanes x = plant_of(state);
    if (dot(x, x) < small * dot(state.r, state.r)) {
        state = (loop_state){x, filled(0.0), sensor_error(state), subtract(state.q, state.e)};
        memory->has_q = 1;
    }
    return state;
}

/* The rule's span after an event or after the start. */
static rule_span next_span(const exact_memory *memory, loop_state state, double t_s) {
    lanes x = plant_of(state);
    double left = memory->quadratic ? left_side(memory, x) : 0.0;
    double size = memory->rule->forecasts ? size_of(weigh(memory->forecast_weight, x)) : 0.0;
    return span_after(memory, t_s, left, size);
}

/* The comparison of a phase, scaled to the state. */
static comparison comparison_at(
    const exact_memory *memory, rule_phase phase, loop_state state, double auxiliary) {
    if (!memory->quadratic)
        return (comparison){phase, 1.0, 0.0, auxiliary};
    double size = sqrt(dot(state.r, state.r) + dot(state.e, state.e) + dot(state.d, state.d));
    double scale = largest_of(largest_of(size, phase.threshold), sqrt(fabs(auxiliary)));
    scale = largest_of(scale, 1e-150);
    double level = phase.threshold / scale;
    return (comparison){phase, scale, level * level, auxiliary};
}

/* The length of the first search after an event, from the first coefficients. */
static double first_window(exact_memory *memory, const comparison *now, int64_t point, double t_s) {
    double threshold = now->phase.threshold;
    if (memory->quadratic) {
        compare(memory, 2, now->auxiliary / (now->scale * now->scale));
        double soon_s = estimate_root(memory->g, now->level, 2.0 * now->phase.rate_per_s);
        return largest_of(LOOK_AHEAD * soon_s, (double)point * memory->grid_s - t_s);
    }
    lanes first = load(memory->error + STRIDE), second = load(memory->error + 2 * STRIDE);
    double speed = size_of(first);
    if (speed == 0.0)
        return INFINITY;
    if (memory->integrates) /* of an error that grows in proportion to time: speed s^2/2 */
        return LOOK_AHEAD * sqrt(2.0 * largest_of(threshold - now->auxiliary, 0.0) / speed);
    double norm[] = {0.0, speed, dot(first, second) / speed};
    return LOOK_AHEAD * estimate_root(norm, threshold, now->phase.rate_per_s);
}

/* The time of the next event on a piece, NONE or UNRESOLVED; the integral; the next grid point. */
static double find_event(
    exact_memory *memory, comparison *now, int p, int64_t *point, double t_s, double window_s,
    forecast crossing) {
    const rule_phase *phase = &now->phase;
    if (memory->quadratic) {
        if (!phase->compares && !memory->dynamic)
            return NONE;
        int degree = compare(memory, p, now->auxiliary / (now->scale * now->scale));
        level_search search = {now->level, 2.0 * phase->rate_per_s, window_s, 0};
        return phase->compares ? first_event(memory, degree, &search, point, t_s) : NONE;
    }
    double level = phase->compares ? phase->threshold : INFINITY;
    level_search search = {level, phase->rate_per_s, window_s, 0};
    if (memory->integrates)
        return first_excess(memory->error, p, &search, &now->auxiliary);
    return phase->compares ? first_exit(memory->error, p, &search, crossing, MOST_STEPS) : NONE;
}

/* e^(rt) of the supremum. */
static double growth_at(const noack_exact_settings *exact, double t_s) {
    return exact->fading_per_s > 0.0 ? fixed_exp(exact->fading_per_s * t_s) : 1.0;
}

typedef struct { /* a piece of a run, which has been followed */
    double t_s, length_s;
    loop_state end;
    /* The norm of the error is at most its threshold; NULL: it may exceed it. */
    const rule_phase *bound;
} piece;

/* Raise a row's supremum by that of a piece with curves of degree q; return 0 if UNRESOLVED. */
static int measure_supremum(exact_memory *memory, exact_run *run, const piece *done, int q) {
    const noack_exact_settings *exact = memory->exact;
    lanes last = weigh(memory->weight, controller_error(done->end));
    growing_norm norm = {memory->weighted, q, done->length_s, exact->fading_per_s, run->growth};
    run->growth = growth_at(exact, done->t_s + done->length_s);
    double ceiling = INFINITY;
    if (done->bound != NULL)
        ceiling =
            done->bound->threshold * (done->bound->rate_per_s > 0.0 ? norm.growth : run->growth);
    double best = largest_of(run->row->sup_e_c_scaled, size_of(last) * run->growth);
    if (!(ceiling <= best * (1.0 + CERTAINTY)))
        best = raise_supremum(memory, &norm, best);
    if (best == UNRESOLVED)
        return 0;
    run->row->sup_e_c_scaled = best;
    return 1;
}

/* Add a piece's contribution to a row; settled is a level of |x|. Return the last time on the piece
   at which |x| > settled; NONE; or UNRESOLVED. */
static double measure_piece(
    exact_memory *memory, exact_run *run, const piece *done, double settled) {
    noack_exact_row *row = run->row;
    if (memory->exact->measure == NOACK_EXACT_TIMES)
        return NONE;
    int q = degree_for(memory->measured_s, done->length_s);
    row->cost += square_integrals(memory, q, done->length_s);
    if (!measure_supremum(memory, run, done, q))
        return UNRESOLVED;
    double within_s = last_above(memory->x, q, done->length_s, settled, plant_of(done->end));
    if (within_s >= 0.0)
        row->settling_s = done->t_s + within_s;
    return within_s;
}

/* Count an event, log it, and return whether its update arrives. */
static int count_event(
    const exact_memory *memory, exact_run *run, loop_state state, double t_s, double last_s) {
    const noack_exact_settings *exact = memory->exact;
    noack_exact_row *row = run->row;
    int delivered = arrives(exact, run);
    const noack_exact_log *events = run->events;
    if (events != NULL && row->transmissions < events->places) {
        int64_t at = run->number * events->places + row->transmissions;
        events->event_s[at] = t_s;
        events->delivered[at] = (uint8_t)delivered;
        for (int64_t i = 0; events->states != NULL && i < exact->n; i++) {
            double *to = events->states + 3 * exact->n * at + i;
            to[0] = entry(plant_of(state), (int)i);
            to[exact->n] = entry(sensor_error(state), (int)i);
            to[2 * exact->n] = entry(controller_error(state), (int)i);
        }
    }
    if (row->transmissions > 0)
        row->inter_event_min_s = least(row->inter_event_min_s, t_s - last_s);
    else if (t_s == 0.0 && !delivered)
        row->sup_e_c_scaled = size_of(weigh(memory->weight, controller_error(state)));
    row->transmissions += 1;
    row->deliveries += delivered;
    return delivered;
}

/* The models after an event: x_s = x, and x_c = x if the update arrives. */
static loop_state updated(loop_state state, int delivered) {
    lanes nothing = filled(0.0);
    if (delivered)
        return (loop_state){plant_of(state), nothing, nothing, nothing};
    return (loop_state){state.r, state.e, subtract(nothing, state.e), state.q};
}

static void finish_row(
    noack_exact_row *row, int64_t status, double t_s, double span_s, int above, double norm) {
    int64_t gaps = row->transmissions - 1;
    int finished = status == NOACK_EXACT_OK;
    row->inter_event_min_s = gaps > 0 ? row->inter_event_min_s : NAN;
    row->inter_event_mean_s = gaps > 0 ? span_s / (double)gaps : NAN;
    row->settling_s = finished && !above ? row->settling_s : NAN;
    row->cost = finished ? row->cost : NAN;
    row->sup_e_c_scaled = finished ? row->sup_e_c_scaled : NAN;
    row->final_norm = finished ? norm : NAN;
    row->diverged_at_s = status == NOACK_EXACT_DIVERGED ? t_s : NAN;
    row->status = status;
}

/* A state from x, e_s and e_c: the reference is x_c. */
static loop_state state_of(const double *signals) {
    lanes x = load(signals), e_s = load(signals + STRIDE), e_c = load(signals + 2 * STRIDE);
    return (loop_state){add(x, e_c), e_c, subtract(e_s, e_c), filled(0.0)};
}

enum { GOES_ON = -1 }; /* no status yet */

typedef struct { /* how far a run has been followed */
    loop_state state;
    double t_s, auxiliary;
    double first_s, last_s; /* of its events */
    double settled;         /* level of |x| */
    double farthest_s;      /* longest piece */
    rule_span span;
    int64_t point;      /* next grid point */
    int event;          /* there is an event at t_s */
    int begins, looked; /* a span begins; its first search is done */
    int agree;          /* x_c = x_s */
    int above;          /* |x| > settled at t_s */
} progress;

static progress begin(exact_memory *memory, exact_run *run) {
    loop_state state = state_of(run->state);
    double size = size_of(plant_of(state)), settled = memory->exact->settle * size;
    double farthest_s = memory->reach_s[DEGREES - 1];
    if (memory->dynamic && memory->rule->decay_per_s > 0.0)
        farthest_s = least(farthest_s, SLOWEST / memory->rule->decay_per_s);
    memory->has_q = 0;
    run->growth = 1.0;
    return (progress){
        .state = state,
        .auxiliary = run->auxiliary,
        .last_s = -1.0,
        .settled = settled,
        .farthest_s = farthest_s,
        .event = run->event != 0,
        .begins = 1,
        .agree = size_of(state.d) == 0.0,
        .above = size > settled,
    };
}

/* Count the event at the present time, and reset the models. Return a status. */
static int64_t take_event(exact_memory *memory, exact_run *run, progress *now) {
    int64_t earlier = run->row->transmissions;
    if (earlier >= memory->exact->most_events || now->t_s <= now->last_s)
        return NOACK_EXACT_TOO_MANY_EVENTS;
    now->agree = count_event(memory, run, now->state, now->t_s, now->last_s);
    now->first_s = earlier == 0 ? now->t_s : now->first_s;
    now->last_s = now->t_s;
    now->begins = 1;
    now->state = updated(now->state, now->agree);
    memory->has_q &= !now->agree;
    return GOES_ON;
}

static void begin_span(const exact_memory *memory, progress *now) {
    now->span = next_span(memory, now->state, now->t_s);
    now->begins = now->looked = 0;
    now->point = now->span.point;
    now->auxiliary = memory->integrates ? 0.0 : now->auxiliary;
}

/* Expand the curves of a piece, of at most *window_s, and find its event as find_event. The first
   search of a span makes the window as short as the event is expected. p: degree of the curves.
   This and follow_piece are inlined: with calls a run takes a tenth longer. */
static inline __attribute__((always_inline)) double search_piece(
    exact_memory *memory, progress *now, comparison *compared, double *window_s, int *p) {
    forecast crossing = UNKNOWN;
    double factor = 1.0 / compared->scale, longest_s = least(now->farthest_s, *window_s);
    int expanded = 0; /* number of coefficients so far */
    if (compared->phase.compares && !now->looked) {
        expand(memory, &now->state, (expansion){0, 2, factor});
        expanded = 3;
        double soon_s = first_window(memory, compared, now->point, now->t_s);
        crossing = soon_s < longest_s ? LIKELY : UNKNOWN;
        longest_s = least(longest_s, soon_s);
        now->looked = 1;
    }
    *window_s = longest_s;
    *p = degree_for(memory->reach_s, longest_s);
    expand(memory, &now->state, (expansion){expanded, *p, factor});
    return find_event(memory, compared, *p, &now->point, now->t_s, longest_s, crossing);
}

/* The auxiliary variable at a time of a piece with curves of degree p. */
static double auxiliary_at(
    const exact_memory *memory, const comparison *compared, int p, double s) {
    if (!memory->quadratic)
        return compared->auxiliary;
    if (!memory->dynamic)
        return 0.0;
    return polynomial(memory->eta, 2 * p + 1 + MORE, s) * (compared->scale * compared->scale);
}

/* Whether the state has diverged at a time of a piece; a usual one is not compared exactly. */
static int has_diverged(const rule_phase *phase, loop_state state, double s) {
    int is_usual = phase->threshold > 1e-10 && phase->rate_per_s * s < 1.0;
    return !(is_usual && is_within(state, 1e30, 1.0))
           && !is_within(state, DIVERGED_NORM, threshold_after(phase, s));
}

/* Follow a run over a piece: to its next event, or as far as its polynomials and the phase of its
   rule reach. Return a status. */
static inline __attribute__((always_inline)) int64_t
follow_piece(exact_memory *memory, exact_run *run, progress *now) {
    const noack_exact_settings *exact = memory->exact;
    if (now->begins)
        begin_span(memory, now);
    now->state = renew_reference(memory, now->state);
    rule_phase phase = phase_at(memory, &now->span, now->t_s);
    double end_s = least(phase.until_s, exact->horizon_s), left_s = end_s - now->t_s;
    comparison compared = comparison_at(memory, phase, now->state, now->auxiliary);
    memory->has_d = !now->agree || memory->has_q;
    if (phase.compares && !now->looked && !is_within(now->state, DIVERGED_NORM, phase.threshold))
        return NOACK_EXACT_DIVERGED;
    int p;
    double window_s = left_s;
    double found_s = search_piece(memory, now, &compared, &window_s, &p);
    if (found_s == UNRESOLVED)
        return NOACK_EXACT_UNDECIDED;
    now->event = found_s != NONE;
    double spent_s = now->event ? found_s : window_s;
    now->auxiliary = auxiliary_at(memory, &compared, p, spent_s);
    now->state = state_at(memory, degree_for(memory->reach_s, spent_s), spent_s);
    if (has_diverged(&phase, now->state, spent_s)) {
        now->t_s += passed_at(memory, spent_s, DIVERGED_NORM, &phase);
        return NOACK_EXACT_DIVERGED;
    }
    int is_bounded =
        now->agree && !memory->quadratic && phase.compares && !memory->integrates; /* e_c = e_s */
    piece done = {now->t_s, spent_s, now->state, is_bounded ? &phase : NULL};
    double within_s = measure_piece(memory, run, &done, now->settled);
    if (within_s == UNRESOLVED)
        return NOACK_EXACT_UNDECIDED;
    now->above = within_s == spent_s;
    now->t_s = now->event || window_s < left_s ? now->t_s + spent_s : end_s;
    now->event = now->event || now->t_s >= now->span.due_s;
    return GOES_ON;
}

/* Follow a run to its end. */
static void follow(exact_memory *memory, exact_run *run) {
    progress now = begin(memory, run);
    int64_t status = now.farthest_s > 0.0 ? GOES_ON : NOACK_EXACT_UNDECIDED;
    for (int piece = 0; piece < MOST_PIECES && status == GOES_ON; piece++) {
        if (now.event)
            status = take_event(memory, run, &now);
        if (status == GOES_ON && now.t_s >= memory->exact->horizon_s)
            status = NOACK_EXACT_OK;
        if (status == GOES_ON)
            status = follow_piece(memory, run, &now);
    }
    if (status == GOES_ON)
        status = NOACK_EXACT_UNDECIDED;
    double span_s = now.last_s - now.first_s, size = size_of(plant_of(now.state));
    finish_row(run->row, status, now.t_s, span_s, now.above, size);
}

/* Compute what all runs share. */
static void prepare_shared(exact_memory *memory) {
    powers(memory->H, memory->H_k);
    for (int at = 0; at < (TERMS + 1) * N * STRIDE; at += STRIDE)
        store(memory->KH_k + at, times(memory->K, load(memory->H_k + at)));
}

/* Compute a plant's tables; A is (n, n), B (n, m). */
static void prepare(exact_memory *memory, const double *A, const double *B) {
    const noack_exact_settings *exact = memory->exact;
    pad(exact->n, exact->n, A, STRIDE, memory->A);
    pad(exact->n, exact->m, B, STRIDE, memory->B);
    for (int j = 0; j < N; j++) {
        lanes BK = times(memory->B, load(memory->K + j * STRIDE));
        lanes column = add(load(memory->A + j * STRIDE), BK);
        store(memory->minus_BK + j * STRIDE, subtract(filled(0.0), BK));
        store(memory->E + j * STRIDE, subtract(column, load(memory->H + j * STRIDE)));
    }
    powers(memory->A, memory->A_k);
    driven(memory->A, memory->E, memory->H_k, memory->X_k);
    find_reaches(memory);
    memory->has_D_k = 0;
}

/* The states (count, 3, n) at ascending times from a state (3, n) on, without events in between;
   NAN where no polynomial reaches. */
static void sample(
    exact_memory *memory, const double *state, double start_s, int64_t count, const double *t_s,
    double *states) {
    int64_t n = memory->exact->n, pieces = 0, expanded = 0;
    loop_state at = state_of(state);
    double farthest_s = memory->reach_s[DEGREES - 1];
    memory->has_d = 1;
    memory->has_q = 0;
    for (int64_t i = 0; i < count; i++, states += 3 * n) {
        while (t_s[i] - start_s > farthest_s && farthest_s > 0.0 && pieces++ < MOST_PIECES) {
            if (!expanded) {
                at = renew_reference(memory, at);
                expand(memory, &at, (expansion){0, HIGHEST, 1.0});
            }
            at = state_at(memory, HIGHEST, farthest_s);
            start_s += farthest_s;
            expanded = 0;
        }
        if (!expanded) {
            at = renew_reference(memory, at);
            expand(memory, &at, (expansion){0, HIGHEST, 1.0});
        }
        expanded = 1;
        double after_s = t_s[i] - start_s;
        loop_state there = state_at(memory, HIGHEST, after_s);
        for (int j = 0; j < n; j++) {
            states[j] = after_s <= farthest_s ? entry(plant_of(there), j) : NAN;
            states[n + j] = after_s <= farthest_s ? entry(sensor_error(there), j) : NAN;
            states[2 * n + j] = after_s <= farthest_s ? entry(controller_error(there), j) : NAN;
        }
    }
}

#define JOIN(name, n) name##n
#define NAME(name, n) JOIN(name, n)
#if defined(WIDE)
const exact_code NAME(exact_wide_, N) = {N, STRIDE, prepare_shared, prepare, follow, sample};
#elif defined(FUSED)
const exact_code NAME(exact_fused_, N) = {N, STRIDE, prepare_shared, prepare, follow, sample};
#else
const exact_code NAME(exact_plain_, N) = {N, STRIDE, prepare_shared, prepare, follow, sample};
#endif
