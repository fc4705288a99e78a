/* Periodic losses, according to the packet's number in its flow. */
#include "../core.h"

void apply_periodic(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    const noack_periodic *own = &stage->periodic;
    int64_t number = packet->decision->packet - own->first;
    if (number >= 0 && number % own->period < own->burst)
        refuse(packet->decision, NOACK_DROPPED);
}
