/* The clock of a run: simulated time as a function of this host's monotonic clock. */
#include "shared.h"

#include <math.h>

int64_t noack_clock_at_ns(const noack_clock *clock, int64_t own_ns) {
    return noack_simulated_ns_of(clock, own_ns - clock->epoch_ns);
}

/* Truncate to a whole number, of 146 years at most. */
static int64_t whole_ns(double time_ns) {
    const double most = 4611686018427387904.0; /* 2^62 */
    return (int64_t)fmin(fmax(time_ns, -most), most);
}

int64_t noack_simulated_ns_of(const noack_clock *clock, int64_t wall_ns) {
    return clock->speed == 1.0 ? wall_ns : whole_ns((double)wall_ns * clock->speed);
}

int64_t noack_clock_wait_ns(const noack_clock *clock, int64_t simulated_ns) {
    if (clock->speed == 1.0 || simulated_ns <= 0)
        return simulated_ns;
    return whole_ns((double)simulated_ns / clock->speed);
}
