/* The times at which a trigger rule's comparison counts, and its threshold.

   Times are in integer nanoseconds as in the rule, so that an event at the horizon is the same
   everywhere. */
#include "exact.h"

static const double GRID_SLACK = 1e-9; /* rounding of an event's time on the grid, of a period */
static const double NS = 1e-9, PER_S = 1e9;

static int64_t whole(double number) { /* defined for all numbers */
    return number >= 9e18 ? INT64_MAX / 2 : number > -9e18 ? (int64_t)number : -INT64_MAX / 2;
}

/* size is |x|_W, for forecasts; left is |P z|, for thresholds that begin at an event. */
rule_span span_after(const exact_memory *memory, double t_s, double left, double size) {
    const noack_trigger_rule *rule = memory->rule;
    double due_ns = rule->longest_ns >= NEVER_NS ? INFINITY : (double)rule->longest_ns;
    double idle_ns = rule->idle_ns > 0 ? (double)rule->idle_ns : -INFINITY;
    rule_span span = {0.0, rule->level, -INFINITY, 0.0, 0.0, 0};
    if (rule->from_event) {
        span.level = left;
        span.since_s = t_s;
    }
    if (rule->forecasts)
        due_ns = noack_forecast_ns(rule, size, t_s);
    if (span.level > rule->floor) {
        span.floor_from_s = INFINITY;
        if (rule->floor > 0.0 && rule->rate_per_s > 0.0)
            span.floor_from_s =
                span.since_s + noack_log(span.level / rule->floor) / rule->rate_per_s;
    }
    span.due_s = (t_s * PER_S + due_ns) * NS;
    span.begin_s = least((t_s * PER_S + idle_ns) * NS, span.due_s);
    if (memory->grid_s > 0.0) {
        span.point = last_point(memory->grid_s, t_s) + 1;
        if (span.begin_s > t_s)
            span.point =
                max_of(span.point, whole(ceil(span.begin_s / memory->grid_s - GRID_SLACK)));
    }
    return span;
}

rule_phase phase_at(const exact_memory *memory, const rule_span *span, double t_s) {
    const noack_trigger_rule *rule = memory->rule;
    if (t_s < span->begin_s)
        return (rule_phase){span->begin_s, 0, 0.0, 0.0};
    if (rule->positive_rows == 0)
        return (rule_phase){span->due_s, 0, 0.0, 0.0};
    if (t_s < span->floor_from_s) {
        double threshold = span->level * fixed_exp(-rule->rate_per_s * (t_s - span->since_s));
        double until_s = least(span->due_s, span->floor_from_s);
        return (rule_phase){until_s, 1, threshold, rule->rate_per_s};
    }
    return (rule_phase){span->due_s, 1, rule->floor, 0.0};
}

/* The threshold s seconds after the start of a phase. */
double threshold_after(const rule_phase *phase, double s) {
    return phase->rate_per_s > 0.0 ? phase->threshold * fixed_exp(-phase->rate_per_s * s)
                                   : phase->threshold;
}

/* The last grid point up to a time. */
int64_t last_point(double grid_s, double t_s) { return whole(floor(t_s / grid_s + GRID_SLACK)); }
