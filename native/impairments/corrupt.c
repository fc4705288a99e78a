/* Corruption: one bit of the payload is flipped. */
#include "../core.h"

/* Draw whether a bit of the packet, and of its copy, is flipped; not of an empty payload. */
void apply_corrupt(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    noack_decision *decision = packet->decision;
    double uniform[2];
    draw(packet, stage, 0, uniform);
    int corrupts = happens(&stage->chance, memory, uniform[0]);
    int64_t bits = decision->size_bytes * 8;
    if (bits == 0)
        return;
    if (decision->must_pass) {
        if (corrupts)
            decision->loss_suppressed = 1;
        return;
    }
    if (corrupts)
        decision->bit = (int64_t)(uniform[1] * (double)bits);
    if (decision->copy_ns != NOACK_NEVER_NS) {
        draw(packet, stage, 1, uniform);
        if (uniform[0] < stage->chance.probability)
            decision->copy_bit = (int64_t)(uniform[1] * (double)bits);
    }
}
