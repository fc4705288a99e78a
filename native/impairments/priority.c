/* Priorities: whenever the link is free, it sends the waiting packet of the flow with the smallest
   number; flows with the same number in order of arrival. */
#include "../network/network.h"

void apply_priority(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    enter_queue(packet, flow_table_entry(packet, stage), 0);
}
