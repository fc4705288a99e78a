/* Corruption: one bit of the payload is flipped. */
#include "../network/network.h"

/* Draw whether a bit is flipped; not of an empty payload. */
void apply_corrupt(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    draw(packet, stage, 0, uniform);
    int corrupts = happens(&stage->chance, memory, uniform[0]);
    int64_t bits = packet->decision->size_bytes * 8;
    if (!corrupts || bits == 0)
        return;
    if (is_needed(packet))
        packet->decision->loss_suppressed = 1;
    else
        copy_in(packet)->bit = (int64_t)(uniform[1] * (double)bits);
}
