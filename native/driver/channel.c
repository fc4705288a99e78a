/* The network of a run as a machine without sockets: both directions between sensors and
   controllers. A simulation and a replay drive it; the relay of a live run decides alike.

   Datagrams come in; those that survive go out, at once or later. Each input has one row of the
   record, numbered over both directions. */
#include <stdlib.h>

#include "channel.h"

enum { FIRST_PLACES = 64, ROWS = 4096 };

/* A delayed datagram or copy. */
struct noack_delayed {
    int64_t packet;
    int64_t copy;
    int64_t counts;  /* 1: it is the datagram's first intact copy */
    int64_t delayed; /* 0: an overdue one was before it */
    int64_t next;    /* next free place */
    noack_datagram datagram;
};

/* Double the room for delayed datagrams; return 0 if there is no memory. */
static int add_places(noack_channel *channel) {
    int64_t before = channel->places, places = max_of(2 * before, FIRST_PLACES);
    if (!lengthen(&channel->heap, before, places, sizeof *channel->heap)
        || !lengthen(&channel->delayed, before, places, sizeof *channel->delayed)
        || !lengthen(&channel->waiting, before, places, sizeof *channel->waiting))
        return 0;
    for (int64_t i = places - 1; i >= before; i--) {
        channel->delayed[i].next = channel->free_place;
        channel->free_place = i;
    }
    channel->places = places;
    return 1;
}

noack_channel *noack_channel_new(
    int64_t loops, int64_t directions, noack_link *const *links, int64_t is_scripted,
    const char **wrong) {
    *wrong = NULL;
    if (!is_between(1, loops, MOST_LOOPS) || !is_between(1, directions, 2))
        *wrong = "a network has 1 to 65535 loops, and one or two directions";
    for (int64_t i = 0; *wrong == NULL && i < directions; i++)
        if (links[i] == NULL || links[i]->rows < loops)
            *wrong = "a direction of the network has no row for a loop";
    noack_channel *channel = *wrong == NULL ? zeros(1, sizeof *channel) : NULL;
    if (channel == NULL)
        return NULL;
    channel->loops = loops;
    channel->directions = directions;
    memcpy(channel->links, links, (size_t)directions * sizeof *links);
    channel->is_scripted = is_scripted;
    channel->reached_ns = channel->free_place = -1;
    channel->change_ns = INT64_MAX;
    channel->packets = zeros(ROWS, sizeof *channel->packets);
    channel->releases = zeros(ROWS, sizeof *channel->releases);
    if (channel->packets != NULL && channel->releases != NULL && add_places(channel))
        return channel;
    noack_channel_free(channel);
    return NULL;
}

void noack_channel_free(noack_channel *channel) {
    if (channel == NULL)
        return;
    free(channel->heap);
    free(channel->delayed);
    free(channel->waiting);
    free(channel->packets);
    free(channel->releases);
    free(channel);
}

int64_t noack_channel_due_ns(const noack_channel *channel) {
    return channel->heap_count > 0 ? channel->heap[0].due_ns : INT64_MAX;
}

static int64_t leave(noack_channel *channel, const noack_delayed *leaving) {
    const noack_datagram *datagram = &leaving->datagram;
    noack_link *link = channel->links[datagram->flow / channel->loops];
    return noack_link_leave(
        link, datagram->flow % channel->loops, leaving->packet, datagram->size_bytes,
        leaving->delayed, leaving->counts);
}

/* Whether a datagram of the same direction is due and has not left. */
static int is_behind(const noack_channel *channel, int64_t direction, int64_t release_ns) {
    if (channel->heap_count == 0 || channel->heap[0].due_ns > release_ns)
        return 0;
    for (int64_t i = 0; i < channel->heap_count; i++) {
        const noack_datagram *other = &channel->delayed[channel->heap[i].slot].datagram;
        if (channel->heap[i].due_ns <= release_ns && other->flow / channel->loops == direction)
            return 1;
    }
    return 0;
}

/* Let a datagram, or its copy, leave now, or keep it until it is due. */
static void release(
    noack_channel *channel, const noack_datagram *datagram, const noack_decision *decision,
    int copy) {
    int64_t release_ns = copy ? decision->copy_ns : decision->release_ns;
    int64_t bit = copy ? decision->copy_bit : decision->bit;
    int64_t direction = datagram->flow / channel->loops;
    noack_delayed *delayed = &channel->delayed[channel->free_place];
    delayed->packet = decision->packet;
    delayed->copy = copy;
    delayed->counts = is_first_intact(decision, copy);
    delayed->delayed = release_ns > decision->arrival_ns;
    copy_datagram(&delayed->datagram, datagram);
    delayed->datagram.bit = bit;
    if (bit >= 0 && bit < 8 * NOACK_HEAD_BYTES)
        delayed->datagram.head[bit / 8] ^= (uint8_t)(1 << (bit % 8));
    channel->delayed_count++;
    if (!decision->waits && !delayed->delayed && !is_behind(channel, direction, release_ns)) {
        leave(channel, delayed);
        copy_datagram(&channel->leaving[channel->leaving_count++], &delayed->datagram);
        return;
    }
    int64_t place = channel->free_place, order = departure_order(direction, channel->delayed_count);
    channel->free_place = delayed->next;
    if (decision->waits)
        wait_for_link(
            channel->links[direction], datagram->flow % channel->loops, channel->waiting, place,
            order, decision);
    else
        noack_heap_push(
            channel->heap, &channel->heap_count, (noack_heap_entry){release_ns, order, place});
}

int64_t noack_channel_handle(
    noack_channel *channel, const noack_datagram *datagram, int64_t now_ns) {
    int64_t direction = datagram->flow / channel->loops, row = datagram->flow % channel->loops;
    int asks = channel->is_scripted && direction == 0;
    noack_link *link = channel->links[direction];
    noack_decision decision;
    channel->leaving_count = 0;
    if (now_ns >= channel->change_ns)
        return NOACK_ASK_CHANGE;
    if (channel->packet_count == ROWS)
        return NOACK_ROWS_FULL;
    if ((channel->free_place < 0 || channel->delayed[channel->free_place].next < 0)
        && !add_places(channel))
        return NOACK_NO_MEMORY;
    if (asks && !channel->answered) {
        copy_datagram(&channel->asked, datagram);
        channel->asked_ns = now_ns;
        return NOACK_ASK_OUTCOME;
    }
    channel->answered = 0;
    channel->reached_ns = now_ns;
    serve(link, channel->waiting, now_ns, channel->heap, &channel->heap_count);
    link->flows[row].error_level = header_error_level(datagram->head, datagram->size_bytes);
    if (asks)
        decide_for(link, row, datagram->size_bytes, now_ns, &channel->outcome_ns, &decision);
    else
        noack_link_decide(link, row, datagram->size_bytes, now_ns, &decision);
    channel->packets[channel->packet_count++] = packet_row(
        &decision, channel->inputs++, datagram->arrival_ns, datagram->flow, datagram->head);
    if (decision.release_ns != NOACK_NEVER_NS)
        release(channel, datagram, &decision, 0);
    if (decision.copy_ns != NOACK_NEVER_NS)
        release(channel, datagram, &decision, 1);
    serve(link, channel->waiting, now_ns, channel->heap, &channel->heap_count);
    return NOACK_DONE;
}

int64_t noack_channel_release(noack_channel *channel, int64_t now_ns) {
    channel->leaving_count = 0;
    if (channel->release_count == ROWS)
        return NOACK_ROWS_FULL;
    noack_heap_entry entry = channel->heap[0];
    noack_delayed *leaving = &channel->delayed[entry.slot];
    noack_heap_pop(channel->heap, &channel->heap_count);
    channel->releases[channel->release_count++] = (noack_release_row){
        .input = channel->inputs++,
        .sequence = leaving->packet,
        .t_ns = entry.due_ns,
        .now_ns = now_ns,
        .flow = leaving->datagram.flow,
        .copy = leaving->copy,
        .stale = leave(channel, leaving),
    };
    copy_datagram(&channel->leaving[channel->leaving_count++], &leaving->datagram);
    leaving->next = channel->free_place;
    channel->free_place = entry.slot;
    serve(
        channel->links[leaving->datagram.flow / channel->loops], channel->waiting, entry.due_ns,
        channel->heap, &channel->heap_count);
    return NOACK_DONE;
}

void noack_channel_latest(noack_channel *channel, int64_t direction, int64_t *latest_ns) {
    serve(
        channel->links[direction], channel->waiting, INT64_MAX, channel->heap,
        &channel->heap_count);
    for (int64_t i = 0; i < channel->heap_count; i++) {
        const noack_datagram *delayed = &channel->delayed[channel->heap[i].slot].datagram;
        int64_t row = delayed->flow % channel->loops;
        if (delayed->flow / channel->loops == direction)
            latest_ns[row] = max_of(latest_ns[row], channel->heap[i].due_ns);
    }
}
