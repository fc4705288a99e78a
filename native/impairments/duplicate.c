/* Duplicates: a packet is sent twice. Each copy passes the later stages by itself.

   If two copies are on their way already, there is no third one. If the first was lost, the copy of
   the second takes its place. */
#include "../network/network.h"

void apply_duplicate(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    draw(packet, stage, 0, uniform);
    if (packet->copy == ORIGINAL && happens(&stage->chance, memory, uniform[0])) {
        packet_copy *copies = packet->copies;
        if (copies[ORIGINAL].exists && !copies[DUPLICATE].exists)
            copies[DUPLICATE] = copies[ORIGINAL];
        else if (copies[DUPLICATE].exists && !copies[ORIGINAL].exists)
            copies[ORIGINAL] = copies[DUPLICATE];
    }
}
