/* Tail drop: a packet that finds the queue full is lost. */
#include "../core.h"

/* Put the packet and then its copy into the queue; ignore a packet that is lost already. */
void apply_tail_drop(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    noack_decision *decision = packet->decision;
    if (decision->fate != NOACK_DELIVERED)
        return;
    noack_queue *queue = &packet->link->queues[packet->stage];
    int64_t *ring_ns = packet->link->departures_ns;
    if (!queue_enters(stage, queue, ring_ns, decision->release_ns))
        refuse(decision, NOACK_OVERFLOWED);
    if (decision->fate == NOACK_DELIVERED)
        decision->release_ns = queue_serve(stage, queue, ring_ns, decision->size_bytes);
    if (decision->copy_ns == NOACK_NEVER_NS)
        return;
    if (decision->fate == NOACK_DELIVERED && queue_enters(stage, queue, ring_ns, decision->copy_ns))
        decision->copy_ns = queue_serve(stage, queue, ring_ns, decision->size_bytes);
    else
        decision->copy_ns = NOACK_NEVER_NS;
}
