/* A bottleneck: packets leave one after the other, at a rate, from a finite queue. A packet that
   finds it full is lost (tail drop); with CoDel, the law of codel.c may drop it, too.

   The queue serves in the order of arrival. Its state depends on arrival times only, not on the
   emulator's own lateness: the begin and the end of a packet's service are known on its arrival. */
#include "../core.h"

/* Whether the queue has a free place at now_ns; removes packets that have left until then. */
int64_t noack_queue_enters(noack_link *link, int64_t stage, int64_t now_ns) {
    const noack_stage *settings = &link->stages[stage];
    const int64_t *ring_ns = link->departures_ns + settings->queue_begin;
    noack_stage_state *queue = &link->stage_states[stage];
    queue->entry_ns = max_of(queue->entry_ns, now_ns);
    while (queue->count > 0 && ring_ns[queue->head] <= queue->entry_ns) {
        queue->head = (queue->head + 1) % settings->queue_places;
        queue->count--;
    }
    return queue->count < settings->queue_places;
}

/* Occupy a place in the queue until a time; a packet that must pass may exceed the size. The ring
   has the departures of the newest packets. So, if it is full, what is older does not matter: while
   the oldest one of the ring has not left, at least as many packets wait as there are places. */
void queue_occupy(noack_link *link, int64_t stage, int64_t until_ns) {
    const noack_stage *settings = &link->stages[stage];
    noack_stage_state *queue = &link->stage_states[stage];
    if (queue->count < settings->queue_places)
        queue->count++;
    else
        queue->head = (queue->head + 1) % settings->queue_places;
    int64_t last = (queue->head + queue->count - 1) % settings->queue_places;
    link->departures_ns[settings->queue_begin + last] = until_ns;
}

/* Put a packet into the queue, after noack_queue_enters; return its departure time. */
int64_t noack_queue_serve(noack_link *link, int64_t stage, int64_t size_bytes) {
    const noack_bottleneck *settings = &link->stages[stage].bottleneck;
    noack_stage_state *queue = &link->stage_states[stage];
    int64_t line_bytes = max_of(size_bytes + settings->overhead_bytes, 0);
    if (settings->cell_bytes > 0) {
        int64_t cells = (line_bytes + settings->cell_bytes - 1) / settings->cell_bytes;
        line_bytes = cells * (settings->cell_bytes + settings->cell_overhead_bytes);
    }
    if (queue->busy_until_ns < queue->entry_ns) {
        queue->busy_until_ns = queue->entry_ns;
        queue->carry = 0;
    }
    int64_t work = line_bytes * 8 * NS_PER_S + queue->carry;
    queue->busy_until_ns = min_of(queue->busy_until_ns + work / settings->rate_bps, LATEST_NS);
    queue->carry = work % settings->rate_bps;
    queue_occupy(link, stage, queue->busy_until_ns);
    return queue->busy_until_ns;
}

/* Put the packet into the queue; ignore a packet that is lost already. */
void apply_tail_drop(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    packet_copy *copy = copy_in(packet);
    noack_link *link = packet->link;
    int64_t number = packet->stage;
    if (!copy->exists)
        return;
    if (!noack_queue_enters(link, number, copy->time_ns))
        lose(packet, NOACK_OVERFLOWED);
    if (!copy->exists)
        return;
    if (stage->kind == NOACK_CODEL && codel_is_due(link, number))
        lose(packet, NOACK_OVERFLOWED);
    if (copy->exists)
        copy->time_ns = noack_queue_serve(link, number, packet->decision->size_bytes);
    else
        codel_drop(link, number);
}
