/* Bernoulli losses: each packet is lost with a probability, independently unless correlated. */
#include "../network/network.h"

void apply_bernoulli(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    const noack_chance *chance = &stage->chance;
    double uniform[2];
    draw(packet, stage, 0, uniform);
    if (happens(chance, memory, uniform[0]))
        lose(packet, NOACK_DROPPED);
    if (chance->scored) /* for a delay that is correlated with loss */
        copy_in(packet)->score =
            chance->correlation == 0.0 ? -noack_normal_score(uniform[0]) : memory->score;
}
