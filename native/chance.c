/* Random events with a given probability and a correlation between successive packets.

   The latent variable z_i = rho z_(i-1) + sqrt(1 - rho^2) g_i is a stationary Gaussian process. The
   event happens to packet i if z_i exceeds the normal quantile of 1 - p, hence with probability p
   exactly, for every rho. */
#include "core.h"

/* Advance a latent process by one packet and return z, standard normal; u is uniform. */
double latent(double correlation, double innovation, noack_stage_memory *memory, double u) {
    double z = -noack_normal_score(u);
    if (correlation != 0.0) {
        if (memory->phase != 0)
            z = correlation * memory->score + innovation * z;
        memory->phase = 1;
        memory->score = z;
    }
    return z;
}

/* Whether the event happens to the next packet; u is a uniform number. */
int happens(const noack_chance *chance, noack_stage_memory *memory, double u) {
    if (chance->correlation == 0.0)
        return u < chance->probability;
    return latent(chance->correlation, chance->innovation, memory, u) > chance->threshold;
}
