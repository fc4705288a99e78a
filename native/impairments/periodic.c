/* Periodic losses, according to the packet's number in its flow. */
#include "../network/network.h"

void apply_periodic(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_periodic *settings = &stage->periodic;
    int64_t number = packet->decision->packet - settings->first;
    if (number >= 0 && number % settings->period < settings->burst)
        lose(packet, NOACK_DROPPED);
}
