/* The worst case: as many losses as the guarantee allows. */
#include "../network/network.h"

void apply_worst_case(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)stage, (void)memory;
    lose(packet, NOACK_DROPPED);
}
