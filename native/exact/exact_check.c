/* Checks the numbers of an exact simulation once, where they enter the core: all that the other
   files assume. */
#include "exact.h"

static const int64_t NEVER_NS = INT64_C(1) << 62; /* longer times never end */
enum { MOST_FATES = 1 << 30 };

static int is_positive(double number) { return number >= 0.0 && number < INFINITY; }

static const char *check_exact_rule(const noack_exact *exact) {
    const noack_trigger_rule *rule = &exact->rule;
    const char *wrong = check_rule(rule, NEVER_NS);
    if (wrong != NULL)
        return wrong;
    if (!is_positive(rule->level) || !is_positive(rule->rate_per_s) || !is_positive(rule->floor)
        || !is_positive(rule->decay_per_s))
        return "a trigger rule has a threshold or a rate below 0";
    if (rule->longest_ns < rule->shortest_ns)
        return "a trigger rule has times out of range";
    if (rule->integrates && (is_quadratic(exact) || rule->is_dynamic))
        return "a trigger rule integrates another norm than that of W e_s, or on a grid";
    return NULL;
}

const char *noack_exact_check(const noack_exact *exact) {
    if (!is_between(1, exact->n, NOACK_EXACT_ENTRIES)
        || !is_between(1, exact->m, NOACK_EXACT_ENTRIES))
        return "a loop has no state or input, or more than 64";
    if (exact->H == NULL || exact->K == NULL || exact->scratch == NULL)
        return "a simulation has no matrix or no memory";
    if (!is_positive(exact->horizon_s) || !is_positive(exact->settle)
        || !is_positive(exact->fading_per_s) || !(exact->fading_until_s >= 0.0))
        return "a simulation has a time, a share or a rate below 0";
    if (!is_between(0, exact->most_events, INT64_MAX)
        || !is_between(NOACK_EXACT_ROW, exact->measure, NOACK_EXACT_TIMES))
        return "a simulation has an unknown measure, or less than 0 events";
    if (!is_between(0, exact->event_places, MOST_FATES)
        || (exact->event_places > 0 && (exact->event_s == NULL || exact->delivered == NULL)))
        return "a simulation has no room for its events";
    if (exact->link == NULL) {
        if (!is_between(0, exact->fate_count, MOST_FATES)
            || (exact->fate_count > 0 && exact->fates == NULL))
            return "a simulation has no fates";
    } else if (noack_link_check(exact->link) != NULL || exact->link->rows < 1)
        return "a simulation has no link";
    return check_exact_rule(exact);
}
