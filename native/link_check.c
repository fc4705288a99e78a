/* Checks the numbers of a link once, where they enter the core: all that the other files assume. */
#include <stddef.h>

#include "core.h"

enum { MOST_EVER = 1 << 30 };
static const int64_t FAR_NS = INT64_C(1) << 61;

static int in_range(int64_t begin, int64_t end, int64_t count) {
    return 0 <= begin && begin <= end && end <= count;
}

static int is_power_of_2(int64_t number) { return number > 0 && (number & (number - 1)) == 0; }

static const char *check_queue(const noack_link *link, const noack_stage *stage) {
    if (stage->queue_places <= 0 || stage->queue_places > MOST_EVER)
        return "a stage's queue has no places";
    if (!in_range(stage->queue_begin, stage->queue_begin + stage->queue_places,
                  link->departure_places))
        return "a stage's queue is outside the table of departures";
    return NULL;
}

static const char *check_bottleneck(const noack_link *link, const noack_stage *stage) {
    const noack_bottleneck *own = &stage->bottleneck;
    if (own->rate_bps < 1 || own->cell_bytes < 0 || own->cell_overhead_bytes < 0)
        return "a bottleneck has no rate, or negative cells";
    if (stage->kind == NOACK_CODEL
        && (own->target_ns < 0 || own->interval_ns < 1 || own->interval_ns > FAR_NS / 16))
        return "CoDel has no target or interval";
    return check_queue(link, stage);
}

static const char *check_opportunities(const noack_link *link, const noack_stage *stage) {
    const noack_opportunities *own = &stage->opportunities;
    if (!in_range(own->begin, own->end, link->integer_count) || own->begin == own->end
        || link->integers[own->end - 1] < 1)
        return "delivery opportunities are outside the table of integers, or end at 0";
    if (stage->queue_places % 2 != 0)
        return "a queue of delivery opportunities needs two numbers for a packet";
    return check_queue(link, stage);
}

static const char *check_replay(const noack_link *link, const noack_replay *own) {
    int64_t count = own->end - own->begin;
    if (!in_range(own->begin, own->end, link->integer_count) || count < 1
        || !in_range(own->times_begin, own->times_begin + count, link->integer_count))
        return "a trace is outside the table of integers";
    if (own->offset < 0 || own->period_ns < 0)
        return "a trace has a negative offset or length";
    return NULL;
}

static const char *check_stage(const noack_link *link, const noack_stage *stage) {
    switch (stage->kind) {
    case NOACK_BERNOULLI:
    case NOACK_CORRUPT:
    case NOACK_DUPLICATE:
    case NOACK_REORDER:
        return stage->chance.gap < 1 ? "a gap is below 1" : NULL;
    case NOACK_FOUR_STATE:
    case NOACK_WORST_CASE:
        return NULL;
    case NOACK_GILBERT_ELLIOTT:
        return stage->gilbert_elliott.step_ns < 0 ? "a step is below 0" : NULL;
    case NOACK_PERIODIC:
        return stage->periodic.period < 1 ? "a period is below 1" : NULL;
    case NOACK_SCRIPTED:
        return in_range(stage->scripted.begin, stage->scripted.end, link->integer_count)
                   ? NULL
                   : "a script is outside the table of integers";
    case NOACK_BLACKOUT:
        return in_range(stage->blackout.begin, stage->blackout.end, link->integer_count)
                       && (stage->blackout.end - stage->blackout.begin) % 2 == 0
                   ? NULL
                   : "intervals are outside the table of integers";
    case NOACK_DELAY:
        if (stage->delay.shape < NOACK_UNIFORM || stage->delay.shape > NOACK_EMPIRICAL)
            return "a delay has no shape";
        if (stage->delay.shape == NOACK_EMPIRICAL
            && (!in_range(stage->delay.begin, stage->delay.end, link->real_count)
                || stage->delay.end - stage->delay.begin < 2))
            return "quantiles of a delay are outside the table of reals, or less than two";
        return NULL;
    case NOACK_CODEL:
    case NOACK_TAIL_DROP:
        return check_bottleneck(link, stage);
    case NOACK_OPPORTUNITIES:
        return check_opportunities(link, stage);
    case NOACK_REPLAY:
        return check_replay(link, &stage->replay);
    default:
        return "a stage has no kind";
    }
}

const char *noack_recorded_check(const noack_link *link) {
    for (int64_t i = 0; i < link->recorded_flows; i++)
        if (!in_range(
                link->decisions_begin[i], link->decisions_begin[i + 1], link->decision_count))
            return "recorded decisions are outside their table";
    for (int64_t i = 0; i < link->decision_count; i++) {
        const noack_recorded *one = &link->decisions[i];
        if (one->fate < NOACK_DELIVERED || one->fate > NOACK_BLACKED_OUT)
            return "a recorded decision has no fate";
        if (one->delay_ns > FAR_NS || one->copy_delay_ns > FAR_NS)
            return "a recorded delay is longer than 73 years";
    }
    return NULL;
}

static const char *check_guarantee(const noack_link *link) {
    if (link->mansd < -1 || link->recovery < 0 || link->limit < 0)
        return "the guarantee or the limit is negative";
    int64_t longest = 0;
    for (int64_t i = 0; i < link->window_count; i++) {
        if (link->windows[i].losses < 0 || link->windows[i].packets < 1)
            return "a window has no packets";
        longest = max_of(longest, link->windows[i].packets);
    }
    if (!is_power_of_2(link->recent_width) || !is_power_of_2(link->loss_width))
        return "the width of a ring is no power of 2";
    if (link->tracks && link->mansd >= 0 && link->recent_width <= link->mansd)
        return "the ring of release times is shorter than M packets";
    if (counts_losses(link)
        && link->loss_width <= max_of(longest + 1, link->mansd + link->recovery + 1))
        return "the ring of losses is shorter than the guarantee needs";
    return NULL;
}

const char *noack_link_check(const noack_link *link) {
    if (link->rows < 0 || link->stage_count < 0 || link->departure_places < 0
        || link->integer_count < 0 || link->real_count < 0 || link->window_count < 0
        || link->decision_count < 0 || link->recorded_flows < 0)
        return "a table has a negative length";
    const char *wrong = check_guarantee(link);
    for (int64_t i = 0; wrong == NULL && i < link->stage_count; i++)
        wrong = check_stage(link, &link->stages[i]);
    return wrong;
}
