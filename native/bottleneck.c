/* A bottleneck: packets leave one after the other, at a rate, from a finite queue.

   The queue serves in the order of arrival. Its state depends on arrival times only, not on the
   emulator's own lateness: the begin and the end of a packet's service are known on its arrival. */
#include "core.h"

/* Whether the queue has a free place at now_ns; removes packets that have left until then. */
int queue_enters(const noack_stage *stage, noack_queue *queue, int64_t *ring_ns, int64_t now_ns) {
    queue->entry_ns = max_of(queue->entry_ns, now_ns);
    while (queue->count > 0 && ring_ns[stage->queue_begin + queue->head] <= queue->entry_ns) {
        queue->head = (queue->head + 1) % stage->queue_places;
        queue->count--;
    }
    return queue->count < stage->queue_places;
}

/* Put a packet into the queue, after queue_enters; return its departure time. */
int64_t queue_serve(
    const noack_stage *stage, noack_queue *queue, int64_t *ring_ns, int64_t size_bytes) {
    const noack_bottleneck *own = &stage->bottleneck;
    int64_t line_bytes = max_of(size_bytes + own->overhead_bytes, 0);
    if (own->cell_bytes > 0) {
        int64_t cells = (line_bytes + own->cell_bytes - 1) / own->cell_bytes;
        line_bytes = cells * (own->cell_bytes + own->cell_overhead_bytes);
    }
    if (queue->busy_until_ns < queue->entry_ns) {
        queue->busy_until_ns = queue->entry_ns;
        queue->carry = 0;
    }
    int64_t work = line_bytes * 8 * NS_PER_S + queue->carry;
    queue->busy_until_ns = min_of(queue->busy_until_ns + work / own->rate_bps, LATEST_NS);
    queue->carry = work % own->rate_bps;
    queue_occupy(stage, queue, ring_ns, queue->busy_until_ns);
    return queue->busy_until_ns;
}

/* Occupy a place in the queue until a time; a packet that must pass may exceed the size. */
void queue_occupy(
    const noack_stage *stage, noack_queue *queue, int64_t *ring_ns, int64_t until_ns) {
    if (queue->count < stage->queue_places)
        queue->count++;
    ring_ns[stage->queue_begin + (queue->head + queue->count - 1) % stage->queue_places] = until_ns;
}

int64_t noack_queue_enters(noack_link *link, int64_t stage, int64_t now_ns) {
    return queue_enters(&link->stages[stage], &link->queues[stage], link->departures_ns, now_ns);
}

int64_t noack_queue_serve(noack_link *link, int64_t stage, int64_t size_bytes) {
    return queue_serve(&link->stages[stage], &link->queues[stage], link->departures_ns, size_bytes);
}
