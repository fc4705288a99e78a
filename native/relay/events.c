/* The events that the relay reports to taps, and the rows of a run's record.

   Rows are numbered in the order in which the core decides: a replay decides in the same order. */
#include "relay.h"

#include <string.h>

enum { STEP_BITS = 5, STEPS = 1 << STEP_BITS, MOST_BITS = 44 };

/* Times below 0 count as 0; the last bucket also counts all longer times. */
int64_t noack_bucket_of(int64_t t_ns) {
    if (t_ns < STEPS)
        return max_of(t_ns, 0);
    if (t_ns >> MOST_BITS != 0)
        return NOACK_BUCKETS - 1;
    int64_t shift = 63 - __builtin_clzll((uint64_t)t_ns) - STEP_BITS;
    return (shift << STEP_BITS) + (t_ns >> shift);
}

/* Whether three events fit: arrival of a datagram, its departure, its copy's departure. If there is
   a record: also whether a row of each table fits. */
int has_room(const noack_relay *relay, int64_t size_bytes) {
    const relay_scratch *scratch = scratch_of(relay);
    if (relay->records
        && (relay->packet_rows == relay->row_count || relay->release_rows == relay->row_count))
        return 0;
    if (relay->taps == 0)
        return 1;
    if (relay->event_length + scratch->leaving_count + 3 > relay->event_count)
        return 0;
    return relay->taps == 1
           || relay->data_length + scratch->leaving_bytes + 3 * size_bytes <= relay->data_bytes;
}

/* Copy a socket address's host; return its port. */
static uint16_t put_host(const uint8_t *name, uint8_t host[16], uint8_t *family) {
    uint16_t kind;
    memcpy(&kind, name, sizeof kind);
    memset(host, 0, 16);
    *family = kind == AF_INET ? 4 : 6;
    memcpy(host, name + (kind == AF_INET ? 4 : 8), kind == AF_INET ? 4 : 16);
    return (uint16_t)(name[2] << 8 | name[3]);
}

/* The next event of a direction and a client, on one side of the link, with its addresses. */
static noack_event *next_event(
    noack_relay *relay, int64_t direction, int64_t client, int server_side) {
    const noack_client *entry = &relay->clients[client];
    const noack_direction *forward = &relay->directions[direction & ~INT64_C(1)];
    const uint8_t *near = server_side ? entry->local : entry->name;
    const uint8_t *far = server_side ? forward->name : forward->listen;
    noack_event *event = &relay->events[relay->event_length++];
    *event = (noack_event){
        .flow = entry->number,
        .mansd = relay->directions[direction].link->mansd,
        .copy_delay_ns = -1,
        .copy_bit = -1,
        .offset = (uint64_t)relay->data_length,
        .link = (uint32_t)(direction >> 1),
        .interface = (uint32_t)((direction & ~INT64_C(1)) + server_side),
        .direction = direction & 1,
    };
    int reverse = direction & 1;
    if (relay->devices)
        return event;
    event->source_port = put_host(reverse ? far : near, event->source, &event->family);
    event->destination_port = put_host(reverse ? near : far, event->destination, &event->family);
    return event;
}

static int64_t delay_until(int64_t t_ns, int64_t now_ns) {
    return t_ns == NOACK_NEVER_NS ? -1 : t_ns - now_ns;
}

void report_arrival(
    noack_relay *relay, int64_t direction, int64_t client, const uint8_t *data, int64_t size_bytes,
    const noack_decision *decision) {
    noack_event *event = next_event(relay, direction, client, direction & 1);
    event->t_ns = relay->unix_ns + relay->now_ns;
    event->packet = decision->packet;
    event->fate = (uint8_t)decision->fate;
    event->size_bytes = (uint32_t)size_bytes;
    event->consecutive_losses = decision->consecutive_losses;
    event->delay_ns = delay_until(decision->release_ns, relay->now_ns);
    event->copy_delay_ns = delay_until(decision->copy_ns, relay->now_ns);
    event->hold_back_ns = decision->hold_back_ns;
    event->bit = decision->bit;
    event->copy_bit = decision->copy_bit;
    if (relay->taps == 2) {
        memcpy(relay->data + relay->data_length, data, (size_t)size_bytes);
        relay->data_length += size_bytes;
    }
}

void report_departure(noack_relay *relay, const departure *leaving, int64_t now_ns) {
    int64_t direction = leaving->datagram.direction;
    noack_event *event =
        next_event(relay, direction, leaving->datagram.client, 1 - (direction & 1));
    event->t_ns = relay->unix_ns + now_ns;
    event->packet = leaving->datagram.packet;
    event->fate = leaving->datagram.fate;
    event->size_bytes = (uint32_t)leaving->datagram.size_bytes;
    event->delay_ns = now_ns - leaving->datagram.arrival_ns;
    event->bit = leaving->datagram.bit;
    event->departure = 1;
    event->copy = leaving->datagram.copy;
    event->stale = leaving->stale;
    if (relay->taps == 2) {
        uint8_t *place = relay->data + relay->data_length;
        if (leaving->slot < 0)
            memcpy(place, leaving->address, (size_t)leaving->datagram.size_bytes);
        else
            copy_payload(relay, leaving->slot, place);
        relay->data_length += leaving->datagram.size_bytes;
    }
}

void record_packet(
    noack_relay *relay, int64_t direction, int64_t client, const uint8_t *data,
    const noack_decision *decision) {
    relay->packets[relay->packet_rows++] = packet_row(
        decision, relay->inputs++, scratch_of(relay)->arrival_ns, relay->loops * direction + client,
        data);
}

/* The delayed datagram leaves at now_ns. */
void record_release(noack_relay *relay, const departure *leaving, int64_t now_ns) {
    relay->releases[relay->release_rows++] = (noack_release_row){
        .input = relay->inputs++,
        .sequence = leaving->datagram.packet,
        .t_ns = leaving->release_ns,
        .now_ns = now_ns,
        .flow = relay->loops * leaving->datagram.direction + leaving->datagram.client,
        .copy = leaving->datagram.copy,
        .stale = leaving->stale,
    };
}
