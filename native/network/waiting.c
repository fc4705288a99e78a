/* The scheduler of a bottleneck: whenever the link is free, it sends the waiting packet with the
   smallest key. So a departure depends on later arrivals.

   Whether a packet is lost is decided at its arrival all the same, and so is the earliest time at
   which it can leave. A packet that is not lost waits in a heap (a skew heap: Sleator and Tarjan,
   1986), whose nodes the relay or the channel has, one for each place of a stored datagram. The
   packet being sent has left the heap; its departure is known. At its departure, and at each
   arrival, what could begin until then begins (serve). This is soon enough: what begins at a time
   depends on earlier arrivals only; and no packet leaves before it has been sent, so that while
   packets wait, there will be a departure. (If a clock ran backward, so that there is none, the
   next one begins at once.) Constant delays before and after the queue have the same effect, and
   are added to the departure.

   The guarantee needs none of these times, only an order: a flow's packets leave in the order of
   their arrival. A packet that arrives with a smaller key than those of its flow that wait gives it
   to them. So the keys of a flow's waiting packets do not decrease: they begin in this order, and
   none is given a departure before that of an earlier one (first_release_ns, the last departure
   of the flow). So no packet is ever stale, whatever the other stages do: the losses are those that
   are decided at the arrivals, which noack_must_pass allows, and no packet needs to be held back
   for others. */
#include "network.h"

static int is_before(const noack_waiting *a, const noack_waiting *b) {
    return a->key < b->key || (a->key == b->key && a->order < b->order);
}

/* Merge two heaps, each given by its first place + 1; 0: an empty one. The first of the result has
   no parent. */
static int64_t merge(noack_waiting *waiting, int64_t a, int64_t b) {
    int64_t root = 0, *end = &root, parent = 0;
    while (a != 0 && b != 0) {
        if (is_before(&waiting[b - 1], &waiting[a - 1])) {
            int64_t other = a;
            a = b;
            b = other;
        }
        noack_waiting *first = &waiting[a - 1];
        *end = a;
        first->parent = parent;
        parent = a;
        a = first->right;
        first->right = first->left;
        end = &first->left;
    }
    *end = a != 0 ? a : b;
    if (*end != 0)
        waiting[*end - 1].parent = parent;
    return root;
}

/* Give the waiting packet at a place a smaller key. */
static void lower_key(
    noack_stage_state *queue, noack_waiting *waiting, int64_t place, int64_t key) {
    noack_waiting *waiter = &waiting[place];
    waiter->key = key;
    if (waiter->parent == 0)
        return;
    noack_waiting *parent = &waiting[waiter->parent - 1];
    *(parent->left == place + 1 ? &parent->left : &parent->right) = 0;
    queue->first_waiting = merge(waiting, queue->first_waiting, place + 1);
}

int64_t flow_table_entry(const packet *packet, const noack_stage *stage) {
    int64_t row = packet->flow - packet->link->flows, last = stage->bottleneck.flows - 1;
    return packet->link->integers[stage->bottleneck.begin + min_of(row, last)];
}

void enter_queue(packet *packet, int64_t key, int is_time) {
    noack_decision *decision = packet->decision;
    noack_link *link = packet->link;
    noack_stage_state *queue = &link->stage_states[packet->stage];
    if (!copy_in(packet)->exists)
        return;
    const noack_stage *stage = &link->stages[packet->stage];
    int64_t line_bytes = line_bytes_of(&stage->bottleneck, decision->size_bytes);
    int64_t sent_bytes = queue_bytes_at(link, packet->stage, decision->arrival_ns);
    if (queue->count + queue->waiting_count >= stage->queue_places
        || !fits_queue(&stage->bottleneck, sent_bytes + queue->waiting_bytes, line_bytes))
        lose(packet, NOACK_OVERFLOWED);
    if (!copy_in(packet)->exists)
        return;
    int64_t begin_ns = max_of(queue->entry_ns, queue->busy_until_ns);
    decision->waits = 1;
    decision->key = key + (is_time ? queue->entry_ns : 0);
    decision->after_ns = -(begin_ns + 1); /* negative until all stages have seen the packet */
    copy_in(packet)->time_ns += begin_ns + 1 - decision->arrival_ns;
}

void complete_waiting_decision(packet *packet) {
    noack_decision *decision = packet->decision;
    int64_t least_ns = -decision->after_ns, first_ns = INT64_MAX;
    for (packet->copy = 0; packet->copy < COPIES; packet->copy++) {
        packet_copy *copy = copy_in(packet);
        copy->time_ns = max_of(copy->time_ns, least_ns);
        if (copy->exists)
            first_ns = min_of(first_ns, copy->time_ns);
    }
    decision->after_ns = first_ns == INT64_MAX ? 0 : first_ns - least_ns;
}

/* The bytes of a waiting packet in the queue. */
static int64_t waiting_bytes_of(const noack_link *link, int64_t size_bytes) {
    return queued_bytes(line_bytes_of(&link->stages[link->scheduler].bottleneck, size_bytes));
}

void wait_for_link(
    noack_link *link, int64_t row, noack_waiting *waiting, int64_t place, int64_t order,
    const noack_decision *decision) {
    noack_stage_state *queue = &link->stage_states[link->scheduler];
    noack_flow *flow = &link->flows[row];
    int64_t earlier = flow->last_waiting, key = decision->key;
    waiting[place] = (noack_waiting){
        .key = key,
        .order = order,
        .row = row,
        .size_bytes = decision->size_bytes,
        .after_ns = decision->after_ns,
        .earliest_ns = decision->release_ns,
        .before = earlier,
    };
    queue->first_waiting = merge(waiting, queue->first_waiting, place + 1);
    queue->waiting_count++;
    queue->waiting_bytes += waiting_bytes_of(link, decision->size_bytes);
    for (int64_t left = flow->waiting_count; left > 0 && waiting[earlier].key > key; left--) {
        lower_key(queue, waiting, earlier, key);
        earlier = waiting[earlier].before;
    }
    flow->last_waiting = place;
    flow->waiting_count++;
}

void serve(
    noack_link *link, noack_waiting *waiting, int64_t now_ns, noack_heap_entry *heap,
    int64_t *count) {
    if (link->scheduler < 0)
        return;
    noack_stage_state *queue = &link->stage_states[link->scheduler];
    while (queue->first_waiting != 0
           && (queue->busy_until_ns <= now_ns || link->in_flight == queue->waiting_count)) {
        int64_t place = queue->first_waiting - 1;
        const noack_waiting *next = &waiting[place];
        noack_flow *flow = &link->flows[next->row];
        queue->first_waiting = merge(waiting, next->left, next->right);
        queue->waiting_count--;
        queue->waiting_bytes -= waiting_bytes_of(link, next->size_bytes);
        flow->waiting_count--;
        int64_t end_ns = noack_queue_serve(link, link->scheduler, next->size_bytes);
        int64_t leaves_ns = max_of(end_ns + next->after_ns, next->earliest_ns);
        flow->first_release_ns = max_of(flow->first_release_ns, leaves_ns);
        noack_heap_push(
            heap, count, (noack_heap_entry){flow->first_release_ns, next->order, place});
    }
}
