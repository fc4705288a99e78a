/* One direction of a link: decisions for arriving packets, and accounting of departures.

   How a packet is lost: the relay of a live run (native/relay/loop.c) or the channel of a simulated
   one (native/driver/channel.c) has received a datagram of a flow, and asks for a decision.
   decide_for applies the stages of native/impairments/ in order, each to every packet, lost or not,
   and to its duplicate, if an earlier stage made one. A stage, or the limit of packets in flight,
   loses such a copy by lose (network.h), unless the packet must pass (noack_must_pass) and has no
   other. The packet is lost if no copy is left. noack_settle completes the decision. A packet that
   only arrives corrupted is lost, too. One that leaves before earlier ones makes these stale: they
   are lost as well, and it is held back if that would break the guarantee. The consecutive losses
   up to it are what noack_must_pass compares with M - 1 for the next packet.

   A lost packet has no departure, so its datagram is passed on to nobody, and nobody is told. Those
   that are corrupted or stale are sent; their receiver rejects them (native/loop/wire.c). */
#include <string.h>

#include "network.h"

static stage_function *const APPLY[NOACK_STAGE_KINDS] = {
    [NOACK_BERNOULLI] = apply_bernoulli,
    [NOACK_FOUR_STATE] = apply_four_state,
    [NOACK_GILBERT_ELLIOTT] = apply_gilbert_elliott,
    [NOACK_PERIODIC] = apply_periodic,
    [NOACK_SCRIPTED] = apply_scripted,
    [NOACK_WORST_CASE] = apply_worst_case,
    [NOACK_CODEL] = apply_tail_drop,
    [NOACK_TAIL_DROP] = apply_tail_drop,
    [NOACK_BLACKOUT] = apply_blackout,
    [NOACK_CORRUPT] = apply_corrupt,
    [NOACK_DELAY] = apply_delay,
    [NOACK_DUPLICATE] = apply_duplicate,
    [NOACK_EARLIEST_DEADLINE] = apply_earliest_deadline,
    [NOACK_MAXIMUM_ERROR] = apply_maximum_error,
    [NOACK_OPPORTUNITIES] = apply_opportunities,
    [NOACK_PRIORITY] = apply_priority,
    [NOACK_REORDER] = apply_reorder,
    [NOACK_REPLAY] = apply_replay,
    [NOACK_SCHEDULE] = apply_schedule,
};

/* Decide as the user's network did; a packet that must pass leaves nevertheless. */
static void apply_outcome(int64_t outcome_ns, noack_decision *decision) {
    int loses = outcome_ns < 0;
    decision->loss_suppressed = loses && decision->must_pass;
    if (loses && !decision->must_pass) {
        decision->fate = NOACK_DROPPED;
        decision->release_ns = NOACK_NEVER_NS;
    } else {
        decision->release_ns = decision->arrival_ns + max_of(outcome_ns, 0);
    }
}

/* The copy that leaves first. */
static int first_copy(const packet *packet) {
    const packet_copy *copies = packet->copies;
    int duplicate_leaves = copies[DUPLICATE].exists;
    return duplicate_leaves && copies[ORIGINAL].exists
               ? copies[DUPLICATE].time_ns < copies[ORIGINAL].time_ns
               : duplicate_leaves;
}

/* Lose the copies that are delayed and find no free place in flight. */
static void keep_limit(int64_t free_places, packet *packet) {
    int first = first_copy(packet);
    for (int i = 0; i < COPIES; i++) {
        packet->copy = i == 0 ? first : COPIES - 1 - first;
        int is_delayed = copy_in(packet)->time_ns > packet->decision->arrival_ns;
        if (is_delayed && free_places <= 0)
            lose(packet, NOACK_OVERFLOWED);
        else if (is_delayed && copy_in(packet)->exists)
            free_places--;
    }
}

/* Note when the copies leave, in this order. */
static void decide_departures(const packet *packet) {
    noack_decision *decision = packet->decision;
    int first = first_copy(packet);
    const packet_copy *earlier = &packet->copies[first],
                      *later = &packet->copies[COPIES - 1 - first];
    decision->release_ns = earlier->exists ? earlier->time_ns : NOACK_NEVER_NS;
    decision->bit = earlier->exists ? earlier->bit : -1;
    decision->copy_ns = later->exists ? later->time_ns : NOACK_NEVER_NS;
    decision->copy_bit = later->exists ? later->bit : -1;
}

/* Apply the stages, one after the other, to the packet, and to its duplicate behind the stage that
   made it. */
static void apply_stages(packet *packet, noack_stage_memory *memory) {
    const noack_link *link = packet->link;
    for (packet->stage = 0; packet->stage < link->stage_count; packet->stage++, memory++) {
        const noack_stage *stage = &link->stages[packet->stage];
        int has_duplicate = packet->copies[DUPLICATE].exists;
        packet->copy = ORIGINAL;
        APPLY[stage->kind](packet, stage, memory);
        if (has_duplicate) {
            noack_stage_memory latest = *memory;
            packet->copy = DUPLICATE;
            APPLY[stage->kind](packet, stage, memory);
            latest.taken_until_ns = memory->taken_until_ns; /* it has taken a slot, or passed */
            *memory = latest;
        }
    }
    if (packet->decision->waits)
        complete_waiting_decision(packet);
}

/* The last intact copy of a packet that must pass is exempt from everything that would lose it. */
void decide_for(
    noack_link *link, int64_t row, int64_t size_bytes, int64_t now_ns, const int64_t *outcome_ns,
    noack_decision *decision) {
    noack_flow *flow = &link->flows[row];
    *decision = (noack_decision){
        /* every field, since the compiler's filling with 0 is slow */
        .fate = NOACK_DELIVERED,
        .packet = flow->packets,
        .consecutive_losses = 0,
        .release_ns = now_ns,
        .copy_ns = NOACK_NEVER_NS,
        .bit = -1,
        .copy_bit = -1,
        .hold_back_ns = 0,
        .makes_stale = 0,
        .arrival_ns = now_ns,
        .size_bytes = size_bytes,
        .must_pass = noack_must_pass(link, row),
        .loss_suppressed = 0,
        .waits = 0,
        .key = 0,
        .after_ns = 0,
    };
    flow->packets++;
    link->counters.received++;
    link->counters.received_bytes += size_bytes;
    if (outcome_ns != NULL) {
        apply_outcome(*outcome_ns, decision);
    } else {
        packet arriving = {
            .link = link,
            .flow = flow,
            .decision = decision,
            .copies = {[ORIGINAL] = {.exists = 1, .time_ns = now_ns, .bit = -1}},
        };
        apply_stages(&arriving, link->memory + row * link->stage_count);
        keep_limit(link->limit - link->in_flight, &arriving);
        decide_departures(&arriving);
    }
    noack_settle(link, row, decision);
}

void noack_link_decide(
    noack_link *link, int64_t row, int64_t size_bytes, int64_t now_ns, noack_decision *decision) {
    decide_for(link, row, size_bytes, now_ns, NULL, decision);
}

void noack_link_decide_many(
    noack_link *link, int64_t count, const int64_t *rows, const int64_t *sizes_bytes,
    const int64_t *arrivals_ns, noack_decision *decisions) {
    for (int64_t i = 0; i < count; i++)
        noack_link_decide(link, rows[i], sizes_bytes[i], arrivals_ns[i], &decisions[i]);
}

/* Hold an intact packet back for the guarantee, from effective_ns on; return when it leaves. */
static int64_t hold_back(
    noack_link *link, int64_t row, noack_decision *decision, int64_t effective_ns) {
    int64_t needed_ns = noack_hold_back_until(link, row, decision->packet, effective_ns);
    if (needed_ns > effective_ns) {
        decision->hold_back_ns = needed_ns - effective_ns;
        if (decision->bit < 0)
            decision->release_ns = needed_ns;
        if (decision->copy_ns != NOACK_NEVER_NS)
            decision->copy_ns = max_of(decision->copy_ns, needed_ns);
        link->counters.held_back++;
    }
    if (link->scheduler < 0)
        decision->makes_stale = make_stale(link, row, decision->packet, needed_ns);
    else if (!decision->waits)
        link->flows[row].first_release_ns = needed_ns; /* of waiting packets, see waiting.c */
    return needed_ns;
}

static void count(noack_counters *counters, const noack_decision *decision) {
    int64_t *const of_fate[] = {
        [NOACK_DELIVERED] = &counters->delivered,   [NOACK_DROPPED] = &counters->dropped,
        [NOACK_FORCED] = &counters->forced,         [NOACK_CORRUPTED] = &counters->corrupted,
        [NOACK_OVERFLOWED] = &counters->overflowed, [NOACK_BLACKED_OUT] = &counters->blacked_out,
    };
    ++*of_fate[decision->fate];
    if (decision->copy_ns != NOACK_NEVER_NS)
        counters->duplicated++;
}

/* Enforce the guarantee for a packet with known times, count it, complete the decision. */
void noack_settle(noack_link *link, int64_t row, noack_decision *decision) {
    noack_flow *flow = &link->flows[row];
    noack_counters *counters = &link->counters;
    int64_t packet = decision->packet, now_ns = decision->arrival_ns;
    int64_t effective_ns = NOACK_NEVER_NS;
    decision->hold_back_ns = decision->makes_stale = 0;
    if (decision->fate == NOACK_DELIVERED) {
        if (decision->bit < 0)
            effective_ns = decision->release_ns;
        else if (decision->copy_ns != NOACK_NEVER_NS && decision->copy_bit < 0)
            effective_ns = decision->copy_ns;
        else
            decision->fate = NOACK_CORRUPTED;
    }
    if (effective_ns != NOACK_NEVER_NS) {
        if (link->can_reorder)
            effective_ns = hold_back(link, row, decision, effective_ns);
        if (decision->loss_suppressed)
            decision->fate = NOACK_FORCED;
        if (flow->forced_first) {
            flow->forced_first = 0;
            flow->first_release_ns = effective_ns;
        }
        flow->consecutive_losses = 0;
    } else {
        flow->consecutive_losses++;
        int64_t losses = min_of(flow->consecutive_losses, packet + 1 - flow->since);
        flow->longest_loss_burst = max_of(flow->longest_loss_burst, losses);
        counters->longest_loss_burst = max_of(counters->longest_loss_burst, losses);
    }
    if (link->can_reorder && link->mansd >= 0)
        link->recent_ns[row * link->recent_width + (packet & (link->recent_width - 1))] =
            effective_ns;
    note_outcome(link, row, packet, effective_ns == NOACK_NEVER_NS);
    decision->consecutive_losses = flow->consecutive_losses;
    count(counters, decision);
    link->in_flight += (decision->release_ns > now_ns) + (decision->copy_ns > now_ns);
    counters->most_in_flight = max_of(counters->most_in_flight, link->in_flight);
}

int64_t noack_link_touch(const noack_link *link, int64_t row) {
    return link->flows[row].number + link->flows[row].longest_loss_burst;
}

int64_t noack_link_leave(
    noack_link *link, int64_t row, int64_t packet, int64_t size_bytes, int64_t delayed,
    int64_t counts) {
    noack_flow *flow = &link->flows[row];
    noack_counters *counters = &link->counters;
    counters->forwarded++;
    counters->forwarded_bytes += size_bytes;
    if (delayed)
        link->in_flight--;
    int stale = packet < flow->newest;
    if (counts && stale) {
        counters->delivered_out_of_order++;
    } else if (counts) {
        int64_t losses = packet - max_of(flow->newest, flow->since - 1) - 1;
        flow->newest = packet;
        flow->longest_loss_burst = max_of(flow->longest_loss_burst, losses);
        counters->longest_loss_burst = max_of(counters->longest_loss_burst, losses);
    }
    return stale;
}
