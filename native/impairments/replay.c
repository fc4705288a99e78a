/* Replays a packet trace: the recorded loss and delay of each packet.

   By packet, packet k of a flow gets record k. By time, a packet gets the loss of the last record
   that was sent before it. Its receiving time is interpolated between those of the two records
   around it, so that a network that keeps the order of the recorded packets keeps the order of all
   packets. */
#include "../network/network.h"

/* change * elapsed / gap for 0 <= elapsed < gap; it ascends with elapsed + result. Whole numbers,
   without overflow: of gaps beyond 2 s, some low bits are ignored. */
static int64_t part_of(int64_t change_ns, int64_t elapsed_ns, int64_t gap_ns) {
    int64_t each = floor_div(change_ns, gap_ns), part = floor_mod(change_ns, gap_ns);
    int64_t whole_ns = each * elapsed_ns, unit_ns = 1;
    for (; gap_ns >= INT64_C(2147483648); gap_ns /= 2) {
        unit_ns *= 2;
        part /= 2;
        elapsed_ns /= 2;
    }
    return whole_ns + part * elapsed_ns / gap_ns * unit_ns;
}

/* The delay of a packet by its time in the trace, or -1 - d for a lost packet. */
static int64_t delay_at(const noack_replay *settings, const int64_t *table, int64_t elapsed_ns) {
    int64_t count = settings->end - settings->begin;
    int64_t high =
        first_above(table, settings->times_begin, settings->times_begin + count, elapsed_ns)
        - settings->times_begin;
    int64_t low = max_of(high - 1, 0); /* the last record that is not later */
    int64_t delay_ns = table[settings->begin + low];
    if (delay_ns < 0 || high == count || table[settings->begin + high] < 0)
        return delay_ns;
    int64_t sent_ns = table[settings->times_begin + low];
    int64_t gap_ns = table[settings->times_begin + high] - sent_ns;
    return delay_ns
           + part_of(table[settings->begin + high] - delay_ns, elapsed_ns - sent_ns, gap_ns);
}

/* Lose or delay the packet as recorded. */
void apply_replay(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_replay *settings = &stage->replay;
    const int64_t *table = packet->link->integers;
    int64_t delay_ns = 0;
    if (settings->period_ns > 0) {
        int64_t elapsed_ns = copy_in(packet)->time_ns + settings->offset;
        if (!settings->once || (0 <= elapsed_ns && elapsed_ns < settings->period_ns))
            delay_ns = delay_at(settings, table, floor_mod(elapsed_ns, settings->period_ns));
    } else {
        int64_t record = packet->decision->packet + settings->offset,
                count = settings->end - settings->begin;
        if (!settings->once || record < count)
            delay_ns = table[settings->begin + record % count];
    }
    if (delay_ns < 0) {
        lose(packet, NOACK_DROPPED);
        delay_ns = -1 - delay_ns;
    }
    copy_in(packet)->time_ns += delay_ns;
}
