/* Bursty losses: a two-state Markov chain (Gilbert, 1960; Elliott, 1963), of each flow or, with a
   step, of the link. */
#include "../network/network.h"

enum { GOOD, BAD };

/* Draw the link's state now, given that at the last packet.

   After k steps the probability of the bad state is s + (b - s) lambda^k with b = 1 if the chain
   was in the bad state, else 0, s = p/(p + r) and lambda = 1 - p - r. The power is computed by
   squaring, so that every machine has the same bits. */
static void change_state(
    const noack_gilbert_elliott *settings, noack_stage_state *common, int64_t now_ns, double u) {
    int64_t steps = max_of(floor_div(now_ns, settings->step_ns) - common->step, 0);
    common->step += steps;
    double base = 1.0 - settings->good_to_bad - settings->bad_to_good, power = 1.0;
    for (; steps > 0; steps >>= 1) {
        if (steps & 1)
            power *= base;
        base *= base;
    }
    double bad = settings->share_bad, before = common->state == BAD ? 1.0 : 0.0;
    common->state = u < bad + (before - bad) * power ? BAD : GOOD;
}

/* If a delay is correlated with loss, the packet gets a score: the scores in the bad state are the
   highest share p/(p + r) of all scores. */
void apply_gilbert_elliott(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    const noack_gilbert_elliott *settings = &stage->gilbert_elliott;
    double uniform[2], other[2];
    draw(packet, stage, 0, uniform);
    if (settings->step_ns > 0) {
        noack_stage_state *common = &packet->link->stage_states[packet->stage];
        change_state(settings, common, copy_in(packet)->time_ns, uniform[0]);
        memory->state = common->state;
    } else if (memory->state == BAD) {
        if (uniform[0] < settings->bad_to_good)
            memory->state = GOOD;
    } else if (uniform[0] < settings->good_to_bad) {
        memory->state = BAD;
    }
    if (settings->scored) {
        draw(packet, stage, 1, other);
        double bad = settings->share_bad;
        copy_in(packet)->score = -noack_normal_score(
            memory->state == BAD ? other[0] * bad : bad + other[0] * (1.0 - bad));
    }
    if (uniform[1] < (memory->state == BAD ? settings->loss_in_bad : settings->loss_in_good))
        lose(packet, NOACK_DROPPED);
}
