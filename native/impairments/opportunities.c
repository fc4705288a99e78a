/* A queue that packets leave at recorded delivery opportunities: the link model of mahimahi.

   An opportunity carries up to 1504 bytes: several small packets, or a part of one, which leaves at
   the opportunity that carries its last byte. What an empty queue does not use is lost, and so is
   an opportunity at the very time of an arrival (mahimahi, link_queue.cc: rationalize and
   use_a_delivery_opportunity). The schedule repeats from its last time on. As in its
   DroppingPacketQueue, the limits count the packets that no opportunity has begun to carry.

   The times of all departures are known on arrival, as those of a bottleneck are (tail_drop.c). The
   queue's ring has the time at which an opportunity begins to carry a packet, instead of that at
   which it leaves. */
#include "../network/network.h"

enum { OPPORTUNITY_BYTES = NOACK_OPPORTUNITY_BYTES, NS_PER_MS = 1000000 };

/* The number of the first opportunity after a time, counted over all repetitions. */
static int64_t opportunity_after(
    const noack_opportunities *settings, const int64_t *times_ms, int64_t now_ns) {
    int64_t period_ns = times_ms[settings->end - 1] * NS_PER_MS;
    int64_t elapsed_ns = now_ns + settings->offset_ns, cycle = floor_div(elapsed_ns, period_ns);
    elapsed_ns -= cycle * period_ns;
    int64_t place =
        first_above(times_ms, settings->begin, settings->end - 1, elapsed_ns / NS_PER_MS);
    return cycle * (settings->end - settings->begin) + place - settings->begin;
}

/* The time of an opportunity. */
static int64_t opportunity_ns(
    const noack_opportunities *settings, const int64_t *times_ms, int64_t number) {
    int64_t count = settings->end - settings->begin, period_ms = times_ms[settings->end - 1];
    int64_t cycle = min_of(floor_div(number, count), LATEST_NS / NS_PER_MS / period_ms + 1);
    int64_t elapsed_ms = cycle * period_ms + times_ms[settings->begin + floor_mod(number, count)];
    return min_of(elapsed_ms, LATEST_NS / NS_PER_MS) * NS_PER_MS - settings->offset_ns;
}

/* Whether a packet may enter at now_ns; removes packets that are carried until then. */
static int has_room(
    noack_link *link, int64_t number, const noack_stage *stage, int64_t line_bytes,
    int64_t now_ns) {
    int64_t limit_bytes = stage->opportunities.queue_bytes;
    int64_t waiting_bytes = queue_bytes_at(link, number, now_ns);
    return link->stage_states[number].count < stage->queue_places
           && (limit_bytes == 0 || waiting_bytes + line_bytes <= limit_bytes);
}

/* Put a packet into the queue, after has_room; return its departure time. */
static int64_t carry_packet(
    noack_link *link, int64_t stage_number, const noack_stage *stage, int64_t line_bytes) {
    const noack_opportunities *settings = &stage->opportunities;
    const int64_t *times_ms = link->integers;
    noack_stage_state *queue = &link->stage_states[stage_number];
    int64_t number;
    if (queue->busy_until_ns <= queue->entry_ns) { /* it is empty, and that opportunity is over */
        number = opportunity_after(settings, times_ms, queue->entry_ns);
        queue->left_bytes = OPPORTUNITY_BYTES;
    } else {
        number = opportunity_after(settings, times_ms, queue->busy_until_ns - 1) + queue->used - 1;
        if (queue->left_bytes == 0) {
            number++;
            queue->left_bytes = OPPORTUNITY_BYTES;
        }
    }
    int64_t begin_ns = opportunity_ns(settings, times_ms, number);
    int64_t more =
        max_of(line_bytes - queue->left_bytes + OPPORTUNITY_BYTES - 1, 0) / OPPORTUNITY_BYTES;
    number += more;
    queue->left_bytes += more * OPPORTUNITY_BYTES - line_bytes;
    queue->busy_until_ns = opportunity_ns(settings, times_ms, number);
    queue->used = number - opportunity_after(settings, times_ms, queue->busy_until_ns - 1) + 1;
    queue_occupy(link, stage_number, begin_ns, line_bytes);
    return queue->busy_until_ns;
}

/* Put the packet into the queue; ignore a packet that is lost already. */
void apply_opportunities(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    packet_copy *copy = copy_in(packet);
    if (!copy->exists)
        return;
    int64_t line_bytes =
        max_of(packet->decision->size_bytes + stage->opportunities.overhead_bytes, 1);
    if (!has_room(packet->link, packet->stage, stage, line_bytes, copy->time_ns))
        lose(packet, NOACK_OVERFLOWED);
    if (copy->exists)
        copy->time_ns = carry_packet(packet->link, packet->stage, stage, line_bytes);
}
