/* Losses given by a list of packet numbers within a flow. */
#include "../network/network.h"

void apply_scripted(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_scripted *settings = &stage->scripted;
    const int64_t *numbers = packet->link->integers;
    int64_t number = packet->decision->packet;
    if (settings->period > 0)
        number %= settings->period;
    int64_t place = first_above(numbers, settings->begin, settings->end, number - 1);
    if (place < settings->end && numbers[place] == number)
        lose(packet, NOACK_DROPPED);
}
