/* Losses given by a list of packet numbers within a flow. */
#include "../core.h"

void apply_scripted(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_scripted *own = &stage->scripted;
    const int64_t *numbers = packet->link->integers;
    int64_t wanted = packet->decision->packet;
    if (own->period > 0)
        wanted %= own->period;
    int64_t place = first_above(numbers, own->begin, own->end, wanted - 1);
    if (place < own->end && numbers[place] == wanted)
        refuse(packet->decision, NOACK_DROPPED);
}
