/* The trigger: from each event a rule makes the condition of the next one, which measurements test.

   Between two measurements the rate of Girard's dynamic variable is as it was at the first; the
   integral of |P z| is formed by the trapezoidal rule. */
#include <math.h>
#include <stdlib.h>

#include "loop.h"

enum { HALVINGS = 80 };
static const double LARGEST_EXPONENT = 700.0;

/* z = (x, e_s); without e_s, (x, 0). */
static void set_z(int64_t n, const double *x, const double *e_s, double *z) {
    copy(n, x, z);
    for (int64_t k = 0; k < n; k++)
        z[n + k] = e_s == NULL ? 0.0 : e_s[k];
}

/* Whether the error may have reached the threshold tau_s after an event at t_s, which counts from
   t_0. */
static int is_reached(const noack_trigger_rule *rule, double norm, double t_s, double tau_s) {
    double speed = rule->mismatch_per_s * norm + rule->disturbance_per_s;
    double exponent = rule->growth_per_s * tau_s;
    if (LARGEST_EXPONENT < exponent)
        exponent = LARGEST_EXPONENT;
    /* The first two terms of the series where the third is below rounding. */
    double growth_s = tau_s * (1 + exponent / 2);
    if (exponent > 1e-8)
        growth_s = noack_expm1(exponent) / rule->growth_per_s;
    double threshold = rule->beta * fixed_exp(-rule->alpha_per_s * (t_s + tau_s));
    return speed * growth_s
           >= (rule->forecast_floor > threshold ? rule->forecast_floor : threshold);
}

double noack_forecast_ns(const noack_trigger_rule *rule, double norm, double t_s) {
    double shortest_ns = (double)rule->shortest_ns, longest_ns = (double)rule->longest_ns;
    double low_s = shortest_ns * 1e-9, high_s = longest_ns * 1e-9;
    if (is_reached(rule, norm, t_s, low_s))
        return shortest_ns;
    if (!is_reached(rule, norm, t_s, high_s))
        return longest_ns;
    /* The error grows and the threshold does not, so there is one crossing. */
    for (int k = 0; k < HALVINGS && floor(low_s * 1e9) != floor(high_s * 1e9); k++) {
        double middle_s = (low_s + high_s) / 2;
        if (is_reached(rule, norm, t_s, middle_s))
            high_s = middle_s;
        else
            low_s = middle_s;
    }
    return floor(low_s * 1e9);
}

void noack_trigger_condition(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x) {
    int64_t n = rule->n;
    double *z = rule->scratch, *image = z + 2 * n;
    state->level = rule->level;
    state->since_ns = rule->since_ns;
    if (rule->from_event) {
        set_z(n, x, NULL, z);
        state->level = image_norm(rule->positive_rows, 2 * n, rule->positive, z, image);
        state->since_ns = t_ns;
    }
    state->earliest_ns = t_ns + rule->idle_ns;
    state->latest_ns = t_ns + rule->longest_ns;
    if (rule->forecasts) {
        const double *weight = rule->forecast_weight;
        double norm = weight == NULL ? noack_norm(n, x) : image_norm(n, n, weight, x, image);
        state->latest_ns =
            t_ns + (int64_t)noack_forecast_ns(rule, norm, (double)(t_ns - rule->since_ns) * 1e-9);
    }
}

/* The rate of the auxiliary variable at z. */
static double rate_at(const noack_trigger_rule *rule, int64_t n, const double *z, double *image) {
    if (rule->integrates)
        return image_norm(rule->positive_rows, 2 * n, rule->positive, z, image);
    if (!rule->is_dynamic)
        return 0.0;
    double positive = image_norm(rule->positive_gain_rows, 2 * n, rule->positive_gain, z, image);
    double negative = image_norm(rule->negative_gain_rows, 2 * n, rule->negative_gain, z, image);
    return positive * positive - negative * negative;
}

/* The auxiliary variable after a time, from its rates at the first and the last time. */
static double auxiliary_after(
    const noack_trigger_rule *rule, double dt_s, double value, double first, double last) {
    if (rule->integrates)
        return value + dt_s * (first + last) / 2;
    double decay = rule->decay_per_s;
    double gained_s = decay > 0.0 ? -noack_expm1(-decay * dt_s) / decay : dt_s;
    return value * fixed_exp(-decay * dt_s) + gained_s * first;
}

void noack_trigger_restart(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x) {
    noack_trigger_condition(rule, state, t_ns, x);
    state->event_ns = t_ns;
    if (rule->integrates)
        state->auxiliary = state->rate = 0.0;
}

void noack_trigger_start(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x) {
    double *z = rule->scratch;
    noack_trigger_restart(rule, state, t_ns, x);
    state->measured_ns = t_ns;
    set_z(rule->n, x, NULL, z);
    state->rate = rate_at(rule, rule->n, z, z + 2 * rule->n);
}

/* Both sides of the comparison; without an integral, as square roots. */
static void compare(
    const noack_trigger_rule *rule, const noack_trigger_state *state, int64_t n, int64_t t_ns,
    const double *z, double sides[2], double *image) {
    double right = state->level, auxiliary = state->auxiliary;
    if (rule->rate_per_s != 0.0)
        right *= fixed_exp(-rule->rate_per_s * (double)(t_ns - state->since_ns) * 1e-9);
    if (rule->floor > right)
        right = rule->floor;
    sides[0] = auxiliary;
    sides[1] = right;
    if (rule->integrates)
        return;
    int has_auxiliary = rule->is_dynamic && auxiliary > 0.0;
    if (rule->negative_rows > 0 || has_auxiliary) {
        double negative = image_norm(rule->negative_rows, 2 * n, rule->negative, z, image);
        double parts[3] = {right, negative, has_auxiliary ? sqrt(auxiliary) : 0.0};
        sides[1] = noack_norm(3, parts);
    }
    sides[0] = image_norm(rule->positive_rows, 2 * n, rule->positive, z, image);
}

int64_t noack_trigger_test(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x,
    const double *e_s, double sides[2]) {
    int64_t n = rule->n;
    double *z = rule->scratch, *image = z + 2 * n;
    set_z(n, x, e_s, z);
    if (rule->integrates || rule->is_dynamic) {
        double rate = rate_at(rule, n, z, image);
        double dt_s = (double)(t_ns - state->measured_ns) * 1e-9;
        state->auxiliary = auxiliary_after(rule, dt_s, state->auxiliary, state->rate, rate);
        state->rate = rate;
    }
    state->measured_ns = t_ns;
    compare(rule, state, n, t_ns, z, sides, image);
    if (t_ns >= state->latest_ns)
        return 1;
    int counts = t_ns >= state->earliest_ns && (rule->grid_ns == 0 || t_ns % rule->grid_ns == 0);
    return counts && sides[0] > sides[1];
}

/* How it is made. ------------------------------------------------------------------------------ */

static const char *check(const noack_trigger_rule *rule) {
    const int64_t rows[] = {
        rule->positive_rows, rule->negative_rows, rule->positive_gain_rows,
        rule->negative_gain_rows};
    double *const matrices[] = {
        rule->positive, rule->negative, rule->positive_gain, rule->negative_gain};
    if (!is_between(1, rule->n, NOACK_MAX_ENTRIES))
        return "a trigger rule needs 1 to 64 states";
    for (int k = 0; k < 4; k++)
        if (!is_between(0, rows[k], 4 * NOACK_MAX_ENTRIES) || (rows[k] > 0 && matrices[k] == NULL))
            return "a trigger rule has no matrix";
    if (!is_between(0, rule->since_ns, MOST_NS) || !is_between(0, rule->grid_ns, MOST_NS)
        || !is_between(-MOST_NS, rule->idle_ns, MOST_NS)
        || !is_between(0, rule->shortest_ns, MOST_NS) || !is_between(0, rule->longest_ns, MOST_NS))
        return "a trigger rule has times out of range";
    return NULL;
}

noack_trigger_rule *noack_trigger_rule_new(const noack_trigger_rule *settings, const char **wrong) {
    noack_trigger_rule rule = *settings;
    if ((*wrong = check(&rule)) != NULL)
        return NULL;
    int64_t n = rule.n;
    int64_t longest = max_of(
        max_of(rule.positive_rows, rule.negative_rows),
        max_of(rule.positive_gain_rows, rule.negative_gain_rows));
    rule.scratch = NULL;
    owned_array arrays[] = {
        {&rule.positive, rule.positive_rows * 2 * n, OPTIONAL},
        {&rule.negative, rule.negative_rows * 2 * n, OPTIONAL},
        {&rule.positive_gain, rule.positive_gain_rows * 2 * n, OPTIONAL},
        {&rule.negative_gain, rule.negative_gain_rows * 2 * n, OPTIONAL},
        {&rule.weight, n * n, OPTIONAL},
        {&rule.forecast_weight, n * n, OPTIONAL},
        {&rule.scratch, 3 * n + longest, STATE},
    };
    return with_arrays(&rule, sizeof rule, arrays, 7, NULL, wrong);
}

void noack_trigger_rule_free(noack_trigger_rule *rule) { free(rule); }
