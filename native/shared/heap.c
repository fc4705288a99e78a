/* A heap of what is due: delayed datagrams, or the next ticks of loops. */
#include "shared.h"

static int is_before(const noack_heap_entry *a, const noack_heap_entry *b) {
    return a->due_ns < b->due_ns || (a->due_ns == b->due_ns && a->number < b->number);
}

void noack_heap_push(noack_heap_entry *heap, int64_t *count, noack_heap_entry entry) {
    int64_t place = (*count)++;
    while (place > 0 && is_before(&entry, &heap[(place - 1) / 2])) {
        heap[place] = heap[(place - 1) / 2];
        place = (place - 1) / 2;
    }
    heap[place] = entry;
}

void noack_heap_pop(noack_heap_entry *heap, int64_t *count) {
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
