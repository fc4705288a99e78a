/* What the relay and the channel of a simulation share: rows of the record, the order of
   departures. */
#include <string.h>

#include "network.h"

noack_packet_row packet_row(
    const noack_decision *decision, int64_t input, int64_t arrival_ns, int64_t flow,
    const uint8_t *data) {
    noack_packet_row row = {
        .input = input,
        .sequence = decision->packet,
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

int64_t departure_order(int64_t direction, int64_t delayed_count) {
    return (direction << 62) + delayed_count;
}
