/* What the relay and the channel of a simulation share: rows of the record, and the heap of delayed
   datagrams. */
#include <string.h>

#include "core.h"

noack_packet_row packet_row(
    const noack_decision *decision, int64_t input, int64_t first_number, int64_t arrival_ns,
    int64_t flow, const uint8_t *data) {
    noack_packet_row row = {
        .input = input,
        .sequence = first_number + decision->packet,
        .t_ns = min_of(arrival_ns, decision->arrival_ns),
        .now_ns = decision->arrival_ns,
        .flow = flow,
        .fate = decision->fate,
        .consecutive_losses = decision->consecutive_losses,
        .release_ns = decision->release_ns,
        .copy_ns = decision->copy_ns,
        .bit = decision->bit,
        .size_bytes = decision->size_bytes,
    };
    memcpy(row.head, data, (size_t)min_of(decision->size_bytes, NOACK_HEAD_BYTES));
    return row;
}

int is_first_intact(const noack_decision *decision, int copy) {
    return copy ? decision->bit >= 0 && decision->copy_bit < 0 : decision->bit < 0;
}

int64_t departure_order(int64_t direction, int64_t put) { return (direction << 62) + put; }

static int is_before(const noack_heap_entry *a, const noack_heap_entry *b) {
    return a->due_ns < b->due_ns || (a->due_ns == b->due_ns && a->number < b->number);
}

void heap_push(noack_heap_entry *heap, int64_t *count, noack_heap_entry entry) {
    int64_t place = (*count)++;
    while (place > 0 && is_before(&entry, &heap[(place - 1) / 2])) {
        heap[place] = heap[(place - 1) / 2];
        place = (place - 1) / 2;
    }
    heap[place] = entry;
}

void heap_pop(noack_heap_entry *heap, int64_t *count) {
    noack_heap_entry last = heap[--*count];
    int64_t place = 0;
    for (;;) {
        int64_t below = 2 * place + 1;
        if (below >= *count)
            break;
        if (below + 1 < *count && is_before(&heap[below + 1], &heap[below]))
            below++;
        if (!is_before(&heap[below], &last))
            break;
        heap[place] = heap[below];
        place = below;
    }
    heap[place] = last;
}
