/* Earliest deadline first: whenever the link is free, it sends the waiting packet whose deadline is
   the earliest. A packet's deadline is a time of its flow after its arrival. */
#include "../network/network.h"

void apply_earliest_deadline(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    (void)memory;
    enter_queue(packet, flow_table_entry(packet, stage), 1);
}
