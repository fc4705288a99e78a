/* Reordering: a packet leaves at once instead of being delayed. */
#include "../core.h"

/* Draw whether a gap-th packet's delay is undone; every packet advances the latent process. */
void apply_reorder(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    draw(packet, stage, 0, uniform);
    int chosen = happens(&stage->chance, memory, uniform[0]);
    if (chosen && (packet->decision->packet + 1) % stage->chance.gap == 0)
        packet->decision->release_ns = packet->decision->arrival_ns;
}
