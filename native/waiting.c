/* A bottleneck that chooses, whenever its link is free, which of the waiting packets it sends next:
   that with the smallest key. So a departure depends on later arrivals.

   The decision for a packet is made at its arrival all the same: whether it is lost, and the earliest
   time at which it can leave. What is not lost waits in a heap (a skew heap: Sleator and Tarjan,
   1986), whose nodes the relay or the channel has, one for each place of a stored datagram. The
   packet that is being sent has left the heap; its departure is known. At its departure, and at each
   arrival, what could begin until then begins (begin_sending). This is soon enough: what begins at a
   time depends on earlier arrivals only, and while packets wait, one that is being sent has still to
   leave, so there will be a departure.

   The key of a flow's packets does not decrease, so they leave in order of arrival. Hence their
   earliest times, which do not decrease either, stand for their departures in the guarantee. Constant
   delays before and after the queue have the same effect, and are added to the departure. */
#include "core.h"

static int is_before(const noack_waiting *a, const noack_waiting *b) {
    return a->key < b->key || (a->key == b->key && a->order < b->order);
}

/* Merge two heaps, each given by its first place + 1; 0: an empty one. */
static int64_t merge(noack_waiting *waiting, int64_t a, int64_t b) {
    int64_t root = 0, *end = &root;
    while (a != 0 && b != 0) {
        if (is_before(&waiting[b - 1], &waiting[a - 1])) {
            int64_t other = a;
            a = b;
            b = other;
        }
        noack_waiting *first = &waiting[a - 1];
        *end = a;
        a = first->right;
        first->right = first->left;
        end = &first->left;
    }
    *end = a != 0 ? a : b;
    return root;
}

int64_t flow_number(const packet *packet, const noack_stage *stage) {
    int64_t row = packet->flow - packet->link->flows, last = stage->bottleneck.flows - 1;
    return packet->link->integers[stage->bottleneck.begin + min_of(row, last)];
}

void enter_queue(packet *packet, int64_t key, int is_time) {
    noack_decision *decision = packet->decision;
    noack_link *link = packet->link;
    noack_queue *queue = &link->queues[packet->stage];
    if (decision->fate != NOACK_DELIVERED)
        return;
    noack_queue_enters(link, packet->stage, decision->arrival_ns);
    if (queue->count + queue->waits >= link->stages[packet->stage].queue_places)
        refuse(decision, NOACK_OVERFLOWED);
    if (decision->fate != NOACK_DELIVERED)
        return;
    int64_t begin_ns = max_of(queue->entry_ns, queue->busy_until_ns);
    decision->waits = 1;
    decision->key = key + (is_time ? queue->entry_ns : 0);
    decision->after_ns = -(begin_ns + 1);
    decision->release_ns += begin_ns + 1 - decision->arrival_ns;
}

void wait_for_link(
    noack_link *link, noack_waiting *waiting, int64_t place, int64_t order,
    const noack_decision *decision) {
    noack_queue *queue = &link->queues[link->scheduler];
    waiting[place] = (noack_waiting){
        .key = decision->key,
        .order = order,
        .size_bytes = decision->size_bytes,
        .after_ns = decision->after_ns,
        .earliest_ns = decision->release_ns,
    };
    queue->waiting = merge(waiting, queue->waiting, place + 1);
    queue->waits++;
}

int begin_sending(
    noack_link *link, noack_waiting *waiting, int64_t now_ns, noack_heap_entry *entry) {
    if (link->scheduler < 0)
        return 0;
    noack_queue *queue = &link->queues[link->scheduler];
    if (queue->waiting == 0 || queue->busy_until_ns > now_ns)
        return 0;
    int64_t place = queue->waiting - 1;
    const noack_waiting *next = &waiting[place];
    queue->waiting = merge(waiting, next->left, next->right);
    queue->waits--;
    int64_t end_ns = noack_queue_serve(link, link->scheduler, next->size_bytes);
    int64_t release_ns = max_of(end_ns + next->after_ns, next->earliest_ns);
    *entry = (noack_heap_entry){release_ns, next->order, place};
    return 1;
}
