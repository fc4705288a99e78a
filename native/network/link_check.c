/* Checks the numbers of a link once, where they enter the core: all that the other files assume. */
#include <stddef.h>

#include "../core.h"

/* With these limits no sum and no product of the other files overflows, for packets of at most
   65,535 bytes that arrive at times from 0 to FAR_NS. */
enum { MOST_EVER = 1 << 30, MOST_STAGES = 1024, MOST_BYTES = 1 << 16, MOST_CELL_HEADER = 1 << 10 };
enum { MOST_OPPORTUNITIES_PER_MS = 1 << 20, NS_PER_MS = 1000000 };
static const int64_t FAR_NS = INT64_C(1) << 61;
static const int64_t LONGEST_DELAY_NS = INT64_C(1000000000000000); /* 11.6 days, of a stage */

static int in_range(int64_t begin, int64_t end, int64_t count) {
    return 0 <= begin && begin <= end && end <= count;
}

static int is_power_of_2(int64_t number) { return number > 0 && (number & (number - 1)) == 0; }

/* Whether the numbers in [begin, end) ascend, or are equal, from first to last. */
static int ascends(
    const int64_t *numbers, int64_t begin, int64_t end, int64_t first, int64_t last) {
    for (; begin < end; begin++) {
        if (!is_between(first, numbers[begin], last))
            return 0;
        first = numbers[begin];
    }
    return 1;
}

static const char *check_bottleneck(const noack_stage *stage) {
    const noack_bottleneck *settings = &stage->bottleneck;
    if (!is_between(1, settings->rate_bps, FAR_NS))
        return "a bottleneck has no rate";
    if (!is_between(-MOST_BYTES, settings->overhead_bytes, MOST_BYTES)
        || !is_between(0, settings->cell_bytes, MOST_BYTES)
        || !is_between(0, settings->cell_overhead_bytes, MOST_CELL_HEADER))
        return "the overhead and cells of a bottleneck must be from 0 to 65,536 bytes";
    if (stage->kind == NOACK_CODEL
        && (settings->target_ns < 0 || !is_between(1, settings->interval_ns, FAR_NS / 16)))
        return "CoDel has no target or interval";
    return stage->queue_places < 1 ? "a bottleneck has no queue" : NULL;
}

static const char *check_scheduler(const noack_link *link, const noack_stage *stage) {
    const noack_bottleneck *settings = &stage->bottleneck;
    if (link->scheduler != stage - link->stages)
        return "a stage is a scheduler, but not that of the link";
    if (!is_between(1, settings->flows, link->integer_count)
        || !is_between(0, settings->begin, link->integer_count - settings->flows))
        return "the numbers of flows are outside the table of integers";
    for (int64_t i = 0; i < settings->flows; i++)
        if (!is_between(0, link->integers[settings->begin + i], LONGEST_DELAY_NS))
            return "the number of a flow is below 0, or a deadline of more than 11.6 days";
    return check_bottleneck(stage);
}

static const char *check_opportunities(const noack_link *link, const noack_stage *stage) {
    const noack_opportunities *settings = &stage->opportunities;
    if (!in_range(settings->begin, settings->end, link->integer_count)
        || settings->begin == settings->end)
        return "delivery opportunities are outside the table of integers";
    int64_t last_ms = link->integers[settings->end - 1], count = settings->end - settings->begin;
    if (last_ms < 1
        || !ascends(link->integers, settings->begin, settings->end, 0, FAR_NS / NS_PER_MS))
        return "delivery opportunities do not ascend from 0, or end at 0 or after 73 years";
    if (count / MOST_OPPORTUNITIES_PER_MS >= last_ms)
        return "there are more than a million delivery opportunities in a millisecond";
    if (!is_between(0, settings->offset_ns, FAR_NS) || !is_between(0, settings->queue_bytes, FAR_NS)
        || !is_between(-MOST_BYTES, settings->overhead_bytes, MOST_BYTES))
        return "delivery opportunities have an offset, overhead or queue out of range";
    if (stage->queue_places < 2 || stage->queue_places % 2 != 0)
        return "a queue of delivery opportunities needs two numbers for a packet";
    return NULL;
}

static const char *check_replay(const noack_link *link, const noack_replay *settings) {
    if (!in_range(settings->begin, settings->end, link->integer_count)
        || settings->begin == settings->end)
        return "a trace is outside the table of integers";
    for (int64_t i = settings->begin; i < settings->end; i++)
        if (!is_between(-1 - LONGEST_DELAY_NS, link->integers[i], LONGEST_DELAY_NS))
            return "a recorded delay is longer than 11.6 days";
    if (!is_between(0, settings->offset, FAR_NS) || !is_between(0, settings->period_ns, FAR_NS))
        return "a trace has an offset or length below 0, or of more than 73 years";
    if (settings->period_ns == 0)
        return NULL;
    int64_t count = settings->end - settings->begin, first = settings->times_begin;
    if (first < 0 || first > link->integer_count - count)
        return "sending times are outside the table of integers";
    if (link->integers[first] != 0 || !ascends(link->integers, first, first + count, 0, FAR_NS))
        return "sending times do not ascend from 0";
    return NULL;
}

static const char *check_schedule(const noack_link *link, const noack_schedule *settings) {
    int64_t flows = settings->flows, count = link->integer_count;
    if (!is_between(1, settings->slots, MOST_EVER) || !is_between(1, flows, MOST_EVER)
        || !is_between(1, settings->slot_ns, FAR_NS / 4 / settings->slots)
        || !is_between(1, settings->queue, MOST_EVER))
        return "a schedule has no slots, flows or queue, or a round of more than 18 years";
    if (!is_between(0, settings->begin, count - flows - 1)
        || !ascends(
            link->integers, settings->begin, settings->begin + flows + 1, 0, settings->slots)
        || link->integers[settings->begin] != 0
        || link->integers[settings->begin + flows] > count - settings->begin - flows - 1)
        return "the slots of a schedule are outside the table of integers";
    const int64_t *firsts = link->integers + settings->begin;
    for (int64_t i = 0, begin = settings->begin + flows + 1; i < flows; i++)
        if (!ascends(
                link->integers, begin + firsts[i], begin + firsts[i + 1], 0, settings->slots - 1))
            return "the slots of a flow do not ascend, or exceed the round";
    return NULL;
}

static const char *check_stage(const noack_link *link, const noack_stage *stage) {
    if (!is_between(0, stage->queue_places, MOST_EVER)
        || (stage->queue_places > 0
            && !is_between(0, stage->queue_begin, link->departure_places - stage->queue_places)))
        return "a stage's queue is outside the table of departures";
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
        return stage->periodic.period < 1 || stage->periodic.first < 0
                   ? "a period is below 1, or begins before the first packet"
                   : NULL;
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
            return "quantiles of a delay are outside the table of reals, or fewer than two";
        return NULL;
    case NOACK_CODEL:
    case NOACK_TAIL_DROP:
        return check_bottleneck(stage);
    case NOACK_EARLIEST_DEADLINE:
    case NOACK_MAXIMUM_ERROR:
    case NOACK_PRIORITY:
        return check_scheduler(link, stage);
    case NOACK_OPPORTUNITIES:
        return check_opportunities(link, stage);
    case NOACK_REPLAY:
        return check_replay(link, &stage->replay);
    case NOACK_SCHEDULE:
        return check_schedule(link, &stage->schedule);
    default:
        return "a stage has no kind";
    }
}

static const char *check_guarantee(const noack_link *link) {
    if (!is_between(-1, link->mansd, MOST_EVER) || !is_between(0, link->recovery, MOST_EVER)
        || !is_between(0, link->limit, MOST_EVER))
        return "the guarantee or the limit is negative, or more than 2^30";
    int64_t longest = 0;
    for (int64_t i = 0; i < link->window_count; i++) {
        const noack_window *window = &link->windows[i];
        if (!is_between(0, window->losses, MOST_EVER) || !is_between(1, window->packets, MOST_EVER))
            return "a window has no packets, or more than 2^30";
        longest = max_of(longest, window->packets);
    }
    if (!is_power_of_2(link->recent_width) || !is_power_of_2(link->loss_width))
        return "the width of a ring must be a power of 2";
    if (link->tracks && link->mansd >= 0 && link->recent_width <= link->mansd)
        return "the ring of release times is shorter than M packets";
    if (counts_losses(link)
        && link->loss_width <= max_of(longest + 1, link->mansd + link->recovery + 1))
        return "the ring of losses is shorter than the guarantee needs";
    return NULL;
}

static const char *check_lengths(const noack_link *link) {
    const int64_t lengths[] = {
        link->rows,          link->stage_count, link->departure_places,
        link->integer_count, link->real_count,  link->window_count,
        link->recent_width,  link->loss_width,  link->in_flight,
    };
    for (size_t i = 0; i < sizeof lengths / sizeof *lengths; i++)
        if (!is_between(0, lengths[i], MOST_EVER))
            return "a table has a negative length, or one of more than 2^30";
    return link->stage_count > MOST_STAGES ? "there are more than 1024 stages" : NULL;
}

const char *noack_link_check(const noack_link *link) {
    const char *wrong = check_lengths(link);
    if (wrong == NULL)
        wrong = check_guarantee(link);
    for (int64_t i = 0; wrong == NULL && i < link->stage_count; i++)
        wrong = check_stage(link, &link->stages[i]);
    if (wrong == NULL && link->scheduler >= 0
        && (link->scheduler >= link->stage_count || !is_scheduler(&link->stages[link->scheduler])))
        wrong = "the scheduler of the link is not a stage that chooses";
    return wrong;
}
