/* Makes a link of settings, which it checks and copies: the other files assume what is checked. */
#include <stdlib.h>

#include "network.h"

/* With these limits no sum and no product of the other files overflows, for packets of at most
   65,535 bytes that arrive at times from 0 to FAR_NS. */
enum { MOST_EVER = 1 << 30, MOST_STAGES = 1024, MOST_BYTES = 1 << 16, MOST_CELL_HEADER = 1 << 10 };
enum { MOST_OPPORTUNITIES_PER_MS = 1 << 20, NS_PER_MS = 1000000 };
static const int64_t FAR_NS = INT64_C(1) << 61;
static const int64_t LONGEST_DELAY_NS = INT64_C(1000000000000000); /* 11.6 days, of a stage */

static int in_range(int64_t begin, int64_t end, int64_t count) {
    return 0 <= begin && begin <= end && end <= count;
}

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
    if (!is_between(0, settings->queue_bytes, FAR_NS)
        || !is_between(0, settings->burst_bytes, FAR_NS)
        || !is_between(0, settings->burst_ns, FAR_NS)
        || !is_between(0, settings->burst_carry, settings->rate_bps - 1))
        return "a bottleneck has a queue or a burst out of range";
    if (is_scheduler(stage) && (settings->burst_bytes != 0 || settings->burst_ns != 0))
        return "a queue that chooses what it sends has a burst";
    if (stage->kind == NOACK_CODEL
        && (settings->target_ns < 0 || !is_between(1, settings->interval_ns, FAR_NS / 16)))
        return "CoDel has no target or interval";
    return stage->queue_places < 1 ? "a bottleneck has no queue" : NULL;
}

static const char *check_scheduler(const noack_link_settings *link, const noack_stage *stage) {
    const noack_bottleneck *settings = &stage->bottleneck;
    if (!is_between(1, settings->flows, link->integer_count)
        || !is_between(0, settings->begin, link->integer_count - settings->flows))
        return "the numbers of flows are outside the table of integers";
    for (int64_t i = 0; i < settings->flows; i++)
        if (!is_between(0, link->integers[settings->begin + i], LONGEST_DELAY_NS))
            return "the number of a flow is below 0, or a deadline of more than 11.6 days";
    return check_bottleneck(stage);
}

static const char *check_opportunities(const noack_link_settings *link, const noack_stage *stage) {
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
    return stage->queue_places < 1 ? "delivery opportunities have no queue" : NULL;
}

static const char *check_replay(const noack_link_settings *link, const noack_replay *settings) {
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

static const char *check_schedule(const noack_link_settings *link, const noack_schedule *settings) {
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

static const char *check_stage(const noack_link_settings *link, const noack_stage *stage) {
    if (!is_between(0, stage->queue_places, MOST_EVER))
        return "a stage's queue is longer than 2^30";
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

static const char *check(const noack_link_settings *link) {
    const int64_t lengths[] = {
        link->rows,     link->stage_count,  link->integer_count, link->real_count,
        link->recovery, link->window_count, link->limit,
    };
    for (size_t i = 0; i < sizeof lengths / sizeof *lengths; i++)
        if (!is_between(0, lengths[i], MOST_EVER))
            return "a length or limit is negative, or more than 2^30";
    if (!is_between(-1, link->mansd, MOST_EVER) || link->stage_count > MOST_STAGES)
        return "there are more than 1024 stages, or the guarantee is out of range";
    for (int64_t i = 0; i < link->window_count; i++) {
        const noack_window *window = &link->windows[i];
        if (!is_between(0, window->losses, MOST_EVER) || !is_between(1, window->packets, MOST_EVER))
            return "a window has no packets, or more than 2^30";
    }
    int64_t schedulers = 0, places = 0;
    for (int64_t i = 0; i < link->stage_count; i++) {
        const char *wrong = check_stage(link, &link->stages[i]);
        if (wrong != NULL)
            return wrong;
        schedulers += is_scheduler(&link->stages[i]);
        places += link->stages[i].queue_places;
    }
    if (schedulers > 1 || places > MOST_EVER)
        return "more than one stage chooses what leaves next, or queues have more than 2^30 places";
    return NULL;
}

/* The smallest power of 2 above a number. */
static int64_t power_above(int64_t number) {
    int64_t power = 1;
    while (power <= number)
        power *= 2;
    return power;
}

/* The lengths of the rings: how far back the guarantee looks. */
static void set_widths(noack_link *link) {
    int64_t longest = 0;
    for (int64_t i = 0; i < link->window_count; i++)
        longest = max_of(longest, link->windows[i].packets);
    link->recent_width = link->can_reorder && link->mansd >= 0 ? power_above(link->mansd) : 1;
    link->loss_width = counts_losses(link)
                           ? power_above(max_of(longest + 1, link->mansd + link->recovery + 1))
                           : 1;
}

/* Which stage chooses, and where each has its queue, which has been empty for ever; return the
   numbers of all rings. */
static int64_t place_queues(noack_link *link) {
    int64_t numbers = 0;
    link->scheduler = -1;
    for (int64_t i = 0; i < link->stage_count; numbers += 2 * link->stages[i++].queue_places) {
        link->stages[i].queue_begin = numbers;
        link->stage_states[i].busy_until_ns = -LATEST_NS;
        if (is_scheduler(&link->stages[i]))
            link->scheduler = i;
    }
    return numbers;
}

/* Make room for flows; return 0 if there is no memory. */
static int add_rows(noack_link *link, int64_t rows) {
    int64_t before = link->rows, stages = link->stage_count;
    if (!lengthen(&link->flows, before, rows, sizeof *link->flows)
        || !lengthen(&link->memory, before * stages, rows * stages + 1, sizeof *link->memory)
        || !lengthen(
            &link->recent_ns, before * link->recent_width, rows * link->recent_width,
            sizeof *link->recent_ns)
        || !lengthen(
            &link->losses, before * link->loss_width, rows * link->loss_width,
            sizeof *link->losses))
        return 0;
    for (int64_t i = before * link->recent_width; i < rows * link->recent_width; i++)
        link->recent_ns[i] = NOACK_NEVER_NS;
    link->rows = rows;
    return 1;
}

noack_link *noack_link_new(const noack_link_settings *settings, const char **wrong) {
    if ((*wrong = check(settings)) != NULL)
        return NULL;
    noack_link *link = zeros(1, sizeof *link);
    if (link == NULL)
        return NULL;
    link->stage_count = settings->stage_count;
    link->window_count = settings->window_count;
    link->recovery = settings->recovery;
    link->mansd = settings->mansd;
    link->limit = settings->limit;
    link->can_reorder = settings->can_reorder;
    link->stages = copy_of(settings->stages, link->stage_count, sizeof *link->stages);
    link->integers = copy_of(settings->integers, settings->integer_count, sizeof *link->integers);
    link->reals = copy_of(settings->reals, settings->real_count, sizeof *link->reals);
    link->windows = copy_of(settings->windows, link->window_count, sizeof *link->windows);
    link->stage_states = zeros(link->stage_count, sizeof *link->stage_states);
    if (link->stages != NULL && link->integers != NULL && link->reals != NULL
        && link->windows != NULL && link->stage_states != NULL) {
        set_widths(link);
        link->departures_ns = zeros(place_queues(link), sizeof *link->departures_ns);
        if (link->departures_ns != NULL && add_rows(link, max_of(settings->rows, 1)))
            return link;
    }
    noack_link_free(link);
    return NULL;
}

void noack_link_free(noack_link *link) {
    if (link == NULL)
        return;
    void *const arrays[] = {
        link->stages, link->integers,  link->reals,  link->windows,      link->flows,
        link->memory, link->recent_ns, link->losses, link->stage_states, link->departures_ns,
    };
    for (size_t i = 0; i < sizeof arrays / sizeof *arrays; i++)
        free(arrays[i]);
    free(link);
}

int64_t noack_link_start_flow(
    noack_link *link, int64_t row, int64_t number, int64_t first_delivered) {
    if (row >= link->rows && !add_rows(link, max_of(2 * link->rows, row + 1)))
        return 0;
    link->flows[row] = (noack_flow){
        .number = number,
        .forced_first = first_delivered != 0,
        .first_release_ns = NOACK_NEVER_NS,
        .newest = -1,
    };
    memset(
        link->memory + row * link->stage_count, 0,
        (size_t)link->stage_count * sizeof *link->memory);
    for (int64_t i = 0; i < link->recent_width; i++)
        link->recent_ns[row * link->recent_width + i] = NOACK_NEVER_NS;
    for (int64_t i = 0; i < link->loss_width; i++)
        link->losses[row * link->loss_width + i] = 0;
    return 1;
}

void noack_link_renew(noack_link *link, const int64_t *keys, int64_t first_delivered) {
    noack_link_start_flow(link, 0, 0, first_delivered);
    for (int64_t i = 0; i < link->stage_count; i++) {
        link->stages[i].key0 = keys[2 * i];
        link->stages[i].key1 = keys[2 * i + 1];
    }
}

noack_flow *noack_link_flows(const noack_link *link) { return link->flows; }
const noack_stage *noack_link_stages(const noack_link *link) { return link->stages; }
const double *noack_link_reals(const noack_link *link) { return link->reals; }
const noack_counters *noack_link_counters(const noack_link *link) { return &link->counters; }
int64_t noack_link_rows(const noack_link *link) { return link->rows; }
int64_t noack_link_can_reorder(const noack_link *link) { return link->can_reorder; }
int64_t noack_link_in_flight(const noack_link *link) { return link->in_flight; }
