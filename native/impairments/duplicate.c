/* Duplicates: a packet is sent twice. */
#include "../core.h"

void apply_duplicate(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    draw(packet, stage, 0, uniform);
    if (happens(&stage->chance, memory, uniform[0])) {
        packet->decision->copy_ns = packet->decision->release_ns;
        packet->decision->copy_bit = packet->decision->bit;
    }
}
