/* Bursty and isolated losses: a Markov chain of four states (Salsano, Ludovici & Ordine).

   1: gap, delivered. 2: delivered within a burst. 3: lost within a burst. 4: a single loss within a
   gap. It starts in state 1 and advances before each packet. From state 4 it returns to 1. */
#include "../core.h"

void apply_four_state(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    const noack_four_state *own = &stage->four_state;
    double uniform[2];
    draw(packet, stage, 0, uniform);
    double u = uniform[0];
    int64_t now = memory->state + 1;
    if (now == 1) {
        if (u < own->p13)
            now = 3;
        else if (u < own->p13 + own->p14)
            now = 4;
    } else if (now == 2) {
        if (u < own->p23)
            now = 3;
    } else if (now == 3) {
        if (u < own->p31)
            now = 1;
        else if (u < own->p31 + own->p32)
            now = 2;
    } else {
        now = 1;
    }
    memory->state = now - 1;
    if (now >= 3)
        refuse(packet->decision, NOACK_DROPPED);
}
