/* Counter-based random numbers, the normal distribution, and correlated random events. */
#include "network.h"

/* Philox4x32-10 (Salmon, Moraes, Dror & Shaw, SC 2011): four random words of 32 bits for a counter
   of four words and a key of two. */
static inline void philox(const int64_t counter[4], const int64_t key[2], int64_t words[4]) {
    uint32_t c0 = (uint32_t)counter[0], c1 = (uint32_t)counter[1];
    uint32_t c2 = (uint32_t)counter[2], c3 = (uint32_t)counter[3];
    uint32_t k0 = (uint32_t)key[0], k1 = (uint32_t)key[1];
    for (int round = 0; round < 10; round++) {
        uint64_t p0 = UINT64_C(0xD2511F53) * c0;
        uint64_t p1 = UINT64_C(0xCD9E8D57) * c2;
        c0 = (uint32_t)(p1 >> 32) ^ c1 ^ k0;
        c1 = (uint32_t)p1;
        c2 = (uint32_t)(p0 >> 32) ^ c3 ^ k1;
        c3 = (uint32_t)p0;
        k0 += UINT32_C(0x9E3779B9);
        k1 += UINT32_C(0xBB67AE85);
    }
    words[0] = c0;
    words[1] = c1;
    words[2] = c2;
    words[3] = c3;
}

void noack_philox(const int64_t counter[4], const int64_t key[2], int64_t words[4]) {
    philox(counter, key, words);
}

/* Two numbers in [0, 1), multiples of 2^-53, of a pair for a datagram. They are a function of the
   stream's key and of the numbers of flow (below 2^32), packet (below 2^63) and pair: they do not
   depend on time, on other flows, or on batches. */
void noack_uniforms(
    int64_t key0, int64_t key1, int64_t flow, int64_t packet, int64_t block, double uniform[2]) {
    int64_t counter[4] = {packet & 0xFFFFFFFF, packet >> 32, flow, block};
    int64_t key[2] = {key0, key1}, words[4];
    philox(counter, key, words);
    for (int i = 0; i < 2; i++) {
        int64_t high = words[2 * i] >> 5, low = words[2 * i + 1] >> 6;
        uniform[i] = (double)(high * 67108864 + low) * (1.0 / 9007199254740992.0);
    }
}

/* 1 - Phi(i/2) for i = 1, 2, ... */
static const double UPPER_TAILS[] = {
    0.3085375387259869,     0.15865525393145705,   0.06680720126885807,    0.02275013194817921,
    0.006209665325776135,   0.0013498980316300946, 0.00023262907903552504, 3.1671241833119924e-05,
    3.3976731247300603e-06, 2.866515718791939e-07, 1.8989562465887718e-08, 9.86587645037698e-10,
    4.016000583859118e-11,  1.279812543885835e-12, 3.1908916729108963e-14, 6.220960574271784e-16,
    9.479534822203318e-18};

/* 1 - Phi(z) = 1 - Phi(a) + phi(a) I(t), where a is the next multiple of 1/2 after z >= 0, t = a - z,
   and I(t) the integral of phi(a - s)/phi(a) over [0, t] by Taylor's series: all of its large terms are
   positive. Beyond 8.5 the result is 0, below half the resolution of a uniform number. */
static double upper_tail(double z) {
    if (!(z < 8.5))
        return isnan(z) ? z : 0.0;
    int i = (int)(2.0 * z);
    double a = 0.5 * (i + 1), t = a - z, last = 0.0, term = t, total = t;
    for (int k = 1; k < 60 && fabs(term) + fabs(last) > 1e-18 * total; k++) {
        double share = 1.0 / (k * (k + 1)), next = a * t * k * share * term;
        next -= t * t * (k - 1) * share * last;
        last = term;
        term = next;
        total += term;
    }
    return UPPER_TAILS[i] + 0.3989422804014327 * fixed_exp(-0.5 * a * a) * total;
}

double noack_normal_cdf(double z) { return z < 0.0 ? upper_tail(-z) : 1.0 - upper_tail(z); }

/* The z with Phi(z) = u, for u in [0, 1] (Wichura 1988, algorithm AS 241, PPND16). The relative
   error is below 1e-15; u is limited to a distance of 2^-54 from 0 and 1, half the resolution of a
   uniform number, so that 0 has a finite score. */
double noack_normal_score(double u) {
    double q = u - 0.5, r, z;
    if (fabs(q) <= 0.425) {
        r = 0.180625 - q * q;
        return q
               * (((((((2509.0809287301226727 * r + 33430.575583588128105) * r
                       + 67265.770927008700853) * r + 45921.953931549871457) * r
                     + 13731.693765509461125) * r + 1971.5909503065514427) * r
                   + 133.14166789178437745) * r + 3.387132872796366608)
               / (((((((5226.495278852545925 * r + 28729.085735721942674) * r
                       + 39307.89580009271061) * r + 21213.794301586595867) * r
                     + 5394.1960214247511077) * r + 687.1870074920579083) * r
                   + 42.313330701600911252) * r + 1.0);
    }
    double tail = fmax(fmin(u, 1.0 - u), 5.551115123125783e-17);
    r = sqrt(-noack_log(tail));
    if (r <= 5.0) {
        r -= 1.6;
        z = (((((((7.7454501427834140764e-4 * r + 0.0227238449892691845833) * r
                  + 0.24178072517745061177) * r + 1.27045825245236838258) * r
                + 3.64784832476320460504) * r + 5.7694972214606914055) * r
              + 4.6303378461565452959) * r + 1.42343711074968357734)
            / (((((((1.05075007164441684324e-9 * r + 5.475938084995344946e-4) * r
                    + 0.0151986665636164571966) * r + 0.14810397642748007459) * r
                  + 0.68976733498510000455) * r + 1.6763848301838038494) * r
                + 2.05319162663775882187) * r + 1.0);
    } else {
        r -= 5.0;
        z = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r
                  + 0.0012426609473880784386) * r + 0.026532189526576123093) * r
                + 0.29656057182850489123) * r + 1.7848265399172913358) * r
              + 5.4637849111641143699) * r + 6.6579046435011037772)
            / (((((((2.04426310338993978564e-15 * r + 1.4215117583164458887e-7) * r
                    + 1.8463183175100546818e-5) * r + 7.868691311456132591e-4) * r
                  + 0.0148753612908506148525) * r + 0.13692988092273580531) * r
                + 0.59983220655588793769) * r + 1.0);
    }
    return q < 0.0 ? -z : z;
}

/* Random events with a given probability and a correlation between successive packets: the latent
   variable z_i = rho z_(i-1) + sqrt(1 - rho^2) g_i is a stationary Gaussian process. The
   event happens to packet i if z_i exceeds the normal quantile of 1 - p, hence with probability p
   exactly, for every rho. */

/* Advance a latent process by one packet and return z, standard normal; u is uniform. */
double latent(double correlation, double innovation, noack_stage_memory *memory, double u) {
    double z = -noack_normal_score(u);
    if (correlation != 0.0) {
        if (memory->state != 0)
            z = correlation * memory->score + innovation * z;
        memory->state = 1;
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
