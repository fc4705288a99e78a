/* The guarantee: which packets of a flow may be lost, and which earlier ones they may make stale.

   A packet is effectively delivered if it, or a copy of it, leaves intact and before every later
   packet of its flow. A packet that is dropped, corrupted, or delivered out of order (stale, for a
   receiver that wants the newest) is lost. The guarantee consists of

   - the maximum of consecutive losses, M - 1 (MANSD: the maximum allowable number of successive
     dropouts; Garcia & Antsaklis, Section III),
   - windows: at most m losses among any K consecutive packets,
   - recovery: at least h consecutive deliveries between two loss bursts.

   Each of them allows every delivery. Hence two rules (docs/mansd.md has the proof):

   - A packet whose loss is not allowed after the losses before it must pass (noack_must_pass).
   - A packet may leave before earlier ones only if the losses that this causes are allowed; else it
     is held back until it makes fewer stale (noack_hold_back_until).

   S(i) is the number of losses among a flow's packets with numbers below i. Windows and recovery
   are differences of S, which a ring stores per flow. */
#include "network.h"

/* Whether the guarantee needs S. */
int counts_losses(const noack_link *link) { return link->window_count > 0 || link->recovery > 0; }

/* Whether the flow's next packet has to be delivered: it is the first one, of a link that delivers
   it (in a run, that of the updates), or its loss would break a rule. */
int64_t noack_must_pass(const noack_link *link, int64_t row) {
    const noack_flow *flow = &link->flows[row];
    if (flow->forced_first)
        return 1;
    if (link->mansd >= 0 && flow->consecutive_losses >= link->mansd)
        return 1;
    if (!counts_losses(link))
        return 0;
    const int64_t *losses = link->losses + row * link->loss_width;
    int64_t packet = flow->packets, loss_mask = link->loss_width - 1,
            so_far = losses[packet & loss_mask];
    for (int64_t i = 0; i < link->window_count; i++) {
        const noack_window *window = &link->windows[i];
        if (so_far - losses[(packet + 1 - window->packets) & loss_mask] >= window->losses)
            return 1;
    }
    int begins_burst = flow->consecutive_losses == 0;
    return begins_burst && so_far != losses[(packet - link->recovery) & loss_mask];
}

/* The newest effectively delivered packet below end; below oldest: none. */
static int64_t newest_below(
    const int64_t *recent_ns, int64_t recent_mask, int64_t oldest, int64_t end) {
    int64_t number = end - 1;
    while (number >= oldest && recent_ns[number & recent_mask] < 0)
        number--;
    return number;
}

/* Whether an effectively delivered packet becomes stale if a later one leaves at release_ns. What
   has left does not, whatever the times are: an arrival may have an earlier time than a departure
   before it, if a clock runs backward or a packet leaves before it is due. */
static int becomes_stale(const noack_link *link, int64_t row, int64_t number, int64_t release_ns) {
    const int64_t *recent_ns = link->recent_ns + row * link->recent_width;
    return number > link->flows[row].newest
           && recent_ns[number & (link->recent_width - 1)] > release_ns;
}

/* The number of effectively delivered packets between `delivered` and `packet` that must at least
   remain so: each takes one loss from every window. 0: all packets between them may be lost. */
static int64_t needed_after(
    const noack_link *link, const int64_t *losses, int64_t delivered, int64_t packet) {
    int64_t burst = packet - 1 - delivered;
    int64_t needed = burst > link->mansd ? 1 : 0;
    if (!counts_losses(link))
        return needed;
    int64_t loss_mask = link->loss_width - 1, before = losses[(delivered + 1) & loss_mask];
    for (int64_t i = 0; i < link->window_count; i++) {
        const noack_window *window = &link->windows[i];
        int64_t beyond =
            before + burst - losses[(packet - window->packets) & loss_mask] - window->losses;
        needed = max_of(needed, beyond);
    }
    if (needed == 0 && before != losses[(delivered + 1 - link->recovery) & loss_mask])
        needed = 1;
    return needed;
}

/* The earliest time, not before desired_ns, at which a packet may leave.

   The ring recent_ns has the previous packets' release times, of mansd + 1 at least; -1 for packets
   that are not effectively delivered. Of the others, those that have not left ascend. Without a
   maximum of consecutive losses, only the first packet can be needed. */
int64_t noack_hold_back_until(
    const noack_link *link, int64_t row, int64_t packet, int64_t desired_ns) {
    const int64_t *recent_ns = link->recent_ns + row * link->recent_width;
    const int64_t *losses = link->losses + row * link->loss_width;
    int64_t recent_mask = link->recent_width - 1, oldest = max_of(packet - link->mansd - 1, 0);
    int64_t release_ns = max_of(desired_ns, link->flows[row].first_release_ns);
    if (link->scheduler >= 0) /* each flow leaves in its order; see waiting.c */
        return release_ns;
    int64_t delivered = newest_below(recent_ns, recent_mask, oldest, packet);
    while (delivered >= oldest && becomes_stale(link, row, delivered, release_ns))
        delivered = newest_below(recent_ns, recent_mask, oldest, delivered);
    int64_t first = delivered + 1, needed = 0;
    for (int64_t number = first; number < packet; number++) {
        int64_t time_ns = recent_ns[number & recent_mask];
        if (time_ns > release_ns) {
            if (needed == 0)
                needed = needed_after(link, losses, delivered, packet);
            if (needed == 0)
                break;
            release_ns = time_ns;
        }
        if (time_ns >= 0) {
            delivered = number;
            needed = max_of(needed - 1, 0);
        }
    }
    return release_ns;
}

/* Mark the earlier packets that leave after release_ns as stale; return how many. */
int64_t make_stale(const noack_link *link, int64_t row, int64_t packet, int64_t release_ns) {
    int64_t *recent_ns = link->recent_ns + row * link->recent_width;
    int64_t recent_mask = link->recent_width - 1, oldest = max_of(packet - link->mansd - 1, 0);
    int64_t stale = 0, first = packet;
    int64_t number = newest_below(recent_ns, recent_mask, oldest, packet);
    while (number >= oldest && becomes_stale(link, row, number, release_ns)) {
        recent_ns[number & recent_mask] = NOACK_NEVER_NS;
        stale++;
        first = number;
        number = newest_below(recent_ns, recent_mask, oldest, number);
    }
    if (counts_losses(link)) {
        int64_t *losses = link->losses + row * link->loss_width;
        int64_t loss_mask = link->loss_width - 1;
        for (number = first; number < packet; number++)
            losses[(number + 1) & loss_mask] = losses[number & loss_mask] + 1;
    }
    return stale;
}

/* Store S behind a packet for which the decision has been made. */
void note_outcome(const noack_link *link, int64_t row, int64_t packet, int lost) {
    if (!counts_losses(link))
        return;
    int64_t *losses = link->losses + row * link->loss_width, loss_mask = link->loss_width - 1;
    losses[(packet + 1) & loss_mask] = losses[packet & loss_mask] + (lost ? 1 : 0);
}
