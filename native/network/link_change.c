/* A change of settings: transfers a link's state to one with other settings.

   A stage keeps its state if the new settings have a stage of the same kind and random stream; a
   queue keeps its state under another discipline, too. Flows, counters and packets in flight do not
   change, except that the count of the longest loss burst starts again, since another guarantee may
   apply. */
#include <string.h>

#include "network.h"

static int is_bottleneck(const noack_stage *stage) {
    return stage->kind == NOACK_CODEL || stage->kind == NOACK_TAIL_DROP || is_scheduler(stage);
}

/* The place of the stage with this stream and the same kind, or also a bottleneck; -1: none. */
static int64_t find_stage(const noack_link *link, const noack_stage *stage) {
    for (int64_t i = 0; i < link->stage_count; i++) {
        const noack_stage *other = &link->stages[i];
        int alike = other->kind == stage->kind || (is_bottleneck(other) && is_bottleneck(stage));
        if (alike && other->key0 == stage->key0 && other->key1 == stage->key1)
            return i;
    }
    return -1;
}

static int64_t rate_of(const noack_stage *stage) {
    return stage->kind == NOACK_OPPORTUNITIES ? 0 : stage->bottleneck.rate_bps;
}

/* Transfer a queue; a shorter one drops the earliest departure times, and is full then. */
static void change_queue(
    const noack_link *before, int64_t old_place, const noack_link *after, int64_t new_place) {
    const noack_stage *old = &before->stages[old_place], *new = &after->stages[new_place];
    const noack_stage_state *queue = &before->stage_states[old_place];
    noack_stage_state *new_queue = &after->stage_states[new_place];
    int64_t count = min_of(queue->count, new->queue_places);
    int64_t first = queue->head + queue->count - count;
    for (int64_t k = 0; k < count; k++)
        memcpy(
            after->departures_ns + new->queue_begin + 2 * k,
            before->departures_ns + old->queue_begin + 2 * ((first + k) % old->queue_places),
            2 * sizeof *after->departures_ns);
    new_queue->head = 0;
    new_queue->count = count;
    new_queue->entry_ns = queue->entry_ns;
    new_queue->busy_until_ns = queue->busy_until_ns;
    new_queue->total_bytes = queue->total_bytes;
    new_queue->carry = rate_of(new) == rate_of(old) ? queue->carry : 0;
}

static void change_stage(const noack_link *before, const noack_link *after, int64_t new_place) {
    const noack_stage *stage = &after->stages[new_place];
    int64_t old_place = find_stage(before, stage);
    if (old_place < 0)
        return;
    int is_same_kind = stage->kind == before->stages[old_place].kind;
    if (is_same_kind)
        after->stage_states[new_place] = before->stage_states[old_place];
    if (stage->queue_places > 0)
        change_queue(before, old_place, after, new_place);
    if (is_same_kind)
        for (int64_t row = 0; row < before->rows; row++)
            after->memory[row * after->stage_count + new_place] =
                before->memory[row * before->stage_count + old_place];
}

/* Transfer the outcomes of the last packets; an unknown outcome counts as a delivery. */
static void change_losses(const noack_link *before, const noack_link *after, int64_t row) {
    const noack_flow *flow = &before->flows[row];
    const int64_t *old_losses = before->losses + row * before->loss_width;
    const int64_t *times_ns = before->recent_ns + row * before->recent_width;
    int64_t *losses = after->losses + row * after->loss_width;
    int64_t packets = flow->packets, new_mask = after->loss_width - 1, count;
    int counted = counts_losses(before), listed = before->can_reorder && before->mansd >= 0;
    if (counted) {
        count = before->loss_width - 1;
        if (count == new_mask) {
            memcpy(losses, old_losses, (size_t)after->loss_width * sizeof *losses);
            return;
        }
    } else if (listed) {
        count = min_of(before->mansd + 1, packets);
    } else {
        count = flow->consecutive_losses;
    }
    int64_t so_far = 0, old_mask = count;
    for (int64_t number = packets - min_of(count, new_mask); number < packets; number++) {
        int lost = 1;
        if (counted)
            lost = old_losses[(number + 1) & old_mask] > old_losses[number & old_mask];
        else if (listed)
            lost = times_ns[number & (before->recent_width - 1)] < 0;
        so_far += lost;
        losses[(number + 1) & new_mask] = so_far;
    }
}

static int is_same_guarantee(const noack_link *a, const noack_link *b) {
    if (a->mansd != b->mansd || a->recovery != b->recovery || a->window_count != b->window_count)
        return 0;
    for (int64_t i = 0; i < a->window_count; i++)
        if (a->windows[i].losses != b->windows[i].losses
            || a->windows[i].packets != b->windows[i].packets)
            return 0;
    return 1;
}

/* Transfer the release times that the guarantee needs. A delivered packet without a known time has
   the time 0, and so does one with an unknown outcome. If the guarantee differs (or there is none
   any more), or a queue chooses before or after the change, later packets leave only after the
   packets that are in flight at the change. */
static void change_releases(
    const noack_link *before, const noack_link *after, int64_t row, int64_t latest_ns) {
    noack_flow *flow = &after->flows[row];
    int64_t *times_ns = after->recent_ns + row * after->recent_width;
    const int64_t *old_times_ns = before->recent_ns + row * before->recent_width;
    int64_t recent_mask = after->recent_width - 1, kept_times = 0;
    if (before->can_reorder && before->mansd >= 0)
        kept_times = min_of(after->mansd, before->mansd) + 1;
    int64_t first_known = flow->packets - kept_times,
            first_lost = flow->packets - flow->consecutive_losses;
    for (int64_t number = max_of(flow->packets - after->mansd - 1, 0); number < flow->packets;
         number++) {
        if (number >= first_known)
            times_ns[number & recent_mask] = old_times_ns[number & (before->recent_width - 1)];
        else if (number < first_lost)
            times_ns[number & recent_mask] = 0;
    }
    if (before->can_reorder
        && (!is_same_guarantee(before, after) || before->scheduler >= 0 || after->scheduler >= 0))
        flow->first_release_ns = max_of(flow->first_release_ns, latest_ns);
}

int64_t noack_link_change(
    noack_link *link, const noack_link_settings *settings, const int64_t *latest_ns,
    const char **wrong) {
    noack_link_settings changed = *settings;
    changed.rows = link->rows;
    changed.can_reorder |= link->can_reorder;
    noack_link *after = noack_link_new(&changed, wrong);
    if (after == NULL)
        return 0;
    noack_flow *unused_flows = after->flows;
    after->flows = link->flows;
    for (int64_t place = 0; place < after->stage_count; place++)
        change_stage(link, after, place);
    for (int64_t row = 0; row < link->rows; row++) {
        noack_flow *flow = &after->flows[row];
        flow->since = flow->packets;
        flow->longest_loss_burst = 0;
        if (counts_losses(after))
            change_losses(link, after, row);
        if (after->can_reorder)
            change_releases(link, after, row, latest_ns[row]);
    }
    after->in_flight = link->in_flight;
    after->counters = link->counters;
    after->counters.longest_loss_burst = 0;
    noack_link old = *link;
    *link = *after;
    *after = old;
    after->flows = unused_flows;
    noack_link_free(after);
    return 1;
}
