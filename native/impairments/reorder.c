/* Reordering: a packet leaves at once instead of being delayed. As in tc, after a packet that left
   at once gap - 1 are delayed; then each packet is a candidate until a draw succeeds. So with
   probability P a share 1/(gap - 1 + 1/P) leaves at once, for every correlation: it is that of the
   candidates' draws. */
#include "../network/network.h"

void apply_reorder(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    if (!copy_in(packet)->exists)
        return;
    draw(packet, stage, 0, uniform);
    int is_candidate = memory->delayed >= stage->chance.gap - 1;
    if (is_candidate && happens(&stage->chance, memory, uniform[0])) {
        copy_in(packet)->time_ns = packet->decision->arrival_ns;
        memory->delayed = 0;
    } else {
        memory->delayed++;
    }
}
