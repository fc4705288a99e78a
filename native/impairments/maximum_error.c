/* Maximum error first: whenever the link is free, it sends the oldest waiting packet of the flow
   that has the packet with the largest error level among all that wait (docs/wire.md). */
#include "../network/network.h"

void apply_maximum_error(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)stage, (void)memory;
    enter_queue(packet, -packet->flow->error_level, 0);
}
