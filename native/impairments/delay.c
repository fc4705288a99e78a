/* Delay: a constant, and a random part, drawn as the quantile of a uniform number.

   Random parts have mean 0: uniform within +- jitter; normal, Pareto (shape 3) and their mixture
   with the jitter as standard deviation. Empirical ones are interpolated between the observed
   values. */
#include <math.h>

#include "../network/network.h"

/* sqrt(3/4): the Pareto distribution with shape 3 and scale 1 has mean 3/2 and variance 3/4. */
static const double PARETO_MEAN = 1.5, PARETO_DEVIATION = 0.8660254037844386;
/* Standard deviation of N/4 + 3P/4 with the quantiles N (normal) and P (Pareto) of one uniform
   number: sqrt(5/8 + 3/8 E NP), E NP = 0.678352789549... */
static const double MIXED_DEVIATION = 0.937753856873566;
/* 11.6 days: limit of the unbounded Pareto distribution, against integer overflow. */
static const double LONGEST_NS = 1e15;

/* Quantile of the Pareto distribution with shape 3, mean 0 and standard deviation 1. */
static double pareto(double u) {
    return (1.0 / noack_cube_root(1.0 - u) - PARETO_MEAN) / PARETO_DEVIATION;
}

/* Quantile of the random part; u in [0, 1). */
double noack_delay_quantile_ns(const noack_delay *delay, const double *reals, double u) {
    switch (delay->shape) {
    case NOACK_NORMAL:
        return delay->jitter_ns * noack_normal_score(u);
    case NOACK_PARETO:
        return delay->jitter_ns * pareto(u);
    case NOACK_PARETONORMAL:
        return delay->jitter_ns * (0.25 * noack_normal_score(u) + 0.75 * pareto(u))
               / MIXED_DEVIATION;
    case NOACK_EMPIRICAL: {
        double place = u * (double)(delay->end - delay->begin - 1);
        int64_t knot = min_of((int64_t)place, delay->end - delay->begin - 2);
        double low = reals[delay->begin + knot], high = reals[delay->begin + knot + 1];
        return low + (high - low) * (place - (double)knot);
    }
    default:
        return delay->jitter_ns * (2.0 * u - 1.0);
    }
}

/* Draw a delay, in whole ns; u is a uniform number.

   A correlated delay is drawn from normal scores, which keeps its distribution: with rho the
   correlation with the loss model's score s, z = rho s + sqrt(1 - rho^2) z', and the delay is the
   quantile at Phi(z). */
static int64_t draw_delay_ns(
    const noack_delay *settings, packet *packet, noack_stage_memory *memory, double u) {
    if (settings->correlation != 0.0 || settings->loss_correlation != 0.0) {
        double z = latent(settings->correlation, settings->innovation, memory, u);
        if (settings->loss_correlation != 0.0)
            z = settings->loss_correlation * copy_in(packet)->score + settings->loss_innovation * z;
        u = fmin(noack_normal_cdf(z), 0.9999999999999999);
    }
    double delay_ns =
        settings->constant_ns + noack_delay_quantile_ns(settings, packet->link->reals, u);
    return (int64_t)fmin(fmax(delay_ns, 0.0), LONGEST_NS);
}

void apply_delay(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    double uniform[2];
    draw(packet, stage, 0, uniform);
    packet_copy *copy = copy_in(packet);
    copy->time_ns += draw_delay_ns(&stage->delay, packet, memory, uniform[0]);
    if (stage->delay.ordered && copy->exists) {
        copy->time_ns = max_of(copy->time_ns, memory->taken_until_ns);
        memory->taken_until_ns = copy->time_ns;
    }
}
