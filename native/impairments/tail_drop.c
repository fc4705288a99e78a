/* A bottleneck: packets leave one after the other, at a rate, from a finite queue. A packet that
   finds it full is lost (tail drop); with CoDel, the law of codel.c may drop it, too.

   With a burst it is a token bucket, as tbf of tc: the bucket fills at the rate, holds the burst,
   and is full at first; the first packet of the queue leaves as soon as the bucket has its size,
   and takes it out. Let busy be the time at which the bucket was, or will be, empty: E = max(E, t -
   b) + w for a packet that arrives at t and needs the time w at the rate, with the burst's time b;
   and it leaves at max(t, E). For b = 0 this is a line that sends one packet after the other, E the
   end of its last transmission. A packet that is larger than the burst is lost; if it must pass, it
   waits until the rate has carried it.

   The queue serves in the order of arrival. Its state depends on arrival times only, not on the
   emulator's own lateness: the begin and the end of a packet's service are known on its arrival.

   The ring of a queue has two numbers for each packet, at its place and at the place behind it:
   when it leaves, and how many bytes were put into the queue before it. */
#include "../network/network.h"

/* What a packet occupies on the line. */
int64_t line_bytes_of(const noack_bottleneck *settings, int64_t size_bytes) {
    int64_t line_bytes = max_of(size_bytes + settings->overhead_bytes, 0);
    if (settings->cell_bytes > 0) {
        int64_t cells = (line_bytes + settings->cell_bytes - 1) / settings->cell_bytes;
        line_bytes = cells * (settings->cell_bytes + settings->cell_overhead_bytes);
    }
    return line_bytes;
}

int64_t queue_bytes_at(noack_link *link, int64_t stage, int64_t now_ns) {
    const noack_stage *settings = &link->stages[stage];
    const int64_t *ring = link->departures_ns + settings->queue_begin;
    noack_stage_state *queue = &link->stage_states[stage];
    queue->entry_ns = max_of(queue->entry_ns, now_ns);
    while (queue->count > 0 && ring[2 * queue->head] <= queue->entry_ns) {
        queue->head = (queue->head + 1) % settings->queue_places;
        queue->count--;
    }
    return queue->count == 0 ? 0 : queue->total_bytes - ring[2 * queue->head + 1];
}

/* Whether the queue has a free place at now_ns; removes packets that have left until then. */
int64_t noack_queue_enters(noack_link *link, int64_t stage, int64_t now_ns) {
    queue_bytes_at(link, stage, now_ns);
    return link->stage_states[stage].count < link->stages[stage].queue_places;
}

/* A packet that must pass may exceed the size. The ring has the newest packets. So, if it is full,
   what is older does not matter: while the oldest one of the ring has not left, at least as many
   packets wait as there are places, and more bytes than one more packet could be added to. */
void queue_occupy(noack_link *link, int64_t stage, int64_t until_ns, int64_t bytes) {
    const noack_stage *settings = &link->stages[stage];
    int64_t *ring = link->departures_ns + settings->queue_begin;
    noack_stage_state *queue = &link->stage_states[stage];
    if (queue->count < settings->queue_places)
        queue->count++;
    else
        queue->head = (queue->head + 1) % settings->queue_places;
    int64_t last = (queue->head + queue->count - 1) % settings->queue_places;
    ring[2 * last] = until_ns;
    ring[2 * last + 1] = queue->total_bytes;
    queue->total_bytes += bytes;
}

/* Put a packet into the queue, after noack_queue_enters; return its departure time. */
int64_t noack_queue_serve(noack_link *link, int64_t stage, int64_t size_bytes) {
    const noack_bottleneck *settings = &link->stages[stage].bottleneck;
    noack_stage_state *queue = &link->stage_states[stage];
    int64_t line_bytes = line_bytes_of(settings, size_bytes);
    /* A bucket that would have more than the burst has the burst. */
    int64_t full_ns = queue->entry_ns - settings->burst_ns;
    if (queue->busy_until_ns < full_ns
        || (queue->busy_until_ns == full_ns && queue->carry < settings->burst_carry)) {
        queue->busy_until_ns = full_ns;
        queue->carry = settings->burst_carry;
    }
    int64_t work = line_bytes * 8 * NS_PER_S + queue->carry;
    queue->busy_until_ns = min_of(queue->busy_until_ns + work / settings->rate_bps, LATEST_NS);
    queue->carry = work % settings->rate_bps;
    int64_t leaves_ns = max_of(queue->entry_ns, queue->busy_until_ns);
    queue_occupy(link, stage, leaves_ns, queued_bytes(line_bytes));
    return leaves_ns;
}

/* Whether a packet may enter at now_ns. */
static int has_room(
    noack_link *link, int64_t number, const noack_stage *stage, int64_t line_bytes,
    int64_t now_ns) {
    const noack_bottleneck *settings = &stage->bottleneck;
    int64_t waiting_bytes = queue_bytes_at(link, number, now_ns);
    return link->stage_states[number].count < stage->queue_places
           && fits_queue(settings, waiting_bytes, line_bytes)
           && (settings->burst_bytes == 0 || line_bytes <= settings->burst_bytes);
}

/* Put the packet into the queue; ignore a packet that is lost already. */
void apply_tail_drop(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    packet_copy *copy = copy_in(packet);
    noack_link *link = packet->link;
    int64_t number = packet->stage, size_bytes = packet->decision->size_bytes;
    if (!copy->exists)
        return;
    int64_t line_bytes = line_bytes_of(&stage->bottleneck, size_bytes);
    if (!has_room(link, number, stage, line_bytes, copy->time_ns))
        lose(packet, NOACK_OVERFLOWED);
    if (!copy->exists)
        return;
    if (stage->kind == NOACK_CODEL && codel_is_due(link, number))
        lose(packet, NOACK_OVERFLOWED);
    if (copy->exists)
        copy->time_ns = noack_queue_serve(link, number, size_bytes);
    else
        codel_drop(link, number, queued_bytes(line_bytes));
}
