/* The rows of a run's record, and the buckets of histograms.

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

/* Whether a row of each table fits, if there is a record. */
int has_room(const noack_relay *relay) {
    return !relay->records
           || (relay->packet_rows < relay->row_count && relay->release_rows < relay->row_count);
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
