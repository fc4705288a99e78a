/* Bursty and isolated losses: a Markov chain of four states (Salsano, Ludovici & Ordine).

   1: gap, delivered. 2: delivered within a burst. 3: lost within a burst. 4: a single loss within a
   gap. It starts in state 1 and advances before each packet. From state 4 it returns to 1. */
#include "../network/network.h"

void apply_four_state(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    const noack_four_state *settings = &stage->four_state;
    double uniform[2];
    draw(packet, stage, 0, uniform);
    double u = uniform[0];
    int64_t state = memory->state + 1;
    if (state == 1) {
        if (u < settings->p13)
            state = 3;
        else if (u < settings->p13 + settings->p14)
            state = 4;
    } else if (state == 2) {
        if (u < settings->p23)
            state = 3;
    } else if (state == 3) {
        if (u < settings->p31)
            state = 1;
        else if (u < settings->p31 + settings->p32)
            state = 2;
    } else {
        state = 1;
    }
    memory->state = state - 1;
    if (state >= 3)
        lose(packet, NOACK_DROPPED);
}
