/* Exact simulation in continuous time: what Python calls. states.c follows a run from event to
   event; the event is located in norm_crossing.h, quadratic_crossing.h, integral_crossing.h and
   level_crossing.c, by the rule's comparison.

   A size of vectors that has code serves all smaller loops, which are padded with states that stay
   0; the last bits of a loop do not depend on the size chosen. */
#include "exact.h"

#include <stdlib.h>

enum { MOST_FATES = 1 << 30 };

#if defined(__x86_64__)
#include <cpuid.h>

static int instructions; /* of the processor: see noack_exact_instructions() */

/* When the library is loaded: ask the processor, and whether the kernel keeps the wide registers.
   With ziglang, __builtin_cpu_supports() answers no to everything. */
__attribute__((constructor)) static void ask_processor(void) {
    const unsigned wide = bit_AVX512F | bit_AVX512VL | bit_AVX512DQ;
    unsigned a, b, c, d, kept, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_FMA) || !(c & bit_OSXSAVE))
        return;
    __asm__("xgetbv" : "=a"(kept), "=d"(high) : "c"(0));
    /* The kernel keeps the registers of AVX2 (bits 1, 2), of AVX-512 too (bits 5 to 7). */
    if ((kept & 6) != 6 || !__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & bit_AVX2))
        return;
    instructions = (kept & 0xe6) == 0xe6 && (b & wide) == wide ? 2 : 1;
}

static const exact_code *const code_avx512[] = {
    &exact_fused_3, &exact_wide_4, &exact_wide_8, &exact_fused_16, &exact_fused_64};
static const exact_code *const code_avx2[] = {
    &exact_fused_3, &exact_fused_4, &exact_fused_8, &exact_fused_16, &exact_fused_64};
static const exact_code *const code_plain[] = {&exact_plain_3, &exact_plain_4, &exact_plain_64};
static const exact_code *const *const code_by_instructions[] = {code_plain, code_avx2, code_avx512};
#else
enum { instructions = 0 };
static const exact_code *const code_plain[] = {
    &exact_plain_3, &exact_plain_4, &exact_plain_8, &exact_plain_16, &exact_plain_64};
static const exact_code *const *const code_by_instructions[] = {code_plain};
#endif

int64_t noack_exact_instructions(void) { return instructions; }

/* The code for the fewest states that suffice. That for 3 sums in another order than the others. */
static const exact_code *code_for(const noack_exact_settings *exact) {
    const exact_code *const *code = code_by_instructions[instructions];
    int64_t entries = max_of(exact->n, exact->m);
    while ((*code)->n < entries || ((*code)->n == 3 && entries != 3))
        code++;
    return *code;
}

void pad(int64_t rows, int64_t columns, const double *matrix, int64_t stride, double *result) {
    for (int64_t j = 0; j < columns; j++, result += stride)
        for (int64_t i = 0; i < stride; i++)
            result[i] = i < rows ? matrix[i * columns + j] : 0.0;
}

int arrives(const noack_exact_settings *exact, exact_run *run) {
    noack_decision decision;
    int delivered = 1;
    if (exact->link != NULL) {
        noack_link_decide(exact->link, 0, 1, 0, &decision);
        delivered = decision.fate == NOACK_DELIVERED || decision.fate == NOACK_FORCED;
        run->losses = decision.consecutive_losses;
    } else {
        if (run->row->transmissions < exact->fate_count)
            delivered = exact->fates[run->row->transmissions] != 0;
        run->losses = delivered ? 0 : run->losses + 1;
    }
    run->row->longest_loss_burst = max_of(run->row->longest_loss_burst, run->losses);
    return delivered;
}

static int64_t blocks_of(const noack_trigger_rule *rule, const exact_code *code) {
    int64_t rows = max_of(
        rule->positive_rows + rule->negative_rows,
        rule->positive_gain_rows + rule->negative_gain_rows);
    return max_of(2, (rows + code->n - 1) / code->n);
}

/* Whether the rule compares |W e_s|, or its integral. */
static int is_plain(const noack_exact_settings *exact) {
    const noack_trigger_rule *rule = exact->rule;
    int64_t n = exact->n;
    if (rule->positive_rows != n || rule->negative_rows != 0)
        return 0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++) {
            double weight = rule->weight == NULL ? i == j : rule->weight[i * n + j];
            if (rule->positive[i * 2 * n + j] != 0.0 || rule->positive[i * 2 * n + n + j] != weight)
                return 0;
        }
    return 1;
}

static int is_quadratic(const noack_exact_settings *exact) {
    const noack_trigger_rule *rule = exact->rule;
    return rule->positive_rows > 0
           && (!is_plain(exact) || rule->is_dynamic || rule->from_event || rule->grid_ns > 0);
}

static int is_finite_nonnegative(double number) { return number >= 0.0 && number < INFINITY; }

static const char *check_exact_rule(const noack_exact_settings *exact) {
    const noack_trigger_rule *rule = exact->rule;
    if (rule == NULL || rule->n != exact->n)
        return "a simulation has no rule of its size";
    if (!is_finite_nonnegative(rule->level) || !is_finite_nonnegative(rule->rate_per_s)
        || !is_finite_nonnegative(rule->floor) || !is_finite_nonnegative(rule->decay_per_s))
        return "a trigger rule has a threshold or a rate below 0";
    if (rule->longest_ns < rule->shortest_ns)
        return "a trigger rule has times out of range";
    if (rule->integrates && (is_quadratic(exact) || rule->is_dynamic))
        return "a trigger rule may integrate the norm of W e_s only, and not on a grid";
    return NULL;
}

/* All that the other files assume. */
static const char *check(const noack_exact_settings *exact) {
    if (!is_between(1, exact->n, NOACK_EXACT_ENTRIES)
        || !is_between(1, exact->m, NOACK_EXACT_ENTRIES))
        return "a loop needs 1 to 64 states and 1 to 64 inputs";
    if (exact->H == NULL || exact->K == NULL)
        return "a simulation has no matrix";
    if (!is_finite_nonnegative(exact->horizon_s) || !is_finite_nonnegative(exact->settle)
        || !is_finite_nonnegative(exact->fading_per_s))
        return "a simulation has a time, a share or a rate below 0";
    if (!is_between(0, exact->most_events, INT64_MAX)
        || !is_between(NOACK_EXACT_ROW, exact->measure, NOACK_EXACT_TIMES))
        return "a simulation has an unknown measure, or a negative number of events";
    if (exact->link == NULL) {
        if (!is_between(0, exact->fate_count, MOST_FATES)
            || (exact->fate_count > 0 && exact->fates == NULL))
            return "a simulation has no packet fates";
    } else if (exact->link->rows < 1)
        return "a simulation has no link";
    return check_exact_rule(exact);
}

typedef struct { /* the free part of the scratch, which is 0 */
    double *next;
    const exact_code *code; /* whose sizes the matrices get */
} free_scratch;

static double *take(free_scratch *scratch, int64_t count) {
    double *numbers = scratch->next;
    scratch->next += count;
    return numbers;
}

/* Take a matrix, or NULL for NULL. */
static double *take_square(free_scratch *scratch, int64_t n, const double *matrix) {
    if (matrix == NULL)
        return NULL;
    int64_t stride = scratch->code->stride;
    double *padded = take(scratch, scratch->code->n * stride);
    pad(n, n, matrix, stride, padded);
    return padded;
}

typedef struct { /* P and N of a rule's form, (rows, 2n) */
    int64_t positive_rows, negative_rows;
    const double *positive, *negative;
} rule_form;

static block_form take_form(
    free_scratch *scratch, int64_t blocks, int64_t n, const rule_form *form) {
    int64_t size = scratch->code->n, stride = scratch->code->stride, square = size * stride;
    block_form taken;
    taken.rows = take(scratch, blocks * 2 * square);
    taken.signs = take(scratch, blocks * stride);
    for (int64_t row = 0; row < form->positive_rows + form->negative_rows; row++) {
        int64_t block = row / size, at = row % size, is_positive = row < form->positive_rows;
        const double *from = is_positive ? form->positive + row * 2 * n
                                         : form->negative + (row - form->positive_rows) * 2 * n;
        taken.signs[block * stride + at] = is_positive ? 1.0 : -1.0;
        for (int64_t j = 0; j < n; j++) {
            taken.rows[2 * block * square + j * stride + at] = from[j];
            taken.rows[(2 * block + 1) * square + j * stride + at] = from[n + j];
        }
    }
    return taken;
}

/* Doubles that a simulation needs. */
static int64_t scratch_length(const noack_trigger_rule *rule, const exact_code *code) {
    int64_t square = code->n * code->stride, curve = TERMS * code->stride;
    return (5 * (TERMS + 1) + 10) * square + 8 * curve
           + 2 * blocks_of(rule, code) * (2 * square + code->stride + curve);
}

/* Lay a simulation's memory out in the scratch, and copy the settings to it. */
static void lay_out(
    const noack_exact_settings *exact, const exact_code *code, double *begin,
    exact_memory *memory) {
    const noack_trigger_rule *rule = exact->rule;
    int64_t square = code->n * code->stride, n = exact->n, curve = TERMS * code->stride;
    int64_t blocks = blocks_of(rule, code);
    free_scratch scratch = {begin, code};
    memory->exact = exact;
    memory->rule = rule;
    memory->blocks = blocks;
    memory->quadratic = is_quadratic(exact);
    memory->integrates = rule->integrates != 0;
    memory->dynamic = memory->quadratic && rule->is_dynamic;
    memory->grid_s = (double)rule->grid_ns * 1e-9;
    memory->H = take_square(&scratch, n, exact->H);
    memory->K = take(&scratch, square);
    pad(exact->m, n, exact->K, code->stride, memory->K);
    memory->weight = take_square(&scratch, n, rule->weight);
    memory->forecast_weight = take_square(&scratch, n, rule->forecast_weight);
    memory->Q = take_square(&scratch, n, exact->Q);
    memory->R = take_square(&scratch, exact->m, exact->R);
    memory->A = take(&scratch, square);
    memory->B = take(&scratch, square);
    memory->E = take(&scratch, square);
    memory->minus_BK = take(&scratch, square);
    memory->D_k = take(&scratch, (TERMS + 1) * square);
    memory->H_k = take(&scratch, (TERMS + 1) * square);
    memory->KH_k = take(&scratch, (TERMS + 1) * square);
    memory->A_k = take(&scratch, (TERMS + 1) * square);
    memory->X_k = take(&scratch, (TERMS + 1) * square);
    double **curves[] = {&memory->r, &memory->e, &memory->d,         &memory->q,
                         &memory->x, &memory->u, &memory->own_error, &memory->own_weighted};
    for (int i = 0; i < 8; i++)
        *curves[i] = take(&scratch, curve);
    memory->weighted = rule->weight == NULL ? memory->e : memory->own_weighted;
    memory->is_static = 1;
    for (int64_t i = 0; i < n * n; i++)
        memory->is_static &= exact->H[i] == 0.0;
    if (memory->quadratic) {
        rule_form form = {rule->positive_rows, rule->negative_rows, rule->positive, rule->negative};
        rule_form gain = {
            rule->positive_gain_rows, rule->negative_gain_rows, rule->positive_gain,
            rule->negative_gain};
        memory->form = take_form(&scratch, blocks, n, &form);
        memory->y = take(&scratch, blocks * curve);
        memory->gain = take_form(&scratch, blocks, n, &gain);
        memory->w = take(&scratch, blocks * curve);
    }
    code->prepare_shared(memory);
}

struct noack_exact {
    noack_exact_settings settings;
    const exact_code *code;
    exact_memory memory;
    void *scratch;
    uint8_t *fates;
};

noack_exact *noack_exact_new(const noack_exact_settings *settings, const char **wrong) {
    noack_exact *exact = NULL;
    if ((*wrong = check(settings)) == NULL)
        exact = zeros(1, sizeof *exact);
    if (exact == NULL)
        return NULL;
    exact->settings = *settings;
    exact->code = code_for(settings);
    exact->fates = copy_of(settings->fates, settings->fate_count, sizeof *exact->fates);
    double *begin =
        zeros_in_lines(scratch_length(settings->rule, exact->code), sizeof *begin, &exact->scratch);
    if (exact->fates == NULL || begin == NULL) {
        noack_exact_free(exact);
        return NULL;
    }
    exact->settings.fates = exact->fates;
    lay_out(&exact->settings, exact->code, begin, &exact->memory);
    return exact;
}

void noack_exact_free(noack_exact *exact) {
    if (exact == NULL)
        return;
    free(exact->scratch);
    free(exact->fates);
    free(exact);
}

/* Copy a state (3, n) to a padded one. */
static void pack(int64_t n, int64_t stride, const double *state, double *padded) {
    memset(padded, 0, 3 * (size_t)stride * sizeof *padded);
    for (int64_t i = 0; i < 3; i++)
        memcpy(padded + i * stride, state + i * n, (size_t)n * sizeof *state);
}

void noack_exact_runs(
    noack_exact *simulation, int64_t runs, const double *A, const double *B, const double *x0,
    const int64_t *keys, noack_exact_row *rows, const noack_exact_log *events) {
    const noack_exact_settings *exact = &simulation->settings;
    const exact_code *code = simulation->code;
    exact_memory *memory = &simulation->memory;
    int64_t n = exact->n, m = exact->m, stages = exact->link == NULL ? 0 : exact->link->stage_count;
    double state[3 * NOACK_EXACT_ENTRIES];
    for (int64_t number = 0; number < runs; number++) {
        exact_run run = {.row = rows + number, .number = number, .events = events, .state = state};
        *run.row = (noack_exact_row){.inter_event_min_s = INFINITY};
        if (exact->link != NULL)
            noack_link_renew(exact->link, keys + number * stages * 2, exact->first_delivered);
        code->prepare(memory, A + number * n * n, B + number * n * m);
        memset(state, 0, sizeof state);
        for (int64_t i = 0; i < n; i++) {
            state[i] = x0[number * n + i];
            state[2 * code->stride + i] = exact->known_start ? 0.0 : 0.0 - state[i];
        }
        run.event = !exact->known_start;
        run.auxiliary = memory->dynamic ? exact->rule->initial : 0.0;
        code->follow(memory, &run);
    }
}

void noack_exact_sample(
    noack_exact *simulation, const double *A, const double *B, const noack_exact_states *starts,
    noack_exact_states *samples) {
    const noack_exact_settings *exact = &simulation->settings;
    const exact_code *code = simulation->code;
    exact_memory *memory = &simulation->memory;
    int64_t size = 3 * exact->n, sampled = 0;
    code->prepare(memory, A, B);
    for (int64_t start = 0; start < starts->count; start++) {
        double state[3 * NOACK_EXACT_ENTRIES];
        int is_last = start + 1 == starts->count;
        int64_t end = sampled;
        while (end < samples->count && (is_last || samples->t_s[end] < starts->t_s[start + 1]))
            end++;
        pack(exact->n, code->stride, starts->states + size * start, state);
        code->sample(
            memory, state, starts->t_s[start], end - sampled, samples->t_s + sampled,
            samples->states + size * sampled);
        sampled = end;
    }
}
