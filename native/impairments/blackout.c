/* Blackouts: intervals of time in which all packets are lost. */
#include "../network/network.h"

void apply_blackout(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_blackout *settings = &stage->blackout;
    const int64_t *times_ns = packet->link->integers;
    int64_t now_ns = copy_in(packet)->time_ns;
    if (settings->period_ns > 0 && now_ns >= 0)
        now_ns %= settings->period_ns;
    int64_t count = (settings->end - settings->begin) / 2;
    int64_t place = first_above(times_ns, settings->begin + count, settings->end, now_ns);
    if (place < settings->end && times_ns[place - count] <= now_ns)
        lose(packet, NOACK_BLACKED_OUT);
}
